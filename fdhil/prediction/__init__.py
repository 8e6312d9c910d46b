"""Predicts the path error of the closed loops: axis errors, contour error, zones, and the model's own skill."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
