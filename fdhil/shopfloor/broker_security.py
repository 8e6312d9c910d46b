"""Makes a connection to an MQTT broker one that is encrypted, and one of a user, where the config says so."""

from __future__ import annotations

import ssl

from fdhil.config import credentials
from fdhil.config.publish import MqttBroker

_WHO = ("MQTT broker", "publish.mqtt")


def password_of(settings: MqttBroker) -> str | None:
    """Return the user's password; ConnectError where its file cannot be read."""
    return credentials.password_of(settings, *_WHO)


def tls_of(settings: MqttBroker) -> ssl.SSLContext | None:
    """Return how TLS is spoken, the broker's certificate checked; ConnectError with the file that cannot be used."""
    return credentials.tls_of(settings, *_WHO)
