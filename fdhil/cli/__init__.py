"""Command line of fdhil. Modules of commands are imported on call, so that ``fdhil --help`` is instant."""
