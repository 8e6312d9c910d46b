"""The command line: one file per group of commands, loaded when called so that ``fdhil --help`` is instant."""
