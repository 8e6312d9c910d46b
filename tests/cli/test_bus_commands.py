"""scan, check and commission with the simulator as a separate process behind its hub."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import can
import pytest

from fdhil.cli.main import cli, run_safely
from fdhil.commissioning.commissioning_record import load_record
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.record_comparison import RECORD_POINT
from fdhil.commissioning.traffic_listener import LISTEN_S
from fdhil.commissioning.void_mark import is_record_void, mark_record_void
from fdhil.config import load_config
from fdhil.sim.drive.drive_objects import compute_serial_number
from fdhil.sim.wire.tcp_hub import TcpHub
from tests.arming.guard_peer import GuardPeer
from tests.sim.hub_thread import HubThread
from tests.sim.simulator_process import SimulatorProcess, write_config

# other waits than on a real machine: module, name, value
WAITS: tuple[tuple[str, str, float], ...] = (
    ("commissioning.scan", "LISTEN_S", 0.3),
    ("commissioning.scan", "ANSWER_S", 1.0),
    ("commissioning.config_check", "LISTEN_S", 0.3),
    ("commissioning.drive_survey", "LISTEN_S", 0.3),
    ("commissioning.commissioning_steps", "SETTLE_CYCLES", 120),
    ("commissioning.commissioning_steps", "AVERAGE_CYCLES", 400),
    ("commissioning.watchdog", "STARVE_TIMEOUT_S", 15.0),  # simulated drives are slower on a slow host
    ("drivers.can.sdo_channel", "RESPONSE_TIMEOUT_S", 5.0),
    ("drivers.can.sdo_channel", "DEADLINE_S", 20.0),
    ("drivers.can.sdo_channel", "QUIET_S", 0.1),
)
# fdhil as a process of its own with these waits
QUICK = f"""
import importlib
for module, name, value in {WAITS!r}:
    setattr(importlib.import_module("fdhil." + module), name, value)
