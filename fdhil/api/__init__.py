"""The Python interface, offered as ``import fdhil``; the command line uses the same functions.

Its modules are imported when they are first used. The names in ``fdhil.__all__`` follow semantic versioning: within one
major version they keep their meaning.
"""
