"""Serial lines: the port as a stream of stamped bytes, lines of text, and instruments that send text."""
