"""Identifies the six parameters of a feed drive, with standard deviations, from recorded rapids; or refuses with a
reason.
"""
