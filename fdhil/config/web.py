"""[web]: what a browser may show and do, and from where."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from fdhil.config.section import SectionWithFiles


class Web(SectionWithFiles):
    """[web]: the pages of fdhil web. Nothing listens until that command is started."""

    host: str = Field("127.0.0.1", min_length=1, description="address that it listens at; 0.0.0.0 is every one")
    port: int = Field(8437, ge=0, le=65535, description="TCP port; 0 takes a free one and tells it")
    allowed_hosts: tuple[str, ...] = Field(
        (), description="names by which browsers may call it, besides localhost and the host above"
    )
    allowed_origins: tuple[str, ...] = Field(
        (), description="pages of other servers whose scripts may ask it, as https://panel.example; left out: none"
    )
    users_file: Path | None = Field(
        None, description="who may log in (fdhil web-user writes it); left out: anyone on this computer may read"
    )
    tls_certificate_file: Path | None = Field(None, description="certificate chain (PEM), for https")
    tls_key_file: Path | None = Field(None, description="its private key (PEM), readable by its user alone")
    acting: bool = Field(False, description="whether who has the role operate may arm and acknowledge in a browser")
    programs_directory: Path | None = Field(
        None, description="folder of the NC programs that may be armed from a browser; left out: none"
    )
    unprotected: bool = Field(
        False, description="listen beyond this computer without TLS or users, to be read by anyone on that network"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.tls_certificate_file is None) != (self.tls_key_file is None):
            raise ValueError("tls_certificate_file and tls_key_file belong together: give both, or neither")
        if self.acting and self.users_file is None:
            raise ValueError("acting needs a users_file: who may act logs in")
        return self

    @property
    def on_loopback(self) -> bool:
        """Whether the host is this computer only."""
        return is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Return whether a host, a name or an address, is this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
