"""The web pages: a process of its own, a client of the daemon's socket and of the store. It opens no bus.

Needs the extra ``web``; importing this package does not import it.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
