"""Tries a commissioned axis by moving it inside the room that the operator gave: a jog, and rapids.

The jog proves units and signs, the rapids identify the drive, and the last two of them must be as predicted. Nothing
here sends set-points but through ``set_points``, and whatever happens the drive is switched off at the end.
"""

RAPIDS = 6
