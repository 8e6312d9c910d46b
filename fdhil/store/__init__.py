"""Stores recordings, windows and the history on disk."""

import lazy_loader

WINDOWS_FOLDER = "windows"
HISTORY_FILE = "history.sqlite"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["HISTORY_FILE", "WINDOWS_FOLDER"]
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["HISTORY_FILE", "WINDOWS_FOLDER"]

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["HISTORY_FILE", "WINDOWS_FOLDER"]
