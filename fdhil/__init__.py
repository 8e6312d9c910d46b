"""fdhil: identify feed drives during rapid moves, predict path errors, and feed corrections back."""

from importlib.metadata import version

__version__ = version("fdhil")
