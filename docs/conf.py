"""The site of the documents: ``make docs`` writes it to out/site."""

from __future__ import annotations

import re
from importlib import metadata
from typing import Any

project = "fdhil"
author = "the fdhil developers"
copyright = "the fdhil developers, MIT licence"
version = release = metadata.version("fdhil")

extensions = ["myst_parser"]
myst_heading_anchors = 4
nitpicky = True

html_theme = "furo"
html_title = "fdhil"
html_static_path = ["static"]
html_js_files = ["copy.js"]
html_css_files = ["copy.css"]

# pages that stand beside the folder of documents, and where the site has them
BESIDE = {"README.md": "/index.md", "CHANGELOG.md": "/about/changelog.md", "CONTRIBUTING.md": "/about/contributing.md",
          "SECURITY.md": "/about/security.md"}  # fmt: skip


def _linked(_app: Any, _page: str, source: list[str]) -> None:
    """Let links to pages beside the folder of documents lead to their place in the site."""
    source[0] = re.sub(
        r"\]\((?:\.\./)+(\w+\.md)(#[^)]*)?\)",
        lambda link: f"]({BESIDE[link[1]]})" if link[1] in BESIDE else link[0],
        source[0],
    )


def setup(app: Any) -> None:
    """Called by the builder."""
    app.connect("source-read", _linked)