from fdhil.cli.main import main
main()
"""


@dataclass
class CommissioningBench:
    twin: SimulatorProcess
    folder: Path

    def write_config(
        self, name: str = "bench.toml", old: str = "", new: str = "", voltage: str = "", axes: str = "XY"
    ) -> Path:
        folder = self.folder / Path(name).stem
        folder.mkdir(exist_ok=True)
        port = self.twin.bus_settings["port"]
        path = write_config(folder, bus=f'interface = "socketcand"\nport = {port}', voltage=voltage)
        path.write_text(path.read_text().replace(old, new, 1))
        return path

    def set_object(self, index: int, value: int) -> None:
        with self.twin.join_bus() as bus:
            size = {0x6007: 2, 0x6065: 4, 0x1017: 2, 0x1801: 1}[index]
            head = 0x23 | (4 - size) << 2
            bus.send(make_message(0x601, bytes([head, index & 0xFF, index >> 8, 0]) + value.to_bytes(4, "little")))
            assert answer_of(bus, 0x581)[0] == 0x60


def make_message(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def answer_of(bus: can.BusABC, can_id: int) -> bytes:
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        received = bus.recv(1.0)
        if received is not None and received.arbitration_id == can_id:
            return bytes(received.data)
    raise AssertionError(f"no {can_id:03X}")


Said = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run_fdhil(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Said:
    """Run a command in this process with shorter waits; return exit code, stdout and stderr."""
    for module, name, value in WAITS:
        monkeypatch.setattr(f"fdhil.{module}.{name}", value)

    def run(*arguments: object, said: str = "") -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["fdhil", *map(str, arguments)])
        monkeypatch.setattr(sys, "stdin", io.StringIO(said))
        code = run_safely(cli)
        received = capsys.readouterr()
        return code, received.out, received.err

    return run


def parse_document(fdhil: Said, *arguments: object, code: int = 0) -> dict[str, Any]:
    got, out, err = fdhil(*arguments, "--json")
    assert got == code, err
    found: dict[str, Any] = json.loads(out)
    assert found["schema"] == f"fdhil-{arguments[0]}-1"
    return found


def list_points(checked: dict[str, Any], state: str) -> dict[str, dict[str, str]]:
    return {f"{p['place']} {p['point']}": p for p in checked["points"] if p["state"] == state}


@pytest.fixture(scope="module")
def commissioning_bench(tmp_path_factory: pytest.TempPathFactory, processes: None) -> Iterator[CommissioningBench]:
    folder = tmp_path_factory.mktemp("bench")
    with SimulatorProcess(write_config(folder)) as twin:
        yield CommissioningBench(twin, folder)


@pytest.mark.usefixtures("processes")
def test_scan_lists_drives_with_their_eds(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    eds = commissioning_bench.twin.ready["drives"]["X"]["eds"]
    found = parse_document(run_fdhil, "scan", commissioning_bench.write_config(), "--eds", eds)
    (bus,) = found["buses"]
    assert (bus["bus"], bus["master"]) == ("can0", None)
    assert [(node["node_id"], node["axis"], node["nmt"]) for node in bus["nodes"]] == [
        (1, "X", "pre-operational"),
        (2, "Y", "pre-operational"),
    ]
    answers = bus["nodes"][1]["answers"]
    assert answers["identity"] == {
        "vendor_id": 0x46444849,
        "product_code": 0x402,
        "revision": 0x10000,
        "serial": compute_serial_number(load_config(commissioning_bench.write_config()), "Y"),
    }
    assert answers["name"] == "fdhil twin drive"
    assert answers["device_type"] & 0xFFFF == 402
    assert answers["heartbeat_s"] == 0.1
    assert answers["eds"] == {"file": Path(eds).name, "fit": "exact"}
    assert bus["nodes"][0]["heartbeat_s"] == pytest.approx(0.1, rel=0.5)


@pytest.mark.usefixtures("real_time")
def test_scan_prints_readable_table(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    code, out, err = run_fdhil("scan", commissioning_bench.write_config())
    assert (code, err) == (0, "")
    for words in ("no NC is active; 2 nodes", "pre-operational", "fdhil twin drive", "CiA 402", "no match"):
        assert words in out


def test_invalid_eds_is_reported(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    wrong = commissioning_bench.folder / "wrong.eds"
    wrong.write_text("no eds")
    code, out, err = run_fdhil("scan", commissioning_bench.write_config(), "--eds", wrong)
    assert (code, out) == (3, "")
    assert "wrong.eds: line 1: it has no object" in err


@pytest.mark.usefixtures("real_time")
def test_check_reports_matching_machine(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    code, out, err = run_fdhil("check", commissioning_bench.write_config())
    assert (code, err) == (0, "")
    assert "points ok, 0 differ" in out
    found = parse_document(run_fdhil, "check", commissioning_bench.write_config())
    assert found["matches"] is True
    assert found["complete"] is True
    for axis in "XY":
        names = {p["point"] for p in found["points"] if p["place"] == f"axis {axis}"}
        assert {
            "drive",
            "identity",
            "TPDO1",
            "RPDO2",
            "scale",
            "cycle",
            "rapid signal",
            "voltage",
            "heartbeat",
        } <= names


DRIVE = "[axis.X.voltage]"
DIFFERENT = {
    "scale": (
        DRIVE,
        "[axis.X.drive]\nincrements_per_rev = 4096\n" + DRIVE,
        "65536 per revolution",
    ),
    "rated current": (DRIVE, "[axis.X.drive]\nrated_current_a = 10.0\n" + DRIVE, "50 A"),
    "cycle": ("sync_period_s = 0.001", "sync_period_s = 0.002", "1 ms"),
    "drive": (DRIVE, "[axis.X.drive]\nnode_id = 9\n" + DRIVE, "no answer"),
    "following error": (
        DRIVE,
        "[axis.X.drive]\nfollowing_error_window_mm = 5.0\n" + DRIVE,
        "10000 um",
    ),
}


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("point", DIFFERENT)
def test_check_reports_differences_with_advice(
    run_fdhil: Said, point: str, commissioning_bench: CommissioningBench
) -> None:
    old, new, found = DIFFERENT[point]
    config = commissioning_bench.write_config("different.toml", old, new)
    checked = parse_document(run_fdhil, "check", config, code=1)
    assert checked["matches"] is False
    reported = list_points(checked, "differs")[f"axis X {point}"]
    assert reported["found"] == found
    assert reported["cause"]
    assert reported["advice"]
    assert (reported["expected"], reported["found"]) != ("", reported["expected"])


@pytest.mark.usefixtures("real_time")
def test_check_reads_sensor_and_reports_silent_one(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    sensor = commissioning_bench.twin.ready["modbus"]["X"]
    voltage = f'source = "modbus"\nhost = "{sensor["host"]}"\nport = {sensor["port"]}\nunit = {sensor["unit"]}'
    found = parse_document(run_fdhil, "check", commissioning_bench.write_config("sensor.toml", voltage=voltage))
    assert "V at 1000 Hz" in list_points(found, "ok")["axis X voltage"]["found"]
    code, out, _ = run_fdhil(
        "check", commissioning_bench.write_config("dumb.toml", voltage='source = "modbus"\nport = 1')
    )
    assert code == 1
    assert "axis X: the Modbus device 127.0.0.1:1 cannot be reached; check its supply, host and port" in out


@pytest.mark.parametrize("answer", [{"code": "NotOff", "axis": "", "text": "a correction is on"}, None])
def test_void_records_stay_void_when_guard_refuses_comparison(
    run_fdhil: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: dict[str, str] | None
) -> None:
    """The guard refuses the comparison, or disconnects before its answer."""
    path = write_config(tmp_path, bus='interface = "virtual"')
    config = load_config(path)
    config.guard_directory.mkdir(parents=True, exist_ok=True)
    guard = GuardPeer(config.guard_directory)
    guard.says = lambda _kind: {"ok": True, "state": "OFF", "touched": {"X": 0, "Y": 0}}

    def compare(*_: object) -> list[tuple[str, Finding]]:
        if answer is None:
            guard.close()
        guard.says = lambda _kind: {"ok": False, "refused": [answer]}
        return [("axis X", Finding(RECORD_POINT, "f", "f"))]

    monkeypatch.setattr("fdhil.commissioning.config_check.check_machine", compare)
    mark_record_void(config.store.directory, "X", "booted")
    code, _, err = run_fdhil("check", path, "--json")
    assert code == 0
    assert ("NotOff: a correction is on; run fdhil check again" if answer else "void records stay void") in err
    assert is_record_void(config.store.directory, "X")
    guard.close()


def test_doubt_during_comparison_keeps_record_void(
    run_fdhil: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """X reboots, which the daemon detects, and Y, which only the guard detects: both records stay void."""
    path = write_config(tmp_path, bus='interface = "virtual"')
    config = load_config(path)
    store = config.store.directory
    config.guard_directory.mkdir(parents=True, exist_ok=True)
    guard, message = GuardPeer(config.guard_directory), {"ok": True, "state": "OFF", "touched": {"X": 3, "Y": 0}}
    void = {"code": "RecordVoid", "axis": "Y", "text": "axis Y: it has booted", "advice": "run fdhil check"}

    def compare(*_: object) -> list[tuple[str, Finding]]:
        mark_record_void(store, "X", "booted again")
        guard.says = lambda kind: {"ok": False, "refused": [void]} if kind == "compared" else message
        return [(f"axis {axis}", Finding(RECORD_POINT, "f", "f")) for axis in "XY"]

    monkeypatch.setattr("fdhil.commissioning.config_check.check_machine", compare)
    guard.says = lambda _kind: message
    for axis in "XY":
        mark_record_void(store, axis, "booted")
    code, _, err = run_fdhil("check", path, "--json")
    assert code == 0
    assert guard.requests[-1]["touched"] == {"X": 3, "Y": 0}
    assert [is_record_void(store, axis) for axis in "XY"] == [True, True]
    assert "RecordVoid: axis X: its drive changed again after the comparison" in err
    assert "RecordVoid: axis Y: it has booted; run fdhil check again" in err
    guard.close()
    (config.guard_directory / "guard.sock").unlink()
    monkeypatch.setattr("fdhil.commissioning.config_check.check_machine", lambda *_: compare()[1:])
    assert run_fdhil("check", path, "--json")[0] == 0
    assert [is_record_void(store, axis) for axis in "XY"] == [True, False]


@pytest.mark.usefixtures("real_time")
def test_axis_does_not_move_without_confirmation(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    config = commissioning_bench.write_config("asked.toml")
    with record_frames(commissioning_bench) as received:
        for message in ("\nn\n", ""):
            code, out, err = run_fdhil("commission", config, "--axis", "X", said=message)
            assert code == 1
            assert "step 2 of 7, compare" in out
            assert "step 3" not in out
            assert "the axis will move by 10 um" in err
            assert "nothing was moved or written" in err
    assert 0x601 in received
    assert not {0x000, 0x080, 0x201, 0x301} & set(received)
    assert load_record(config.parent / "fdhil-data", "X") is None


@pytest.mark.usefixtures("real_time")
def test_pdos_are_written_after_confirmation_without_motion(
    run_fdhil: Said, commissioning_bench: CommissioningBench
) -> None:
    """First with a profile that differs from the drive in one PDO, then with the matching one."""
    own = commissioning_bench.folder / "own.toml"
    tpdo2 = "entries = [[0x6041, 0, 16, false], [0x2101, 0, 16, true], [0x6078, 0, 16, true]]"
    packaged = files("fdhil.drivers.cia402.profiles").joinpath("fdhil_twin.toml").read_text("utf-8")
    own.write_text(
        packaged.replace("entries = [[0x6041, 0, 16, false], [0x6078, 0, 16, true], [0x2101, 0, 16, true]]", tpdo2)
    )
    other = commissioning_bench.write_config("other.toml", DRIVE, f'[axis.X.drive]\nprofile = "{own}"\n{DRIVE}')
    with record_frames(commissioning_bench) as received:
        code, _, err = run_fdhil("commission", other, "--axis", "X", "--set-pdos", said="n\n")
        assert (code, "nothing was written" in err) == (1, True)
        assert 0x601 not in received
        done = parse_document(run_fdhil, "commission", other, "--axis", "X", "--set-pdos", "--yes")
        assert done["axes"]["X"]["pdos_written"] == ["TPDO2"]
        code, out, _ = run_fdhil("commission", commissioning_bench.write_config(), "--axis", "X", "--set-pdos", "--yes")
        assert (code, "PDOs written: TPDO2" in out) == (0, True)
    assert not {0x080, 0x201, 0x301} & set(received)


@contextmanager
def record_frames(bench: CommissioningBench) -> Iterator[list[int]]:
    received: list[int] = []

    def keep(frame: can.Message) -> None:
        received.append(frame.arbitration_id)

    with bench.twin.join_bus() as bus:
        notifier = can.Notifier(bus, [keep], timeout=0.05)
        try:
            yield received
        finally:
            notifier.stop()


@pytest.mark.usefixtures("long_computation")
def test_commissioning_writes_signed_record(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    config = commissioning_bench.write_config("signed.toml")
    code, out, err = run_fdhil("commission", config, "--axis", "X", said="\ny\n")
    assert code == 0, err
    for number, step in enumerate(
        ("listen", "compare", "enable", "sign test", "feed-forward", "watchdog", "restore"), 1
    ):
        assert f"step {number} of 7, {step}" in out
    assert "axis X is commissioned: moved +" in out
    record = load_record(config.parent / "fdhil-data", "X")
    assert record is not None
    assert (record.watchdog, record.serial, record.options["1017"]) == (
        "proven",
        compute_serial_number(load_config(config), "X"),
        100,
    )


@pytest.mark.usefixtures("long_computation")
def test_commissioning_prints_json_document(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    config = commissioning_bench.write_config("json.toml")
    found = parse_document(run_fdhil, "commission", config, "--axis", "Y", "--yes")
    assert found["refused"] is None
    record = load_record(config.parent / "fdhil-data", "Y")
    assert record is not None
    assert found["axes"]["Y"]["digest"] == record.digest
    assert found["axes"]["Y"]["sign_test_um"] == pytest.approx(10, abs=3)


def test_unsuitable_drive_is_refused(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    commissioning_bench.set_object(0x6007, 0)
    try:
        found = parse_document(run_fdhil, "commission", commissioning_bench.write_config("wrong.toml"), "--yes", code=1)
        assert found["axes"] == {}
        assert found["refused"].startswith("drive X: 0x6007 is 0: it continues when communication is lost; set it to")
    finally:
        commissioning_bench.set_object(0x6007, 1)


@pytest.mark.usefixtures("processes")
def test_interrupted_commissioning_switches_drive_off(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    lasting = QUICK.replace("'AVERAGE_CYCLES', 400", "'AVERAGE_CYCLES', 1_000_000")  # an endless sign test
    command = [
        sys.executable,
        "-c",
        lasting,
        "commission",
        str(commissioning_bench.write_config("stopped.toml")),
        "--axis",
        "X",
        "--yes",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "sign test" in line:
                break
        with commissioning_bench.twin.join_bus() as bus:
            process.send_signal(signal.SIGTERM)
            controlwords = collect_controlwords_until_pre_operational(bus)
        _, err = process.communicate()
    assert process.returncode == 130
    assert "Traceback" not in err
    assert controlwords[-1] == 0


def collect_controlwords_until_pre_operational(bus: can.BusABC) -> Sequence[int]:
    words = []
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        received = bus.recv(1.0)
        if received is None:
            continue
        if received.arbitration_id == 0x201:
            words.append(int.from_bytes(received.data[:2], "little"))
        if received.arbitration_id == 0 and received.data[0] == 0x80:
            return words
    raise AssertionError("drive X was not taken out of Operational")


def test_unknown_axis_is_refused(run_fdhil: Said, commissioning_bench: CommissioningBench) -> None:
    code, out, err = run_fdhil("commission", commissioning_bench.write_config(), "--axis", "Z", "--yes")
    assert (code, out) == (2, "")
    assert "there is no axis Z (one of X, Y)" in err


@pytest.mark.usefixtures("real_time")
def test_scan_of_empty_bus_exits_3(run_fdhil: Said, tmp_path: Path) -> None:
    hub = HubThread(TcpHub("can0"))
    hub.start()
    try:
        config = write_config(tmp_path, bus=f'interface = "socketcand"\nport = {hub.hub.settings["port"]}')
        code, out, err = run_fdhil("scan", config)
        assert (code, out) == (3, "")
        assert "no node sent a frame and none answered" in err
    finally:
        hub.stop()


@pytest.mark.parametrize("command", ["scan", "check", "commission"])
def test_help_states_what_is_sent(run_fdhil: Said, command: str) -> None:
    code, out, _ = run_fdhil(command, "--help")
    assert code == 0
    assert "Exit codes" in " ".join(out.split())


@pytest.fixture
def running_nc(
    run_fdhil: Said, commissioning_bench: CommissioningBench, monkeypatch: pytest.MonkeyPatch
) -> Iterator[CommissioningBench]:
    for module in ("scan", "config_check", "drive_survey"):
        monkeypatch.setattr(f"fdhil.commissioning.{module}.LISTEN_S", LISTEN_S)
    commissioning_bench.twin.send_command("nc", on=True)
    assert commissioning_bench.twin.wait_for_event("nc")["on"]
    yield commissioning_bench
    commissioning_bench.twin.send_command("nc", on=False)
    assert not commissioning_bench.twin.wait_for_event("nc")["on"]


def assert_nothing_sent(fdhil: Said, cut: CommissioningBench, *arguments: object, code: int = 0) -> str:
    """Run a command and assert that no SDO was sent meanwhile; return its output."""
    with record_frames(cut) as received:
        got, out, err = fdhil(*arguments)
    assert got == code, (out, err)
    assert 0x80 in received
    assert not {i for i in received if 0x580 <= i < 0x700}
    return out + err


@pytest.mark.usefixtures("real_time")
def test_scan_only_listens_while_nc_runs(run_fdhil: Said, running_nc: CommissioningBench) -> None:
    message = assert_nothing_sent(run_fdhil, running_nc, "scan", running_nc.write_config())
    assert "an NC runs it (SYNC received), so no node was queried" in message
    assert "operational" in message


@pytest.mark.usefixtures("real_time")
def test_check_compares_received_data_while_nc_runs(run_fdhil: Said, running_nc: CommissioningBench) -> None:
    config = running_nc.write_config(
        "counted.toml", "[machine]", '[guard]\nclock = "sync"\n[machine]'
    )  # a busy host sends SYNC late
    found = json.loads(assert_nothing_sent(run_fdhil, running_nc, "check", config, "--json"))
    assert found["matches"] is True
    assert found["complete"] is False
    assert list_points(found, "not compared")["axis X identity"]["advice"] == "switch the NC off and check again"
    assert {"bus can0 SYNC", "axis X TPDO1", "axis Y TPDO3", "axis X RPDO1"} <= set(list_points(found, "ok"))


@pytest.mark.usefixtures("real_time")
def test_check_reports_different_sync_period(run_fdhil: Said, running_nc: CommissioningBench) -> None:
    config = running_nc.write_config("period.toml", "sync_period_s = 0.001", "sync_period_s = 0.0005")
    message = assert_nothing_sent(run_fdhil, running_nc, "check", config, code=1)
    assert "but the configuration has 0.5 ms; correct machine.sync_period_s or the NC's cycle" in message


def test_commissioning_is_refused_while_nc_runs(run_fdhil: Said, running_nc: CommissioningBench) -> None:
    message = assert_nothing_sent(run_fdhil, running_nc, "commission", running_nc.write_config(), "--yes", code=3)
    assert "an NC is sending SYNC or set-points; switch it off" in message
