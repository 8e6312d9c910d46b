"""Validates windows: checks of the signals, of the fit, and of what the model leaves at the table.

No estimate is accepted unchecked. The checks never raise, whatever the signals; each refusal has a reason.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
