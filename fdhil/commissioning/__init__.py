"""Commission drives: scan the bus, compare, move by 10 um, sign off. Only this package and the guard send on a bus."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
