"""[publish]: what other programs can read, or are sent, and from where."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from fdhil.config.credentials import Credentials
from fdhil.config.section import Positive, Section, SectionWithFiles
from fdhil.config.web_section import is_loopback


class Publisher(SectionWithFiles):
    """Keys that all publishers share."""

    period_s: Positive = Field(1.0, ge=0.1, le=3600, description="how often the daemon is polled")


class OpcUaServer(Publisher):
    """[publish.opcua]: an OPC UA server of the daemon's data (fdhil publish opcua, needs the extra opcua)."""

    host: str = Field("127.0.0.1", min_length=1, description="address to listen on; 0.0.0.0 for all")
    port: int = Field(4840, ge=0, le=65535, description="TCP port; 0 chooses a free one and reports it")
    certificate_file: Path | None = Field(None, description="certificate, to sign and encrypt (Basic256Sha256)")
    private_key_file: Path | None = Field(None, description="private key of that certificate, mode 0600")
    trusted_clients: Path | None = Field(
        None,
        description="folder of certificates (.der, .pem) of permitted clients; left out: any client with a password",
    )
    users_file: Path | None = Field(
        None, description="users file (fdhil web-user); left out: anyone on this computer, without login"
    )

    manufacturer: str = Field("", description="the machine's manufacturer, for its Identification")
    serial_number: str = Field("", description="the machine's serial number, for its Identification")
    product_instance_uri: str = Field("", description="the machine's globally unique URI, for its Identification")

    @model_validator(mode="after")
    def _check_access(self) -> Self:
        if (self.certificate_file is None) != (self.private_key_file is None):
            raise ValueError("certificate_file: certificate_file and private_key_file must be given together")
        for key in ("users_file", "trusted_clients"):
            if getattr(self, key) is not None and self.certificate_file is None:
                raise ValueError(
                    f"{key}: it needs a certificate_file; without one the password would be sent in clear text"
                )
        if not is_loopback(self.host) and self.users_file is None:
            raise ValueError("host: beyond this computer it needs a users_file and a certificate_file")
        return self


class PrometheusMetrics(Publisher):
    """[publish.prometheus]: metrics for Prometheus (fdhil publish prometheus, needs the extra web)."""

    host: str = Field("127.0.0.1", min_length=1, description="address to listen on; 0.0.0.0 for all")
    port: int = Field(9837, ge=0, le=65535, description="TCP port; 0 chooses a free one and reports it")
    allowed_hosts: tuple[str, ...] = Field((), description="further permitted host names, besides localhost and host")
    tls_certificate_file: Path | None = Field(None, description="certificate chain (PEM), for https")
    tls_key_file: Path | None = Field(None, description="its private key (PEM), readable by its user only")
    tls_client_ca_file: Path | None = Field(None, description="CA of client certificates (PEM); left out: not required")
    unprotected: bool = Field(
        False, description="listen beyond this computer without client certificates: anyone can read"
    )

    @model_validator(mode="after")
    def _check_access(self) -> Self:
        if (self.tls_certificate_file is None) != (self.tls_key_file is None):
            raise ValueError("tls_certificate_file: certificate and tls_key_file must be given together")
        if self.tls_client_ca_file is not None and self.tls_certificate_file is None:
            raise ValueError("tls_client_ca_file: it needs a tls_certificate_file and its key")
        if not (is_loopback(self.host) or self.tls_client_ca_file or self.unprotected):
            raise ValueError("host: beyond this computer it needs a tls_client_ca_file, or unprotected = true")
        return self


TOPIC_PART = r"^[^/+#\x00-\x1f]*$"  # characters between two slashes of a topic


class MqttBroker(Publisher, Credentials):
    """[publish.mqtt]: an MQTT broker that receives Sparkplug B (fdhil publish mqtt, needs the extra mqtt)."""

    host: str = Field("127.0.0.1", min_length=1, description="the broker")
    port: int = Field(1883, ge=1, le=65535, description="TCP port; with TLS usually 8883")
    group: str = Field("fdhil", min_length=1, pattern=TOPIC_PART, description="Sparkplug's group: a plant, a hall")
    node: str = Field("", pattern=TOPIC_PART, description="Sparkplug's edge node; left out: the machine's name")
    primary_host: str = Field("", pattern=TOPIC_PART, description="host application that must be online, if any")
    keepalive_s: Positive = Field(
        30.0,
        ge=1,
        le=3600,
        description="MQTT keep-alive; after 1.5 times as long the broker publishes the death certificate",
    )

    def get_node_name(self, machine: str) -> str:
        """Return the edge node: the configured one, else the machine's name as a topic can hold it."""
        return self.node or re.sub(r"[/+#\x00-\x1f]", "_", machine)

    @model_validator(mode="after")
    def _require_encryption(self) -> Self:
        if self.user and not self.tls_ca_file and not is_loopback(self.host):
            raise ValueError(
                "user: beyond this computer it needs a tls_ca_file; else the password would be sent in clear text"
            )
        return self


class MtConnectAdapter(Publisher):
    """[publish.mtconnect]: an adapter that MTConnect agents connect to (fdhil publish mtconnect)."""

    host: str = Field("127.0.0.1", min_length=1, description="address to listen on; 0.0.0.0 for all")
    port: int = Field(7878, ge=0, le=65535, description="TCP port; 0 chooses a free one and reports it")
    device_uuid: str = Field("", pattern=r"^[A-Za-z0-9._:-]*$", description="left out: derived from the machine's name")
    unprotected: bool = Field(False, description="listen beyond this computer: SHDR has no protection, anyone can read")

    @model_validator(mode="after")
    def _check_access(self) -> Self:
        if not (is_loopback(self.host) or self.unprotected):
            raise ValueError("host: beyond this computer it needs unprotected = true; else run the agent on this one")
        return self


class Publish(Section):
    """[publish]: what fdhil publish publishes; nothing listens and nothing is sent until that command is started."""

    opcua: OpcUaServer = OpcUaServer()
    mqtt: MqttBroker = MqttBroker()
    mtconnect: MtConnectAdapter = MtConnectAdapter()
    prometheus: PrometheusMetrics = PrometheusMetrics()

    def resolve_paths(self, folder: Path) -> Self:
        return self.model_copy(
            update={key: each.resolve_paths(folder) for key, each in self if isinstance(each, Publisher)}
        )
