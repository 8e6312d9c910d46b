"""status, arm and disarm with a fake daemon; refusals of run."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from fdhil.arming.operator_token import ensure_token
from fdhil.cli.status_view import describe_model, draw_sparkline
from fdhil.config import load_config
from fdhil.daemon import service_log
from fdhil.daemon.daemon_status import DaemonStatus
from fdhil.records import Notice
from fdhil.report.parameter_format import compute_half_width, format_cell
from tests.daemon.machine_rig import BENCH, fdhil
from tests.daemon.simulated_machine import config_of
from tests.reserved_port import reserve_port
from tests.store.sample_records import make_outcome, make_published
from tests.unprivileged_command import UNPRIVILEGED


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    (tmp_path / "p.ngc").touch()
    run = tmp_path / "fdhil-data" / "run"
    run.mkdir(parents=True)
    ensure_token(run)
    return path


@contextmanager
def serve_answers(machine: Path, answer: Mapping[str, Any], *told: Mapping[str, Any]) -> Iterator[list[dict[str, Any]]]:
    """Fake the daemon: accept one request, report its progress, and send ``answer``."""
    requests: list[dict[str, Any]] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(str(machine.parent / "fdhil-data" / "run" / "daemon.sock"))
        server.listen()

        def serve() -> None:
            peer, _ = server.accept()
            with peer, peer.makefile("rb") as lines:
                requests.append(json.loads(lines.readline()))
                for progress in told:
                    peer.sendall(json.dumps({"progress": progress}).encode() + b"\n")
                peer.sendall(json.dumps(answer).encode() + b"\n")

        thread = threading.Thread(target=serve)
        thread.start()
        yield requests
        thread.join(10)


def make_status(tmp_path: Path) -> dict[str, Any]:
    watch = DaemonStatus(config_of(tmp_path, ("X", "Y")), 0.0)
    for reported in (make_outcome(), make_published(), Notice("LoadChanged", "MAJOR", "[red]Jt rose[/red]", "X")):
        watch.take_outcome(reported, 1.0)
    store = {"directory": "d", "fault": "DiskFull", "strays": []}
    return {"ok": True, "state": "OFF(SHADOW)", **watch.build_status(2.0), "counters": {"frames": 7}, "store": store}


def test_status_is_printed_as_table_and_json(machine: Path, tmp_path: Path, capsys: Any) -> None:
    with serve_answers(machine, make_status(tmp_path)) as requests:
        code, out, err = fdhil("status", machine, capsys=capsys)
    assert (code, err, requests) == (0, "", [{"request": "status"}])
    received = ("bench", "no SYNC yet", "frames received 7, lost 0")
    for words in (*received, "1/0", "DiskFull", "[red]Jt rose[/red]", "OFF"):
        assert words in out, (words, out)
    (machine.parent / "fdhil-data" / "run" / "daemon.sock").unlink()
    with serve_answers(machine, make_status(tmp_path)):
        code, out, _ = fdhil("status", machine, "--json", capsys=capsys)
    assert json.loads(out)["axes"]["X"]["parameters"]["K"]["value"] == 0.8


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize(
    ("guard", "shown"),
    [
        (
            {"state": "lost", "last_state": "ACTIVE", "heard_s_ago": 20.0, "text": "the guard is gone; -38 um stands"},
            ("guard lost, last seen 20 s ago in state ACTIVE", "the guard is gone; -38 um stands"),
        ),
        (
            {"state": "FROZEN", "heard_s_ago": 0.3},
            ("guard FROZEN", "-4.6 um on axis X may still be applied; hold the feed, then run fdhil adopt"),
        ),
        ({"state": "ACTIVE", "heard_s_ago": 7.0}, ("guard ACTIVE at its last answer, 7 s ago",)),
    ],
)
def test_status_shows_residual_offset_and_age_of_guard_answer(
    guard: dict[str, Any], shown: tuple[str, ...], machine: Path, tmp_path: Path, capsys: Any
) -> None:
    stands = {"nothing": False, "text": "-4.6 um on axis X may still be applied"}
    with serve_answers(
        machine, {**make_status(tmp_path), "state": guard["state"], "guard": guard, "may_stand": stands}
    ):
        _, out, _ = fdhil("status", machine, capsys=capsys)
    assert all(text in " ".join(out.split()) for text in shown), out


def test_status_shows_predicted_and_measured_error(machine: Path, tmp_path: Path, capsys: Any) -> None:
    armed = {"program": "p.ngc", "promise": "contour error 23.5 um RMS is predicted to become 0.30 ± 0.40 um RMS"}
    passes = [{"text": f"pass {k} of p.ngc: contour error measured 0.70 um RMS"} for k in range(5)]
    with serve_answers(machine, {**make_status(tmp_path), "armed": armed, "passes": passes}):
        _, out, _ = fdhil("status", machine, capsys=capsys)
    assert "armed: p.ngc, contour error 23.5 um RMS is predicted to become 0.30 ± 0.40 um RMS" in " ".join(out.split())
    assert ("pass 4 of p.ngc" in out, "pass 1 of p.ngc" in out) == (True, False)


def test_status_shows_refusals_of_armed_program(machine: Path, tmp_path: Path, capsys: Any) -> None:
    check = {"checked_s": 90.0, "whole": False, "refused": ["DemandTooHigh: line [7]: axis X", "HarmPredicted: line 9"]}
    with serve_answers(machine, {**make_status(tmp_path), "armed": {"program": "p.ngc", "check": check}}):
        _, out, _ = fdhil("status", machine, capsys=capsys)
    assert "the correction ends early: DemandTooHigh: line [7]: axis X" in out
    assert "the correction ends early: HarmPredicted: line 9" in out


def test_arm_sends_token_and_prints_predicted_gain(machine: Path, tmp_path: Path, capsys: Any) -> None:
    with serve_answers(machine, {"ok": True, "text": "armed p.ngc"}) as requests:
        arguments = ("arm", machine, tmp_path / "p.ngc", "--method", "mirror", "--whole")
        code, out, _ = fdhil(*arguments, capsys=capsys)
    assert (code, out) == (0, "armed p.ngc\n")
    token = (machine.parent / "fdhil-data" / "run" / "token").read_text()
    program = str((tmp_path / "p.ngc").resolve())
    wanted = {"request": "arm", "program": program, "method": "mirror", "whole": True, "token": token, "progress": True}
    wanted["config_digest"] = load_config(machine).digest
    assert requests == [wanted]


def test_refusal_exits_1_with_code_cause_and_action(machine: Path, tmp_path: Path, capsys: Any) -> None:
    answer = {"ok": False, "code": "PoorSkill", "text": "predictions are bad", "advice": "identify again"}
    with serve_answers(machine, answer):
        code, out, err = fdhil("arm", machine, tmp_path / "p.ngc", capsys=capsys)
    assert (code, out, err) == (1, "", "refused: PoorSkill: predictions are bad; identify again\n")
    (machine.parent / "fdhil-data" / "run" / "daemon.sock").unlink()
    with serve_answers(machine, answer):
        code, out, _ = fdhil("disarm", machine, "--json", capsys=capsys)
    assert (code, json.loads(out)) == (1, answer)


@pytest.mark.parametrize("edited", ["[axis.X", "[axis.X]\nscrew_pitch_mm = 0\n", "\0", "[store]\nkeep_windows = 0"])
def test_disarm_works_with_faulty_configuration(
    edited: str, machine: Path, capsys: Any, caplog: pytest.LogCaptureFixture
) -> None:
    machine.write_text(edited)
    with serve_answers(machine, {"ok": True, "text": "guard: OFF, offset 0"}) as requests:
        code, out, _ = fdhil("disarm", machine, capsys=capsys)
    assert (code, out, requests) == (0, "guard: OFF, offset 0\n", [{"request": "disarm"}])
    assert str(machine) in caplog.text
    missing = fdhil("status", machine.with_name("none.toml"), capsys=capsys)[0]
    assert fdhil("status", machine, capsys=capsys)[0] == 2
    assert fdhil("disarm", machine.with_name("none.toml"), capsys=capsys)[0] == missing
    shutil.rmtree(machine.parent / "fdhil-data")
    assert fdhil("disarm", machine, capsys=capsys)[0] == 2


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("how", ["--json", "in words"])
def test_undelivered_refusal_exits_3(how: str, machine: Path) -> None:
    """Without a reader the residual offset would be unknown, which exit code 0 would hide."""
    refused = {"ok": False, "code": "OffsetStands", "text": "30 um may still be applied", "advice": "hold the feed"}
    command = [sys.executable, "-m", "fdhil", "disarm", str(machine), *(["--json"] if how == "--json" else [])]
    read, write = os.pipe()
    os.close(read)  # the reader has closed the pipe
    out, err = (write, subprocess.PIPE) if how == "--json" else (subprocess.DEVNULL, write)
    with serve_answers(machine, refused):
        done = subprocess.run(command, stdout=out, stderr=err, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr or "") == (3, "")


def test_arm_shows_progress_of_program_check(machine: Path, capsys: Any) -> None:
    reported = {"program": "p.ngc", "checked_s": 83.0, "line": 40, "times_real_time": 31.6, "refused": 2}
    refused = {"ok": False, "code": "A", "text": "one", "advice": "do", "refused": ["A: one", "B: two"]}
    with serve_answers(machine, refused, reported | {"refused": 0}, reported):
        code, out, err = fdhil("arm", machine, machine.parent / "p.ngc", capsys=capsys)
    assert (code, out) == (1, "")
    assert "\rchecked 1:23 of the program, line 40, 32 x real time, 2 positions refused" in err
    assert err.splitlines()[-2:] == ["refused: A: one; do", "also: B: two"]
    (machine.parent / "fdhil-data" / "run" / "daemon.sock").unlink()
    with serve_answers(machine, refused, reported):
        code, out, err = fdhil("arm", machine, machine.parent / "p.ngc", "--json", capsys=capsys)
    assert (code, json.loads(out)) == (1, refused)
    assert json.loads(err) == {"progress": reported}


@pytest.mark.parametrize("command", ["status", "disarm"])
def test_missing_daemon_exits_3_with_advice(command: str, machine: Path, capsys: Any) -> None:
    code, out, err = fdhil(command, machine, capsys=capsys)
    assert (code, out) == (3, "")
    assert "fdhil run CONFIG" in err


@pytest.mark.usefixtures("processes")
def test_daemon_without_permission_is_not_reported_as_missing(machine: Path) -> None:
    """The advice to start a daemon would start a second one."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        place = machine.parent / "fdhil-data" / "run" / "daemon.sock"
        server.bind(str(place))
        server.listen()
        place.chmod(0)
        command = [*UNPRIVILEGED, sys.executable, "-m", "fdhil", "status", str(machine)]
        done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (3, "")
    assert "daemon: does not accept this user (Permission denied), so that it is unknown whether it runs" in done.stderr
    assert "start it" not in done.stderr


