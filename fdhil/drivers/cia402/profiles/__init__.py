"""Lists drive models, one module each with a ``PROFILE``."""
