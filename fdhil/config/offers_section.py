"""[offers]: whose signed configuration changes an operator of this machine may accept."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from fdhil.config.section import SectionWithFiles

_OF_THE_WORKS = 14 << 3  # first byte of a plant's key, an O in its text; NATS user keys begin otherwise


def decode_plant_key(text: str) -> bytes:
    """Return the 32 bytes of an Ed25519 public key in NATS notation; ValueError where it is not a plant's key."""
    try:
        raw = base64.b32decode(text)
    except binascii.Error:
        raw = b""
    if len(raw) != 35 or raw[0] != _OF_THE_WORKS or binascii.crc_hqx(raw[:33], 0) != int.from_bytes(raw[33:], "little"):
        raise ValueError(
            "is not a plant's public key (an O and 55 letters), or was mistyped: run `fdhil fleet key` there to show it"
        )
    return raw[1:33]


def _check_key(text: str) -> str:
    decode_plant_key(text)
    return text


class Offers(SectionWithFiles):
    """[offers]: signed configuration changes proposed by a plant (needs the extra fleet); each is accepted by hand."""

    trust: tuple[Annotated[str, AfterValidator(_check_key)], ...] = Field(
        (),
        max_length=20,
        description="public keys of plants whose configuration changes may be accepted; left out: none",
    )
    directory: Path | None = Field(
        None,
        description="where fdhil uplink stores fetched configuration changes; left out: offers in the uplink's folder",
    )