def test_program_unreadable_for_daemon_exits_3(machine: Path, tmp_path: Path, capsys: Any) -> None:
    answer = {"ok": False, "code": "ProgramError", "text": "line 1: G77 is not known", "advice": "correct it"}
    with serve_answers(machine, {**answer, "exit_code": 3}):
        code, out, err = fdhil("arm", machine, tmp_path / "p.ngc", capsys=capsys)
    assert (code, out, err) == (3, "", "refused: ProgramError: line 1: G77 is not known; correct it\n")


def test_wrong_method_or_config_exits_2(machine: Path, tmp_path: Path, capsys: Any) -> None:
    assert fdhil("arm", machine, machine.parent / "p.ngc", "--method", "magic", capsys=capsys)[0] == 2
    (tmp_path / "wrong.toml").write_text(BENCH.replace("speed_kp", "speed_kq"))
    code, _, err = fdhil("run", tmp_path / "wrong.toml", capsys=capsys)
    assert code == 2
    assert "did you mean 'speed_kp'?" in err


def test_run_on_missing_bus_exits_3_with_one_sentence(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "machine.toml"
    with reserve_port() as port:
        path.write_text(f'{BENCH}[bus.can0]\ninterface = "socketcand"\nport = {port}\n')
        code, out, err = fdhil("run", path, "--method", "least_squares", capsys=capsys)
    assert (code, out) == (3, "")
    assert err.splitlines()[-1].startswith("fdhil: ")
    assert "Traceback" not in err


def test_sparkline_spans_lowest_to_highest() -> None:
    assert draw_sparkline([1.0, 2.0, 3.0]) == "▁▅█"
    assert draw_sparkline([1.0, 1.0]) == "▁▁"
    assert format_cell("R", 0.5, compute_half_width({"low": 0.488, "high": 0.512}), " ") == "500 ±12"
    assert format_cell("K", 0.8, compute_half_width({"low": None, "high": None}), " ") == "0.8 (no ±)"
    assert format_cell("K", None, None) == "-"
    # value and half width end at the same digit
    assert format_cell("bus_sag", 1.4234e-6, 6.4e-8, " ") == "(1.42 ±0.06)e-6"
    assert format_cell("bus_sag", 0.0053, 2.3e-5, " ") == "0.00530 ±0.00002"
    assert format_cell("bus_sag", 12_345.0, 234.0, " ") == "12300 ±200"
    assert format_cell("bus_sag", 1.2345e7, 2.34e5, " ") == "(1.23 ±0.02)e7"


def test_daemon_log_lines_are_json(capsys: pytest.CaptureFixture[str]) -> None:
    """One JSON object per line on stdout, only with --json."""
    with service_log.write_lines_as_json(True):
        service_log.write_line("X: LoadChanged", "MAJOR")
    with service_log.write_lines_as_json(False):
        service_log.write_line("X: said to a person")
    message = capsys.readouterr()
    line = json.loads(message.out)
    assert datetime.fromisoformat(line.pop("time")).tzinfo is not None
    assert line == {"severity": "MAJOR", "text": "X: LoadChanged"}
    assert "said to a person" in message.err


def test_status_shows_terms_and_warnings() -> None:
    load = {"value": 2.5, "std": 0.01, "low": 2.48, "high": 2.52, "unit": "N.m"}
    axis = {"terms": {"load": load}, "unexplained_um": 0.25, "warnings": ["OneDirection: all moves go one way"]}
    reported = "load 2.50 ±0.02 N.m; 0.25 um of the rapids unexplained; OneDirection: all moves go one way"
    assert describe_model(axis) == reported
    assert describe_model({"terms": None, "unexplained_um": None, "warnings": []}) == ""


NOTICE = {"number": 41, "time": "2026-11-22T13:47:00+00:00", "axis": "X", "code": "GuardTripped", "severity": "MAJOR",
          "text": "EchoMismatch: why", "acknowledged": None}  # fmt: skip


def test_notices_are_acknowledged_by_number(machine: Path, capsys: Any) -> None:
    with serve_answers(machine, {"ok": True, "text": "notice 41 acknowledged by me; 0 more are open"}) as asked:
        code, out, _ = fdhil("acknowledge", machine, "41", "--note", "seen", capsys=capsys)
    assert (code, out) == (0, "notice 41 acknowledged by me; 0 more are open\n")
    (request,) = asked
    assert (request["request"], request["notices"], request["note"]) == ("acknowledge", [41], "seen")
    assert request["by"]


def test_unknown_notice_number_is_refused(machine: Path, capsys: Any) -> None:
    for arguments in ((), ("41", "--all")):
        assert fdhil("acknowledge", machine, *arguments, capsys=capsys)[0] == 2
    refused = {"ok": False, "code": "NoSuchNotice", "text": "there is no notice 7", "advice": "see fdhil status"}
    with serve_answers(machine, refused):
        code, _, err = fdhil("acknowledge", machine, "7", capsys=capsys)
    assert (code, err) == (1, "refused: NoSuchNotice: there is no notice 7; see fdhil status\n")


def test_status_shows_pending_and_acknowledged_notices(machine: Path, tmp_path: Path, capsys: Any) -> None:
    status = make_status(tmp_path)
    given = {"who": "anna", "time": "2026-11-22T14:00:00+00:00", "note": ""}
    notice = {"age_s": 5.0, **NOTICE, "acknowledged": given}
    since = {"since": "2026-11-22T14:00:00+00:00", "until": None, "first": "2026-11-22T13:00:00+00:00"}
    alarm = {
        "code": "HeartbeatLost",
        "axis": "X",
        "severity": "MAJOR",
        "text": "no heartbeat",
        "state": "active",
        "count": 8,
    }
    alarms = {"active": 1, "unacknowledged": 0, "first": [{**alarm, **since}]}
    reported = status | {
        "unacknowledged": {"count": 3, "MAJOR": 1, "newest": []},
        "notices": [notice],
        "alarms": alarms,
    }
    with serve_answers(machine, reported):
        out = fdhil("status", machine, capsys=capsys)[1]
    assert "X: HeartbeatLost active since 2026-11-22T14:00:00+00:00, 8 times since" in " ".join(out.split())
    assert "pending notices: 3, of them MAJOR 1" in out
    assert "41" in out
    assert "(acknowledged by anna)" in " ".join(out.split())


def test_status_watch_repeats_until_ctrl_c(
    machine: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("fdhil.cli.daemon_commands.time.sleep", wait)
    with serve_answers(machine, make_status(tmp_path)):
        code, out, err = fdhil("status", machine, "--watch", "--json", capsys=capsys)
    assert (code, len(out.splitlines()), len(waits)) == (0, 1, 2)
    assert json.loads(out)["axes"]["X"]["parameters"]["K"]["value"] == 0.8
    assert "daemon" in err  # only one answer; the second poll reports this, and watching continues
