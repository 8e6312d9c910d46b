"""``python -m fdhil`` is the command line."""

from fdhil.cli.main import main

main()
