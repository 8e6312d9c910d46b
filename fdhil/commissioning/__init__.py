"""Commission drives: scan the bus, compare, move by 10 um, sign off. Only this package and the guard send on a bus."""
