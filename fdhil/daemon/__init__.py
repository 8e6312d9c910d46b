"""The service: sources in, pipelines in worker threads, outcomes to the store and to its clients."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
