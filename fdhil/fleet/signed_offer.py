"""Signs and verifies offers: configuration changes signed by the fleet server, as two lines of text.

The first line is the offer as canonical JSON; the second names the signing key and has the signature (Ed25519) over the
bytes of the first. An offer has one canonical form, so that any changed byte is detected.
"""

import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Self

import nkeys
from nacl.exceptions import CryptoError
from nacl.signing import VerifyKey
from pydantic import Field, FiniteFloat, StringConstraints, ValidationError, model_validator

from fdhil.config import MACHINE_NAME_PATTERN as MACHINE
from fdhil.config import Label, Labels, Section, check_value, decode_plant_key, explain_refusal
from fdhil.errors import ConfigError, ConfigFault, FdhilError
from fdhil.store import OFFER_NAME_PATTERN

SCHEMA = "fdhil-offer-1"
LARGEST = 512 * 1024  # bytes of an offer
LARGEST_KEY = 200
_SIGNED = re.compile(rf"{SCHEMA} (O[A-Z2-7]{{55}}) ([0-9a-f]{{128}})".encode())

Value = bool | int | FiniteFloat | str | tuple[int | FiniteFloat, ...]
Path_ = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]+(\.([A-Za-z0-9_]+|\*))+$", max_length=100)]
Machine = Annotated[str, StringConstraints(pattern=MACHINE)]


class OfferRefused(FdhilError):
    """An offer is not accepted and nothing was changed; the message says why."""

    exit_code = 1


class ProposedChange(Section):
    """A proposed change: ``values`` by their keys, ``axis.*`` for each axis that has the ``axis_labels``."""

    name: str = Field(pattern=f"^{OFFER_NAME_PATTERN}$")
    version: int = Field(ge=1, le=999_999_999)
    text: Label
    labels: Labels = Field(default_factory=dict, max_length=50)
    axis_labels: Labels = Field(default_factory=dict, max_length=50)
    values: Mapping[Path_, Value] = Field(min_length=1, max_length=500)

    @model_validator(mode="after")
    def _validate_values(self) -> Self:
        faults = [f"{path}: {why}" for path in self.values if (why := explain_refusal(path))]
        if any(path.startswith("axis.*.") for path in self.values) and not self.axis_labels:
            faults.append("axis_labels: axis.* means the axes with these labels; name them")
        if faults:
            raise ValueError("\n".join(faults))
        return self

    @property
    def digest(self) -> str:
        """SHA-256 of the change and its addressees."""
        return hashlib.sha256(self.model_dump_json(include=set(ProposedChange.model_fields)).encode()).hexdigest()


class Offer(ProposedChange):
    """The signed content: ``machines`` of its stage, empty: all with the ``labels``; times are s since 1970."""

    stage: int = Field(1, ge=1, le=1000)
    machines: tuple[Machine, ...] = Field((), max_length=20_000)
    by: Label
    made_s: int = Field(ge=0, le=1 << 40)
    expires_s: int = Field(ge=0, le=1 << 40)

    @model_validator(mode="after")
    def _validate_recipients(self) -> Self:
        if not self.machines and not self.labels:
            raise ValueError("it names no machines and no labels")
        return self

    def __str__(self) -> str:
        return f"{self.name} version {self.version}"


def encode_canonical(offer: Offer) -> bytes:
    return json.dumps(offer.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def sign_offer(offer: Offer, key: Path) -> bytes:
    """Return the signed document; ConfigError where the key file or a value cannot be used."""
    for path, value in offer.values.items():
        check_value(path.replace("axis.*.", "axis.X."), value)
    pair = _load_key_pair(key)
    line = encode_canonical(offer)
    signature = pair.sign(_build_signed_bytes(line)).hex()
    document = line + f"\n{SCHEMA} {pair.public_key.decode()} {signature}\n".encode()
    read_offer(document, {pair.public_key.decode()})
    return document


def read_offer(document: bytes, trusted: Collection[str]) -> Offer:
    """Return the offer of an unchanged document signed with a trusted key; OfferRefused."""
    line, _, rest = document.partition(b"\n")
    found = _SIGNED.fullmatch(rest.removesuffix(b"\n"))
    if len(document) > LARGEST or found is None or not rest.endswith(b"\n"):
        raise OfferRefused("it is not a valid change file (corrupt or truncated); export it again")
    key = found[1].decode()
    if key not in trusted:
        text = f"it is signed with {key}, which is not listed in [offers] trust"
        raise OfferRefused(
            f"{text}; confirm the key with the fleet server's operator by another channel before you list it"
        )
    try:
        VerifyKey(decode_plant_key(key)).verify(_build_signed_bytes(line), bytes.fromhex(found[2].decode()))
    except (CryptoError, ValueError):
        raise OfferRefused("it was changed after it was signed; do not trust it, ask for a new copy") from None
    return _parse_offer(line)


def _parse_offer(line: bytes) -> Offer:
    try:
        offer = Offer.model_validate_json(line)
    except (ValidationError, RecursionError) as error:
        raise OfferRefused(f"this fdhil cannot read it: {_describe_first_error(error)}") from None
    if encode_canonical(offer) != line:
        raise OfferRefused("it is not in the canonical form of an offer; export it again")
    return offer


def _describe_first_error(error: ValidationError | RecursionError) -> str:
    if isinstance(error, RecursionError):
        return "it is nested too deep"
    first = error.errors(include_url=False, include_input=False)[0]
    path = ".".join(map(str, first["loc"]))
    return f"{path}: {first['msg']}".removeprefix(": ").removeprefix("Value error, ").replace("\n", "; ")[:300]


def _build_signed_bytes(line: bytes) -> bytes:
    """Return the signed bytes; the prefix keeps signatures of other documents from matching."""
    return SCHEMA.encode() + b"\n" + line


def create_key(path: Path) -> str:
    """Create a key file, mode 0600, and return the public key; OSError, FileExistsError where it exists."""
    seed = nkeys.encode_seed(secrets.token_bytes(32), nkeys.PREFIX_BYTE_OPERATOR)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(seed + b"\n")
        file.flush()
        os.fsync(descriptor)
    return read_public_key(path)


def read_public_key(path: Path) -> str:
    """Return the public key of a key file; ConfigError."""
    return str(_load_key_pair(path).public_key.decode())


def _load_key_pair(path: Path) -> nkeys.KeyPair:
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            seed = file.read(LARGEST_KEY).strip()
    except OSError as error:
        raise _build_key_error(path, f"cannot be read: {error.strerror}", "create one with fdhil fleet key") from None
    if mode & 0o077:
        raise _build_key_error(path, "can be read by others, who could sign offers with it", f"run chmod 0600 {path}")
    try:
        pair = nkeys.from_seed(seed)
        decode_plant_key(pair.public_key.decode())
    except (nkeys.NkeysError, ValueError, TypeError, IndexError):
        raise _build_key_error(path, "is not a signing key", "create one with fdhil fleet key") from None
    return pair


def _build_key_error(path: Path, what: str, advice: str) -> ConfigError:
    return ConfigError("key", [ConfigFault(str(path), what, advice)])
