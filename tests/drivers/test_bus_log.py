"""A log of the bus becomes another program's log with the same frames."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import can
import pytest

from fdhil.store import suffixes
from tests.daemon.shop import fdhil

CANDUMP = (
    "(12.000100) can0 080#05\n"
    "(12.000200) can0 181#0102030405060708\n"
    "(12.000300) can0 18FF0102#AABB\n"
    "(12.001100) can0 701#7F\n"
)
Frame = tuple[float, int, bool, bytes]


def _frames(path: Path) -> list[Frame]:
    with can.LogReader(path) as reader:
        return [(m.timestamp, m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in reader]


@pytest.mark.parametrize("name", suffixes.BUS_LOGS.values())
def test_the_frames_of_a_candump_come_back_from_each_format(name: str, tmp_path: Path, capsys: Any) -> None:
    log, out, back = (
        tmp_path / "bus.log",
        tmp_path / f"bus2{suffixes.suffix_of(suffixes.BUS_LOGS, name)}",
        tmp_path / "back.log",
    )
    log.write_text(CANDUMP)
    code, told, _ = fdhil("export", log, "--out", out, "--json", capsys=capsys)
    assert (code, json.loads(told)["frames"]) == (0, 4)
    assert [frame[1:] for frame in _frames(out)] == [frame[1:] for frame in _frames(log)]
    steps = [round(b[0] - a[0], 4) for a, b in zip(_frames(out), _frames(out)[1:], strict=False)]
    assert steps == [0.0001, 0.0001, 0.0008]
    assert fdhil("export", out, "--out", back, "--format", "candump", capsys=capsys)[0] == 0
    assert [frame[1:] for frame in _frames(back)] == [frame[1:] for frame in _frames(log)]


def test_a_log_is_no_recording_and_an_empty_one_is_told(tmp_path: Path, capsys: Any) -> None:
    log = tmp_path / "bus.log"
    log.write_text(CANDUMP)
    code, _, err = fdhil("export", log, "--out", tmp_path / "bus.csv", capsys=capsys)
    assert (code, "is a log of the bus, which becomes candump, blf, asc, trc" in err) == (2, True)
    log.write_text("\n")
    code, _, err = fdhil("export", log, "--out", tmp_path / "bus.blf", capsys=capsys)
    assert (code, "has no frame" in err or "no log of a bus" in err) == (3, True)
    assert not (tmp_path / "bus.blf").exists()
