"""Reports: charts of a machine in one self-contained HTML page, printed as PDF on request.

Needs the extra ``report`` (matplotlib, jinja2); importing this package does not import them.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
