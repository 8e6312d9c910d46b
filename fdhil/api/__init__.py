"""The Python interface, offered as ``import fdhil``; the command line uses the same functions.

Modules are imported on first use. The names in ``fdhil.__all__`` follow semantic versioning.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
