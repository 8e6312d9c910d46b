"""Reports: the paper's figures for a machine, and one self-contained HTML page around them.

Needs the extra ``report`` (matplotlib, jinja2); importing this package does not import them.
"""

from fdhil.report.page import Page, Section, Table, require, write

__all__ = ["Page", "Section", "Table", "require", "write"]
