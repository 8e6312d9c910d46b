"""Publishes the daemon's status on shop-floor networks: OPC UA, MQTT, MTConnect, Prometheus, one process each.

They are clients of the daemon's socket that only request its status. Nothing here sends anything to a machine, and
nothing received from such a network reaches the daemon.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
