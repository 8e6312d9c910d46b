"""Reports: charts of a machine in one self-contained HTML page, printed as PDF on request.

Needs the extra ``report`` (matplotlib, jinja2); importing this package does not import them.
"""

from fdhil.report.pdf import find_browser, write_page_or_pdf, write_pdf
from fdhil.report.report_page import Page, Section, Table, render_html, require_libraries, write_page

__all__ = [
    "Page",
    "Section",
    "Table",
    "find_browser",
    "render_html",
    "require_libraries",
    "write_page",
    "write_page_or_pdf",
    "write_pdf",
]
