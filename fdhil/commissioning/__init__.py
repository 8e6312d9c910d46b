"""Commissioning: the only room besides the guard that sends on a bus. Scan, compare, move by 10 um, sign off."""
