"""Drive models, one module each with a ``PROFILE``."""
