"""The simulated machine on real protocols: plant, CiA 402 drives, sensors, NC and bus.

Written from the standards and the equations alone; it shares no code with what it tests.
"""
