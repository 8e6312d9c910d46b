"""Credentials with which a client authenticates to a server and verifies it: keys, and the files that they name.

The files are read at every connection, and their contents appear in no message.
"""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from fdhil.config.section import SectionWithFiles
from fdhil.errors import ConnectError


class Credentials(SectionWithFiles):
    """Keys for user, password and TLS files, shared by all sections that connect to a server."""

    user: str | None = Field(None, min_length=1, description="user on the server; left out: none, or the certificate's")
    password_file: Path | None = Field(None, description="file with the user's password, mode 0600")
    tls_ca_file: Path | None = Field(
        None,
        description="CA of the server's certificate (PEM), to encrypt and to verify it; left out: neither; "
        "Debian's CAs are in /etc/ssl/certs/ca-certificates.crt",
    )
    tls_certificate_file: Path | None = Field(None, description="client certificate (PEM), where required")
    tls_key_file: Path | None = Field(None, description="its private key (PEM, without a password), mode 0600")

    @model_validator(mode="after")
    def _check_key_pairs(self) -> Self:
        if (self.tls_certificate_file is None) != (self.tls_key_file is None):
            raise ValueError("tls_certificate_file: certificate and tls_key_file must be given together")
        if self.tls_certificate_file is not None and self.tls_ca_file is None:
            raise ValueError("tls_certificate_file: it needs a tls_ca_file; without one TLS is off")
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user: user and password_file must be given together")
        return self


def read_password(settings: Credentials, server: str, section: str) -> str | None:
    """Read the user's password; ConnectError where its file cannot be read."""
    return read_secret(settings.password_file, server, f"[{section}] password_file")


def read_secret(path: Path | None, server: str, key: str) -> str | None:
    """Read a secret file, None where none is named; ConnectError where it cannot be read."""
    try:
        return None if path is None else path.read_text("utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        assert path is not None
        raise _make_file_error(server, key, path, error) from None


def create_tls_context(settings: Credentials, server: str, section: str) -> ssl.SSLContext | None:
    """Create the TLS context that verifies the server, None without a CA file; ConnectError names an unusable file."""
    if settings.tls_ca_file is None:
        return None
    try:
        context = ssl.create_default_context(cafile=settings.tls_ca_file)
    except (OSError, ssl.SSLError) as error:
        raise _make_file_error(server, f"[{section}] tls_ca_file", settings.tls_ca_file, error) from None
    if settings.tls_certificate_file is not None:
        try:
            context.load_cert_chain(settings.tls_certificate_file, settings.tls_key_file, password=lambda: "")
        except (OSError, ssl.SSLError) as error:
            key = f"[{section}] tls_certificate_file"
            raise _make_file_error(server, key, settings.tls_certificate_file, error) from None
    return context


def _make_file_error(server: str, key: str, path: Path, error: Exception) -> ConnectError:
    cause = (isinstance(error, OSError) and error.strerror) or type(error).__name__
    return ConnectError(server, f"{key} {path} cannot be used: {cause}; fdhil's user must be able to read it")
