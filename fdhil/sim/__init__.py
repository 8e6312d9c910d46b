"""The simulated machine on real protocols: plant, CiA 402 drives, sensors, NC and bus.

Written from the standards and the equations alone; it shares no code with what it tests.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
