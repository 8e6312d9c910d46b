"""Serial lines: the port as a stream of stamped bytes, lines of text, and the instruments that tell by them."""
