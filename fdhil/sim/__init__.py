"""The simulated machine on real protocols: plant, CiA 402 drives, sensors, NC and bus.

Written from the standards and the equations alone; it shares no code with what it tests.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
