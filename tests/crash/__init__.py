"""Crash consistency: what was acknowledged is there, whatever call of the system failed or ended the process."""
