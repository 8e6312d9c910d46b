"""A black box is read as the daemon read the bus; a file that is no log, or half of one, is reported."""

from __future__ import annotations

import contextlib
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.can.frame_history import format_candump
from fdhil.drivers.cia402 import candump_samples
from fdhil.drivers.cia402.candump_samples import decode_candump
from fdhil.errors import RecordingError
from tests.drivers.frame_builder import FrameBuilder, build_machine_config
from tests.drivers.test_pdo_decoder import check_rows, decode_all


def test_candump_log_gives_the_samples_of_the_bus() -> None:
    wire = FrameBuilder()
    found = decode_candump(format_candump("can0", wire.build_frames()).encode(), build_machine_config())["X"]
    received, _, _ = decode_all([wire.build_frames()])
    assert found.lost == 0
    for name in ("tick", "position_mm", "current_a", "offset_mm"):
        np.testing.assert_array_equal(getattr(found, name), received[name])
    check_rows(wire, {field.name: getattr(found, field.name) for field in fields(found)})


def test_lost_frame_is_a_counted_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candump_samples, "BLOCK_FRAMES", 64)
    lines = format_candump("can0", FrameBuilder().build_frames()).splitlines(keepends=True)
    feedback = [k for k, line in enumerate(lines) if " 181#" in line]
    found = decode_candump(
        "".join(line for k, line in enumerate(lines) if k != feedback[50]).encode(), build_machine_config()
    )["X"]
    assert found.lost == 1
    assert np.diff(found.tick).max() == 2


@pytest.mark.parametrize("frame", ["181#R8", "00000181#0102030405060708", "20000181#0000000000000000", "181##00102"])
def test_frames_of_other_kinds_give_no_samples(frame: str) -> None:
    lines = format_candump("can0", FrameBuilder().build_frames()).splitlines(keepends=True)
    foreign = [line for each in lines for line in (each, f"{each.split()[0]} can0 {frame}\n")]
    found, plain = (decode_candump("".join(each).encode(), build_machine_config())["X"] for each in (foreign, lines))
    assert found.lost == plain.lost
    np.testing.assert_array_equal(found.tick, plain.tick)
    np.testing.assert_array_equal(found.position_mm, plain.position_mm)


@pytest.mark.parametrize(
    ("log", "said"),
    [(b"", "not a candump log"), (b"PK\x03\x04 something else\n", "not a candump log"), (b"x" * 200, "more than")],
)
def test_invalid_log_is_refused(log: bytes, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candump_samples, "LARGEST_LOG", 100)
    with pytest.raises(RecordingError, match=said):
        decode_candump(log, build_machine_config())


@settings(deadline=None, max_examples=30)
@given(cut=st.integers(0, 2000), junk=st.binary(max_size=40))
def test_truncated_log_is_read_or_refused(cut: int, junk: bytes) -> None:
    log = format_candump("can0", FrameBuilder(n=60).build_frames()).encode()
    with contextlib.suppress(RecordingError):
        decode_candump(log[: min(cut, len(log))] + junk, build_machine_config())
