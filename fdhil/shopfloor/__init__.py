"""Publishes the daemon's status on shop-floor networks: OPC UA, MQTT, MTConnect, Prometheus, one process each.

They are clients of the daemon's socket that only request its status. Nothing here sends anything to a machine, and
nothing received from such a network reaches the daemon.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
