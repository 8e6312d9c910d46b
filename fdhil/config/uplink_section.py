"""[uplink]: what a machine sends to the plant's fleet server, and how."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, StringConstraints, model_validator

from fdhil.config.credentials import Credentials
from fdhil.config.section import AxisName
from fdhil.config.web_section import is_loopback

Label = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f]*$")]
LabelName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
Labels = Mapping[LabelName, Label]


class NatsServer(Credentials):
    """Keys for the connection to a NATS server."""

    server: str = Field(
        "nats://127.0.0.1:4222",
        pattern=r"^(nats|tls)://[^/@,\s]+(,(nats|tls)://[^/@,\s]+)*$",
        description="the NATS server with JetStream; servers of one cluster are separated by commas and tried in turn",
    )

    credentials_file: Path | None = Field(
        None, description="instead of user and password: NATS' .creds file, or an nkey's seed; mode 0600"
    )

    @property
    def servers(self) -> tuple[str, ...]:
        return tuple(self.server.split(","))

    @model_validator(mode="after")
    def _require_encryption(self) -> Self:
        hosts = [urlsplit(server).hostname or "" for server in self.servers]
        if self.tls_ca_file is None and not all(map(is_loopback, hosts)):
            raise ValueError(
                "server: beyond this computer it needs a tls_ca_file; else everything would be sent in clear text"
            )
        return self


class Uplink(NatsServer):
    """[uplink]: what fdhil uplink sends to the fleet server (needs the extra fleet); left out: nothing."""

    machine: str = Field(
        "",
        pattern=r"^([A-Za-z0-9_-]{1,64})?$",
        description="this machine's name in the plant; left out: derived from [machine] name",
    )
    windows: Literal["all", "refused", "some", "none"] = Field(
        "refused", description="which recorded windows are sent whole; the results of every window are always sent"
    )
    every_window: int = Field(10, ge=1, le=1_000_000, description="with windows = some: every n-th window of an axis")
    keep_unsent: int = Field(
        500_000, ge=1_000, le=100_000_000, description="records kept while unsent; the oldest go first"
    )
    directory: Path | None = Field(None, description="progress of fdhil uplink; left out: <store directory>/uplink")
    labels: Labels = Field(default_factory=dict, description="for comparing machines, as type, plant, lubricant")
    axis_labels: Mapping[AxisName, Labels] = Field(
        default_factory=dict, description="labels of axes, as screw or motor"
    )

    def get_plant_name(self, machine: str) -> str:
        """Return this machine's name in the plant: the configured one, else ``machine`` as a subject can hold it."""
        return self.machine or re.sub(r"[^A-Za-z0-9_-]", "_", machine)[:64]
