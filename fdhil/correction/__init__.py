"""Plans offsets that compensate the predicted path error: methods, limits, the gate."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
