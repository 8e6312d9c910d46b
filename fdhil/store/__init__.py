"""Stores recordings, windows and the history on disk."""

from fdhil.lazy_exports import export_names

WINDOWS_FOLDER = "windows"
HISTORY_FILE = "history.sqlite"

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
__all__ += ["HISTORY_FILE", "WINDOWS_FOLDER"]
