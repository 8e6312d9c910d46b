"""Reports: charts of a machine in one self-contained HTML page, printed as PDF on request.

Needs the extra ``report`` (matplotlib, jinja2); importing this package does not import them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
