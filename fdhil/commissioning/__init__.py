"""Scans, compares, moves by 10 um and signs off: the only room besides the guard that sends on a bus."""
