"""Reports: charts of a machine in one self-contained HTML page, printed as PDF on request.

Needs the extra ``report`` (matplotlib, jinja2); importing this package does not import them.
"""

from fdhil.report.page import Page, Section, Table, html, require, write
from fdhil.report.pdf import find_browser, write_page_or_pdf, write_pdf

__all__ = ["Page", "Section", "Table", "find_browser", "html", "require", "write", "write_page_or_pdf", "write_pdf"]
