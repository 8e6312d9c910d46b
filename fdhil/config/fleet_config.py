"""The configuration of a fleet server, which collects the history of many machines."""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import Field, field_validator

from fdhil.config.config_loader import load_section_file
from fdhil.config.section import Section
from fdhil.config.uplink_section import NatsServer
from fdhil.config.web_section import Web

MACHINE_NAME_PATTERN = r"^[A-Za-z0-9_-]{1,64}$"


class Server(NatsServer):
    """[server]: the NATS server whose JetStream carries the machines' records."""


class Stream(Section):
    """[stream]: what the server keeps until it is in the database; created at the first start."""

    name: str = Field("fdhil", pattern=MACHINE_NAME_PATTERN, description="name of the stream")
    replicas: int = Field(1, ge=1, le=5, description="replicas of each message in the cluster")
    max_bytes: int = Field(
        10 << 30, ge=1 << 16, le=1 << 50, description="space for waiting messages; when full, machines keep theirs"
    )
    duplicate_window_s: float = Field(600.0, ge=1, le=86_400, description="how long the server recognises duplicates")


class Database(Section):
    """[database]: the PostgreSQL database of the history."""

    connection: str = Field("dbname=fdhil", max_length=1000, description="libpq's connection string, without password")

    @field_validator("connection")
    @classmethod
    def _refuse_password(cls, text: str) -> str:
        if re.search(r"\bpassword\s*=|//[^/@]*:[^/@]*@", text):
            raise ValueError(
                "must not contain a password: name a passfile, or use ~/.pgpass or the server's peer login"
            )
        return text


class Objects(Section):
    """[objects]: the recorded windows, one file each, named by their content."""

    directory: Path = Field(
        Path("fdhil-windows"), description="their folder, shared by all collectors; relative to this file's"
    )


class Retention(Section):
    """[retention]: how long fdhil fleet retain keeps records and windows; without a number they are kept for ever."""

    record_months: int | None = Field(None, ge=1, le=1200, description="months of records kept before the present one")
    window_months: int | None = Field(
        None, ge=1, le=1200, description="months of recorded windows kept; their results stay"
    )


class Fleet(Section):
    """The whole file."""

    server: Server = Server()
    stream: Stream = Stream()
    database: Database = Database()
    objects: Objects = Objects()
    retention: Retention = Retention()
    web: Web = Web()


def load_fleet_config(path: Path) -> Fleet:
    """Read a fleet server's configuration; ConfigError with every fault, its path and a suggestion."""
    fleet = load_section_file(Fleet, path, "a fleet's config")
    objects = fleet.objects.model_copy(update={"directory": path.parent / fleet.objects.directory})
    placed = {"server": fleet.server.resolve_paths(path.parent), "web": fleet.web.resolve_paths(path.parent)}
    return fleet.model_copy(update={**placed, "objects": objects})
