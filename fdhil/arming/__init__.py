"""Arming: checks a program, hands its table rows to the guard, and feeds more rows while the machine runs."""
