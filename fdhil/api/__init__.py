"""The Python interface, offered as ``import fdhil``; the command line uses the same functions.

Modules are imported on first use. The names in ``fdhil.__all__`` follow semantic versioning.
"""
