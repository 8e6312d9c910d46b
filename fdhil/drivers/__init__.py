"""Receives from the machine's buses and sensors and turns it into records."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
