"""Receives from the machine's buses and sensors and turns it into records."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
