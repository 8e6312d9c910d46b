"""A signed or unsigned offer, and the file of the answers: read, or refused with a message."""

from __future__ import annotations

import json
import tempfile
from contextlib import suppress
from pathlib import Path

from fdhil.config.toml_editing import NotEditable, edit_toml
from fdhil.errors import FdhilError
from fdhil.fleet.offer_delivery import split_documents
from fdhil.fleet.signed_offer import Offer, _parse_offer, create_key, encode_canonical, read_offer, sign_offer
from fdhil.store.change_offers import ANSWERS_FILE, OfferDecision, add_decision, read_decisions
from tests.bench import bench_toml
from tests.fuzz.input_assessment import Target

_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
FOLDER = Path(_FOLDER.name)
TRUSTED = create_key(FOLDER / "key")
TOLD = {
    "name": "friction", "version": 3, "text": "t", "labels": {"type": "V"}, "axis_labels": {"screw": "A"},
    "values": {"axis.*.nominal.ft": 0.061, "nc.smoothing_s": (0.06,), "nc.profile": "fir"}, "stage": 1,
    "machines": ("mill-1",), "by": "Anna", "made_s": 1, "expires_s": 2,
}  # fmt: skip


def _read_message(data: bytes) -> None:
    for document in split_documents(data):
        with suppress(FdhilError):
            read_offer(document, {TRUSTED})


def _read_text(data: bytes) -> None:
    with suppress(NotEditable, ValueError):
        edit_toml(data.decode(), {"axis.X.nominal.ft": 0.061, "maintenance.ft": 0.5}, "friction version 3")


def _read_answers(data: bytes) -> None:
    (FOLDER / ANSWERS_FILE).write_bytes(data)
    read_decisions(FOLDER)


READERS = (_parse_offer, _read_message, _read_text, _read_answers)


def taste(data: bytes) -> None:
    """Read the bytes as the document selected by the first of them."""
    with suppress(FdhilError):
        READERS[data[0] % len(READERS) if data else 0](data[1:])


def target() -> Target:
    offer = Offer.model_validate(TOLD)
    add_decision(FOLDER, OfferDecision("friction", 3, 1, "d", "accepted", "Bert", "", 1.5, "c"))
    seeds = [
        encode_canonical(offer),
        sign_offer(offer, FOLDER / "key"),
        bench_toml("X").encode(),
        (FOLDER / ANSWERS_FILE).read_bytes(),
    ]
    words = [
        b"NaN",
        b"1e999",
        b"null",
        b"[]",
        b"{}",
        b'"values"',
        b"axis.*.",
        b"\\u0000",
        b"\n",
        json.dumps(TRUSTED).encode(),
    ]
    return Target("offer", [bytes([at]) + seed for at, seed in enumerate(seeds)], taste, words, 3500)
