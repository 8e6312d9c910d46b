"""The bridge without LinuxCNC: published cycles, their time, and listeners that cannot delay it."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import pytest

from fdhil.bridges.linuxcnc import MOST_LISTENERS, MOST_WAITING, NAME, Cycle, StatePublisher, Status, TcpBroadcast

MS = 1_000_000
STATUS = Status(1.0, 1.0, False, 2, "part.ngc")


def cycle(number: int, place: float, kind: int, line: int = 1, held: bool = False) -> Cycle:
    return Cycle(number, (place, place, 0.0), kind, line, 10.0, 20.0, held)


def select_states(
    cycles: Sequence[Cycle], status: Status = STATUS, axes: str = "XYZ", mm: float = 1.0
) -> list[dict[str, Any]]:
    publisher = StatePublisher(list(axes), mm, MS)
    publisher.update_clock(cycles[0].number, 1000 * MS)
    return [state for each in cycles for state in publisher.select_states(each, status)]


def test_each_change_is_published_with_its_previous_cycle() -> None:
    cycles = [cycle(k, 0.0, 0, 0) for k in range(10)] + [cycle(10 + k, k + 1.0, 1) for k in range(35)]
    cycles += [cycle(45 + k, 36.0 + k, 3, 2) for k in range(5)]
    states = [(state["cycle"], state["motion"], state["line"]) for state in select_states(cycles)]
    assert states == [
        (0, "rest", None), (9, "rest", None), (10, "rapid", 1), (20, "rapid", 1), (30, "rapid", 1), (40, "rapid", 1),
        (44, "rapid", 1), (45, "arc", 2),
    ]  # fmt: skip


def test_pause_is_a_hold_once_the_machine_stands_still() -> None:
    cycles = [cycle(0, 0.0, 1), cycle(1, 1.0, 1, held=True), cycle(2, 1.0, 1, held=True)]
    assert [(state["motion"], state["feed_hold"]) for state in select_states(cycles)] == [
        ("rapid", False), ("rapid", True), ("hold", True),
    ]  # fmt: skip
    paused = select_states([cycle(0, 0.0, 2), cycle(1, 0.0, 2)], STATUS._replace(paused=True))
    assert paused[-1]["motion"] == "hold"


def test_motion_outside_a_program_is_unknown() -> None:
    assert [select_states([cycle(0, 0.0, kind)])[0]["motion"] for kind in (4, 5, 6)] == ["unknown", "feed", "unknown"]


def test_inches_are_converted_and_the_first_joint_of_an_axis_is_published() -> None:
    (state,) = select_states([Cycle(0, (1.0, 2.0, 3.0), 1, 1, 0.1, 0.2, False)], axes="XXZ", mm=25.4)
    assert state["mm"] == pytest.approx({"X": 25.4, "Z": 76.2})
    assert state["feed_mm_min"] == pytest.approx(0.1 * 25.4 * 60)


def test_late_cycle_gets_an_unbiased_stamp() -> None:
    publisher = StatePublisher(["X"], 1.0, MS)
    publisher.update_clock(100, 1000 * MS)
    publisher.update_clock(110, 1060 * MS)  # 50 ms late
    (state,) = publisher.select_states(cycle(110, 0.0, 0), STATUS)
    assert abs(state["stamp_ns"] - 1010 * MS) < MS


def test_listener_that_does_not_read_is_dropped_without_delaying_others() -> None:
    listeners = TcpBroadcast("127.0.0.1", 0, b"greeting\n")
    with socket.create_connection(("127.0.0.1", listeners.port)) as reads:
        with socket.create_connection(("127.0.0.1", listeners.port)) as sleeps:
            sleeps.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            listeners.send_lines(b"first\n")
            with reads.makefile("rb") as lines:
                assert [lines.readline(), lines.readline()] == [b"greeting\n", b"first\n"]
                line = b"x" * 65535 + b"\n"
                for _ in range(20 * MOST_WAITING // len(line)):
                    listeners.send_lines(line)
                    assert lines.readline() == line
        listeners.send_lines(b"last\n")
    listeners.close()


def test_idle_listeners_do_not_block_others() -> None:
    listeners = TcpBroadcast("127.0.0.1", 0, b"greeting\n")
    held = []
    for _ in range(MOST_LISTENERS + 2):
        held.append(socket.create_connection(("127.0.0.1", listeners.port)))
        listeners.send_lines(b"")
    with held[0].makefile("rb") as first, held[-1].makefile("rb") as last:
        assert (first.readline(), first.readline(), last.readline()) == (b"greeting\n", b"", b"greeting\n")
    for each in held:
        each.close()
    listeners.close()


@pytest.mark.usefixtures("processes")
def test_printed_hal_line_names_the_bridge() -> None:
    done = subprocess.run([sys.executable, "-m", "fdhil.bridges"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"loadusr -Wn {NAME} /usr/bin/python3 /")
    assert done.stdout.endswith("/fdhil/bridges/linuxcnc.py\n")


def test_published_states_are_read_by_the_nc_source() -> None:
    (state,) = select_states([cycle(0, 1.5, 1)])
    assert json.loads(json.dumps(state))["mm"] == {"X": 1.5, "Y": 1.5, "Z": 0.0}
