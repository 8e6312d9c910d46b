"""The web pages: a process of its own, a client of the daemon's socket and of the store. It opens no bus.

Needs the extra ``web``; importing this package does not import it.
"""
