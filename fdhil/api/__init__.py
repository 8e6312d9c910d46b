"""The Python interface, offered as ``import fdhil``; the command line uses the same functions.

Modules are imported on first use. The names in ``fdhil.__all__`` follow semantic versioning.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
