"""Programs that run inside other systems, by their Python and with the standard library alone; fdhil imports none."""
