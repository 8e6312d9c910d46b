"""[web]: what a browser may show and do, and from where."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from fdhil.config.section import SectionWithFiles


class Web(SectionWithFiles):
    """[web]: the pages of fdhil web. Nothing listens until that command is started."""

    host: str = Field("127.0.0.1", min_length=1, description="address to listen on; 0.0.0.0 for all")
    port: int = Field(8437, ge=0, le=65535, description="TCP port; 0 chooses a free one and reports it")
    allowed_hosts: tuple[str, ...] = Field((), description="further permitted host names, besides localhost and host")
    allowed_origins: tuple[str, ...] = Field(
        (), description="origins of other servers whose scripts may call it, as https://panel.example; left out: none"
    )
    users_file: Path | None = Field(
        None, description="users file (fdhil web-user); left out: anyone on this computer may read"
    )
    tls_certificate_file: Path | None = Field(None, description="certificate chain (PEM), for https")
    tls_key_file: Path | None = Field(None, description="its private key (PEM), readable by its user only")
    acting: bool = Field(False, description="whether users with the role operate may arm and acknowledge in a browser")
    programs_directory: Path | None = Field(
        None, description="folder of programs that browsers may arm; left out: none"
    )
    unprotected: bool = Field(False, description="listen beyond this computer without TLS or users: anyone can read")

    @model_validator(mode="after")
    def _check_access(self) -> Self:
        if (self.tls_certificate_file is None) != (self.tls_key_file is None):
            raise ValueError("tls_certificate_file and tls_key_file must be given together")
        if self.acting and self.users_file is None:
            raise ValueError("acting needs a users_file: only logged-in users may act")
        return self

    @property
    def on_loopback(self) -> bool:
        return is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Return whether a host, a name or an address, is this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
