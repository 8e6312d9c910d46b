"""A signed or unsigned offer, and the file of the answers: read, or refused with a message."""

from __future__ import annotations

import json
import tempfile
from contextlib import suppress
from pathlib import Path

from fdhil.config.toml_editing import NotEditable, edit_toml
from fdhil.errors import FdhilError
from fdhil.fleet.delivery import parted
from fdhil.fleet.offer import Offer, _parsed, canonical, make_key, read, sign
from fdhil.store.offers import ANSWERS_FILE, Answer, add_answer, read_answers
from tests.bench import bench_toml
from tests.fuzz.tasting import Target

_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
FOLDER = Path(_FOLDER.name)
TRUSTED = make_key(FOLDER / "key")
TOLD = {
    "name": "friction", "version": 3, "text": "t", "labels": {"type": "V"}, "axis_labels": {"screw": "A"},
    "values": {"axis.*.nominal.ft": 0.061, "nc.smoothing_s": (0.06,), "nc.profile": "fir"}, "stage": 1,
    "machines": ("mill-1",), "by": "Anna", "made_s": 1, "expires_s": 2,
}  # fmt: skip


def _of_message(data: bytes) -> None:
    for document in parted(data):
        with suppress(FdhilError):
            read(document, {TRUSTED})


def _of_text(data: bytes) -> None:
    with suppress(NotEditable, ValueError):
        edit_toml(data.decode(), {"axis.X.nominal.ft": 0.061, "maintenance.ft": 0.5}, "friction version 3")


def _of_answers(data: bytes) -> None:
    (FOLDER / ANSWERS_FILE).write_bytes(data)
    read_answers(FOLDER)


READERS = (_parsed, _of_message, _of_text, _of_answers)


def taste(data: bytes) -> None:
    """Read the bytes as the document selected by the first of them."""
    with suppress(FdhilError):
        READERS[data[0] % len(READERS) if data else 0](data[1:])


def target() -> Target:
    offer = Offer.model_validate(TOLD)
    add_answer(FOLDER, Answer("friction", 3, 1, "d", "accepted", "Bert", "", 1.5, "c"))
    seeds = [
        canonical(offer),
        sign(offer, FOLDER / "key"),
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
