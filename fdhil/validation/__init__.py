"""Validates windows: checks of the signals, of the fit, and of what the model leaves at the table.

No estimate is accepted unchecked. The checks never raise, whatever the signals; each refusal has a reason.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
