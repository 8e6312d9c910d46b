"""The simulated machine on the wire: plant, CiA 402 drives, sensors, NC and bus.

Written against the standards and the equations alone; it shares no code with what it is there to check.
"""
