"""The physics of a feed drive: equations [1] and [2] of [DES], open loop from voltage and in closed loop."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
