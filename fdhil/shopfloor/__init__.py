"""Tells the shop floor's networks what the daemon knows: OPC UA, MQTT, MTConnect, Prometheus; each by its own process.

They are clients of the daemon's socket that only ask for its status. Nothing here sends anything to a machine, and
nothing that comes over such a network reaches the daemon.
"""
