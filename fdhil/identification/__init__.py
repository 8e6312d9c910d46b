"""Identifies the six parameters of a feed drive, with standard deviations, from recorded rapids; or refuses with a
reason.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
