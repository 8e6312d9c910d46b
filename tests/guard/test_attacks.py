"""Garbage, floods and signals during a correction neither end the guard nor cost it a SYNC."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fdhil.guard import correction_table
from fdhil.guard.guard_socket import MAX_CLIENTS, MAX_LINE_BYTES
from tests.guard.test_guard_process import DEMAND, ENDS_S, OFFSET, Rig, check_limits

pytestmark = pytest.mark.usefixtures("processes")

STOPPING = (signal.SIGHUP, signal.SIGQUIT, signal.SIGINT, signal.SIGXCPU)
SURROGATE = "\\ud800"
VALUES = [
    "null", "true", "-1", "1e999", "-0.0", "9" * 4000, '""', f'"{SURROGATE}"', '"\\u0000"', "[]", "{}", "[[1]]",
    '{"a": {"b": []}}', "[" * 900 + "]" * 900, '"' + "x" * 5000 + '"', '"arm"',
]  # fmt: skip
REQUESTS = ["status", "alive", "table", "arm", "feedforward", "disarmed", "adopt", "stop", SURROGATE, ""]
FIELDS = ["token", "facts", "laws", "program_digest", "id", "axes", "request"]
LAW = '{"speed": %s, "torque": %s, "pace": %s, "dry": %s}'


def garbage() -> Iterator[bytes]:
    yield from (b"", b"\xff\xfe", b"NaN", b"[" * 20_000, b'{"a":' * 5_000, b"{", b'{"request": }', b"\0" * 100)
    for value in VALUES:
        yield value.encode()
        yield f'{{"request": {value}}}'.encode()
        law = LAW % ((value,) * 4)
        yield f'{{"request": "feedforward", "laws": {{"X": {law}, "Y": {law}}}}}'.encode()
        for request in REQUESTS:
            for field in FIELDS[:-1]:
                yield f'{{"request": "{request}", "{field}": {value}}}'.encode()
    for word in ("NaN", "Infinity", "-Infinity"):
        yield f'{{"request": "status", "id": {word}}}'.encode()


def connection(rig: Rig) -> socket.socket:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        made.connect(str(rig.run_directory / "guard.sock"))
    except OSError:
        made.close()
        raise
    made.setblocking(False)
    return made


def flood(rig: Rig, send: Callable[[socket.socket], object], ended: threading.Event) -> None:
    client = connection(rig)
    while not ended.wait(0.001):
        try:
            send(client)
        except BlockingIOError:
            continue
        except OSError:
            client.close()
            client = connection(rig)
    client.close()


def answer(client: socket.socket) -> dict[str, object]:
    client.setblocking(True)
    client.settimeout(ENDS_S)
    text = b""
    while not text.endswith(b"\n"):
        text += client.recv(1 << 16)
    return dict(json.loads(text))


def many(text: str) -> Callable[[socket.socket], object]:
    line = text.encode() + b"\n"
    return lambda client: client.send(line * (100_000 // len(line)))


def descriptors(folder: Path) -> list[int]:
    os.mkfifo(folder / "fifo")
    near, far = socket.socketpair()
    return [os.open(folder / "fifo", os.O_RDWR), near.detach(), far.detach(), os.memfd_create("unsealed"), *os.pipe()]


def memory_kb(rig: Rig) -> int:
    """Return the peak memory of the process, KB."""
    text = Path(f"/proc/{rig.process.pid}/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0])


def open_descriptors(rig: Rig) -> int:
    return len(list(Path(f"/proc/{rig.process.pid}/fd").iterdir()))


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


def test_running_correction_misses_no_sync_under_garbage_floods_and_signals(rig: Rig, tmp_path: Path) -> None:
    rig.arm()
    rig.settle()
    client = rig.client
    assert client is not None
    missed = client.read_status()["missed_cycles"]
    before_kb, before, armed_at = memory_kb(rig), open_descriptors(rig), rig.peer.tick
    wrong = descriptors(tmp_path)
    lines = list(garbage())
    ended = threading.Event()
    zeros = {"X": [0] * 900, "Y": [0] * 900}
    piece = correction_table.seal_table(correction_table.encode_table("XY", zeros, zeros, "another", 800, False))
    whole = correction_table.seal_table(
        correction_table.encode_table("XY", {a: [0] * 40_000 for a in "XY"}, {a: [0] * 40_000 for a in "XY"}, "other")
    )
    cursor = iter(lines * 1000)
    floods = [
        many('{"request": "status"}'),
        many('{"request": "arm", "token": "x"}'),
        many("x" * (MAX_LINE_BYTES + 10)),
        lambda client: client.send(next(cursor) + b"\n"),
        lambda client: socket.send_fds(client, [b'{"request": "table"}\n'], wrong),
        lambda client: socket.send_fds(client, [b'{"request": "alive"}\n'], wrong * 20),
        lambda client: socket.send_fds(client, [b'{"request": "table"}\n'], [piece]),
        lambda client: socket.send_fds(client, [b'{"request": "table"}\n'], [whole]),
        lambda client: client.shutdown(socket.SHUT_RDWR),
    ]
    threads = [threading.Thread(target=flood, args=(rig, send, ended)) for send in floods]
    ignored = signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM, *STOPPING} | {32, 33}
    try:
        for thread in threads:
            thread.start()
        rig.peer.playing = True
        for row in range(100, 700, 60):
            rig.peer.wait(lambda row=row: rig.peer.row > row, "the path")  # type: ignore[misc] # the loop's row
            for number in ignored:
                os.kill(rig.process.pid, number)
        rig.peer.wait(lambda: any(event.get("code") == "Finished" for event in rig.events()), "the end")
        rig.peer.wait(lambda: any(event.get("state") == "OFF" for event in rig.events()), "off")
    finally:
        ended.set()
        for thread in threads:
            thread.join()
        for descriptor in (*wrong, piece, whole):
            os.close(descriptor)
    events = rig.events()
    assert not any(event["event"] == "failed" for event in events)
    assert [event["missed"] for event in events if event.get("state") == "OFF"] == [missed]
    ticks = [tick for tick, _ in rig.peer.offsets_sent() if tick > armed_at]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    rows = {target: k for k, target in enumerate(DEMAND[0])}
    moving = [(t, o) for _, t, o in rig.peer.latched if DEMAND[0][50] < t[0] < DEMAND[0][-50]]
    assert [o for _, o in moving] == [(OFFSET[0][rows[t[0]]], OFFSET[1][rows[t[0]]]) for t, _ in moving]
    check_limits(rig)
    assert memory_kb(rig) - before_kb < 16_000
    assert client.read_status()["may_stand_um"] == {"X": 0.0, "Y": 0.0}
    rig.peer.wait(
        lambda: client.read_status()["ok"] and open_descriptors(rig) <= before + MAX_CLIENTS, "closed descriptors"
    )


@pytest.mark.fault("F13")
def test_stop_signals_ramp_down_before_the_exit(rig: Rig) -> None:
    rig.into_the_cut()
    assert abs(rig.peer.offsets_sent()[-1][1]) > 100
    for number in STOPPING:
        rig.process.send_signal(number)
    assert rig.process.wait(ENDS_S) == 0
    assert rig.peer.offsets_sent()[-1][1] == 0
    check_limits(rig)
    assert rig.events()[-1]["may_stand_um"] == {"X": 0.0, "Y": 0.0}


BROKEN = """
import sys
from fdhil.guard import __main__, guard_process
def fail(*_):
    raise {error}
