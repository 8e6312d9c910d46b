"""Arming: from a program to rows that were checked, handed to the guard and fed to it while the machine runs."""
