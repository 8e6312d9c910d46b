"""A black box is read as the daemon read the bus; a file that is no log, or half of one, is reported."""

from __future__ import annotations

import contextlib
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.can.frame_history import candump
from fdhil.drivers.cia402 import candump_samples
from fdhil.drivers.cia402.candump_samples import samples_of_log
from fdhil.errors import RecordingError
from tests.drivers.test_cia402_drive import check_rows, decode_all
from tests.drivers.wire import Wire, machine


def test_a_log_gives_the_samples_that_the_bus_gave() -> None:
    wire = Wire()
    found = samples_of_log(candump("can0", wire.frames()).encode(), machine())["X"]
    heard, _, _ = decode_all([wire.frames()])
    assert found.lost == 0
    for name in ("tick", "position_mm", "current_a", "offset_mm"):
        np.testing.assert_array_equal(getattr(found, name), heard[name])
    check_rows(wire, {field.name: getattr(found, field.name) for field in fields(found)})


def test_a_lost_frame_is_a_hole_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candump_samples, "BLOCK_FRAMES", 64)
    lines = candump("can0", Wire().frames()).splitlines(keepends=True)
    feedback = [k for k, line in enumerate(lines) if " 181#" in line]
    found = samples_of_log("".join(line for k, line in enumerate(lines) if k != feedback[50]).encode(), machine())["X"]
    assert found.lost == 1
    assert np.diff(found.tick).max() == 2


@pytest.mark.parametrize("frame", ["181#R8", "00000181#0102030405060708", "20000181#0000000000000000", "181##00102"])
def test_frames_of_other_kinds_give_no_samples(frame: str) -> None:
    lines = candump("can0", Wire().frames()).splitlines(keepends=True)
    foreign = [line for each in lines for line in (each, f"{each.split()[0]} can0 {frame}\n")]
    found, plain = (samples_of_log("".join(each).encode(), machine())["X"] for each in (foreign, lines))
    assert found.lost == plain.lost
    np.testing.assert_array_equal(found.tick, plain.tick)
    np.testing.assert_array_equal(found.position_mm, plain.position_mm)


@pytest.mark.parametrize(
    ("log", "said"),
    [(b"", "not a candump log"), (b"PK\x03\x04 something else\n", "not a candump log"), (b"x" * 200, "more than")],
)
def test_what_is_no_log_is_said(log: bytes, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candump_samples, "LARGEST_LOG", 100)
    with pytest.raises(RecordingError, match=said):
        samples_of_log(log, machine())


@settings(deadline=None, max_examples=30)
@given(cut=st.integers(0, 2000), junk=st.binary(max_size=40))
def test_a_log_that_was_cut_anywhere_is_read_or_refused(cut: int, junk: bytes) -> None:
    log = candump("can0", Wire(n=60).frames()).encode()
    with contextlib.suppress(RecordingError):
        samples_of_log(log[: min(cut, len(log))] + junk, machine())
