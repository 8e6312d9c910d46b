"""fdhil: identify feed drives during rapid moves, predict path errors, and feed corrections back."""