guard_process.Guard.build_status = fail
sys.exit(__main__.main())
"""


@pytest.mark.parametrize("error", ["RuntimeError('lost')", "MemoryError"])
@pytest.mark.fault("F20")
def test_offset_is_ramped_to_zero_when_the_loop_fails(tmp_path: Path, error: str) -> None:
    rig = Rig(tmp_path, program=("-c", BROKEN.format(error=error)))
    try:
        client = connection(rig) if wait_for_ready(rig) else None
        assert client is not None
        with client:
            rig.into_the_cut_blindly()
            assert abs(rig.peer.offsets_sent()[-1][1]) > 100
            client.send(b'{"request": "status"}\n')
            assert rig.process.wait(ENDS_S) == 3
        assert [offset for _, offset in rig.peer.offsets_sent()[-3:]] == [0, 0, 0]
        check_limits(rig)
        failed, stopped = rig.events()[-2:]
        assert (failed["event"], failed["code"]) == ("failed", "InternalError")
        assert error.split("(")[0] in str(failed["text"])
        assert stopped["may_stand_um"] == {"X": None, "Y": None}
        assert "may still be applied" in str(stopped["text"])
    finally:
        rig.close()


def wait_for_ready(rig: Rig) -> bool:
    rig.peer.wait(lambda: any(e["event"] == "ready" for e in rig.events()), "the guard")
    return True


def test_second_request_waits_for_the_first_answer(rig: Rig) -> None:
    guard = rig.connect()
    rig.peer.stand()
    rig.peer.wait(lambda: guard.read_status()["tick"] == rig.peer.tick, "the last SYNC")
    idle = [connection(rig) for _ in range(2 * MAX_CLIENTS)]
    with connection(rig) as client:
        client.send(b'{"request": "arm", "id": 1}\n{"request": "arm", "id": 2}\n')
        reply = answer(client)
        assert (reply["id"], reply["code"]) == (2, "GuardBusy")
        client.send(b'{"request": "disarm", "id": 3}\n')
        reply = answer(client)
        assert (reply["id"], reply["code"]) == (1, "DisarmedSince")
        rig.peer.syncing = True
        reply = answer(client)
        assert (reply["id"], reply["ok"]) == (3, True)
        client.send(b'{"request": "sing", "id": "4"}\n{"request": ["status"], "id": 5.5}\n')
        assert [answer(client)["code"] for _ in range(1)] == ["BadRequest"]
    for each in idle:
        each.close()
