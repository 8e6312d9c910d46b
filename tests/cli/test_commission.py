"""``fdhil commission`` with a simulated drive in this process: plans, continuation, refused setups."""

from __future__ import annotations

import io
import json
import sys
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.cli.main import cli, run_safely
from fdhil.commissioning.commissioning_record import load_record
from fdhil.errors import DriveFault
from fdhil.store import audit_file
from fdhil.store.history_database import History
from tests.bench import bench_toml
from tests.commissioning.foreign_nc import (
    A_FEW,
    FOREIGN,
    NMT,
    OFFSET,
    SDO,
    SYNC,
    ForeignNc,
    LateOperator,
    is_offset_frame,
)
from tests.drivers.peer import DrivePeer
from tests.eds import write_eds
from tests.short_waits import shorten_waits
from tests.tiers import sampled

WAITS = {
    "commissioning.watchdog.STARVE_TIMEOUT_S": 1.0,
    "drivers.can.sdo_channel.RESPONSE_TIMEOUT_S": 0.2,
    "commissioning.stroke_planning.JOG_MM": 1.0,
    "commissioning.axis_trial.TIMING_CYCLES": 100,
    "commissioning.axis_trial.TRIAL_RAPIDS": 4,
    "commissioning.axis_trial.REST_S": 0.6,
    "commissioning.axis_trial.LAST_REST_S": 0.4,
}
TRUE = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075}


@dataclass
class DriveBench:
    peer: DrivePeer
    file: Path
    capsys: pytest.CaptureFixture[str]

    def run_commission(self, *arguments: str, said: str | io.StringIO = "") -> tuple[int, str, str]:
        """Run the command with these answers; return exit code, stdout and stderr."""
        sys.stdin = said if isinstance(said, io.StringIO) else io.StringIO(said)
        sys.argv[1:] = ["commission", str(self.file), *arguments]
        code = run_safely(cli)
        received = self.capsys.readouterr()
        return code, received.out, received.err

    def type_answers(self, old: str, new: str) -> None:
        text = self.file.read_text()
        assert old in text
        self.file.write_text(text.replace(old, new, 1))

    @property
    def store(self) -> Path:
        return machine_config.load_config(self.file).store.directory


@pytest.fixture
def drive_bench(
    virtual_threads: object, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[DriveBench]:
    shorten_waits(monkeypatch, WAITS)
    monkeypatch.setattr(sys, "argv", ["fdhil"])
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    file = tmp_path / "machine.toml"
    bus = f'[bus.can0]\ninterface = "virtual"\nchannel = "{uuid.uuid4().hex}"\n[guard]\nclock = "sync"\n'
    slow = bench_toml("X").replace("sync_period_s = 0.001", "sync_period_s = 0.002")
    file.write_text(slow + "[axis.X.drive]\nnode_id = 1\n" + bus)
    with DrivePeer(machine_config.load_config(file)) as peer:
        yield DriveBench(peer, file, capsys)


def test_dry_run_prints_motion_of_each_step_and_sends_nothing(drive_bench: DriveBench) -> None:
    code, out, err = drive_bench.run_commission("--room", "-10", "160", "--dry-run")
    assert (code, err) == (0, "")
    for words in (
        "nothing is sent now",
        "4 of 13, sign test: ",
        "Moves 10 um toward plus and back",
        "9 of 13, jog: ",
        "Moves 1 mm toward plus at 5 mm/s, and back.",
        "Moves 156.8 mm toward plus at 461 mm/s with 4000 mm/s2, and back, 2 times.",
    ):
        assert words in out, words
    code, out, _ = drive_bench.run_commission("--dry-run", "--json")
    plan = json.loads(out)
    assert (code, plan["dry_run"], len(plan["axes"]["X"])) == (0, True, 13)  # because the room would be prompted for
    assert "within the room that you allow at up to 500 mm/s" in plan["axes"]["X"][9]["moves"]
    assert len(json.loads(drive_bench.run_commission("--dry-run", "--json", "--yes")[1])["axes"]["X"]) == 7
    assert plan["axes"]["X"][0] | {"does": ""} == {"step": "listen", "does": "", "moves": "nothing", "done_utc": None}
    code, _, err = drive_bench.run_commission("--room", "-10", "60", "--dry-run")
    assert (code, "test rapids need 102 mm" in err) == (1, True)
    assert drive_bench.peer.heard == []
    assert list(drive_bench.file.parent.iterdir()) == [drive_bench.file]


@pytest.mark.parametrize("room", [("10", "100"), ("-10", "-1"), ("nan", "100"), ("-10", "inf")])
def test_invalid_room_is_refused(room: tuple[str, str], drive_bench: DriveBench) -> None:
    code, _, err = drive_bench.run_commission("--room", *room)
    assert (code, "--room needs the travel back" in err) == (2, True)


@pytest.mark.usefixtures("long_computation")
def test_interrupted_commissioning_continues_with_unfinished_step(
    drive_bench: DriveBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> str:
        raise KeyboardInterrupt

    with monkeypatch.context() as stopped:
        stopped.setattr("fdhil.commissioning.commissioning_steps.run_watchdog_test", stop)
        code, out, err = drive_bench.run_commission("--yes")
        assert (code, err.strip()) == (130, "fdhil: stopped by the operator")
        assert out.endswith("next: run the same command again; it continues with the unfinished step\n")
        assert "axis X: sign test: the axis moved by +" in out
    assert drive_bench.peer.drive.power.state.name == "SWITCH_ON_DISABLED"
    assert load_record(drive_bench.store, "X") is None

    code, out, _ = drive_bench.run_commission("--yes")
    assert code == 0
    for kept in ("step 4 of 7, sign test: skipped, done 2", "step 5 of 7, feed-forward test: skipped"):
        assert kept in out
    assert "step 6 of 7, watchdog test: Sending" in out
    assert "axis X: no trial, because no --room was given" in out
    first = load_record(drive_bench.store, "X")
    assert first is not None
    assert first.watchdog == "proven"

    received = len(drive_bench.peer.heard)
    code, out, _ = drive_bench.run_commission("--yes")
    assert (code, "step 3" in out, "watchdog test: skipped" in out) == (0, False, True)
    assert not {0x000, 0x080, 0x201, 0x301} & set(drive_bench.peer.heard[received:])
    again = load_record(drive_bench.store, "X")
    assert again is not None
    assert again.sign_test_um == first.sign_test_um

    code, out, _ = drive_bench.run_commission("--yes", "--dry-run")
    assert out.count("skipped if the drive is unchanged") == 3
    drive_bench.peer.drive.overwrite_object(0x6085, 0, 1_000_000)  # changed by the vendor's tool
    code, out, _ = drive_bench.run_commission("--yes")
    assert (code, "skipped" in out, "step 4 of 7, sign test: Moving" in out) == (0, False, True)


@pytest.mark.usefixtures("long_computation")
def test_confirmed_trial_identifies_axis_and_stores_history(
    drive_bench: DriveBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    code, out, err = drive_bench.run_commission(said="-2 130\n" + 4 * "y\n")
    assert code == 0, err
    for asked in (
        "How far may axis X move from here",
        "Axis X will move 1 mm toward plus at 5 mm/s, and back. Is its path free? Start?",
        "The drive moved 1 mm toward plus at 5 mm/s, and back. Did the table do the same?",
        "Axis X will move 127.4 mm toward plus at 394 mm/s with 4000 mm/s2, and back, 2 times.",
    ):
        assert asked in err, asked
    assert "step 10 of 13, test rapids: Moving the axis at rapid speed" in out
    assert "axis X: identification: R 50" in out or "axis X: identification: R 49" in out
    assert " mohm, L " in out
    assert out.index("axis X: jog: ") < out.index("step 10 of 13") < out.index("axis X: acceptance: ")
    assert out.splitlines()[-1].startswith("next: fdhil run")
    assert "\raxis X at " in err
    assert "of 7" not in out
    with History.open_read_only(drive_bench.store) as history:
        (newest,) = history.read_revisions("X", limit=1)
    for name, true in TRUE.items():
        assert newest.set.parameters.as_dict()[name] == pytest.approx(true, rel=0.01), name

    beats = drive_bench.peer.heard.count(0x700 + machine_config.load_config(drive_bench.file).play.node_id)
    assert beats > 4  # the drive stops by itself after this process ends
    assert [drive_bench.peer.drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4)] == [0, 0, 0, 0]

    received = len(drive_bench.peer.heard)
    code, out, _ = drive_bench.run_commission("--yes", "--json", "--room", "-2", "130")
    tried = json.loads(out)["axes"]["X"]["trial"]
    assert (code, tried.keys()) == (0, {"jog", "test rapids", "identification", "acceptance"})
    assert (tried["jog"]["seen"], tried["test rapids"]["moves"]) == ("yes", 4)
    assert abs(tried["test rapids"]["voltage_late_ms"]) < 0.1
    assert all(move["left_rms_um"] < 0.1 * move["measured_rms_um"] for move in tried["acceptance"]["moves"])
    assert not {0x000, 0x080, 0x201, 0x301} & set(drive_bench.peer.heard[received:])
    assert drive_bench.peer.drive.table_mm == pytest.approx(0.0, abs=0.05)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(("said", "code"), [("\ny\n", 0), ("-2 130\ny\nn\n", 1), ("far\n", 1)])
def test_axis_does_not_move_without_confirmation(said: str, code: int, drive_bench: DriveBench) -> None:
    got, out, err = drive_bench.run_commission(said=said)
    assert (got, "jog: " in out) == (code, False)
    assert ("no trial, because" in out) is (code == 0)
    assert ("not confirmed; the axis was not moved and its record stays valid" in err) is ("130" in said)
    assert ("'far' is not two numbers" in err) is ("far" in said)
    assert (load_record(drive_bench.store, "X") is None) is ("far" in said)
    assert drive_bench.peer.drive.power.state.name == "SWITCH_ON_DISABLED"


def remove_object(peer: DrivePeer, index: int) -> None:
    dictionary = peer.drive.dictionary
    dictionary.indices.discard(index)
    for key in [key for key in dictionary.entries if key >> 8 == index]:
        del dictionary.entries[key]


def write_other_eds(bench: DriveBench) -> None:
    """The configuration names the EDS of another vendor's drive, with the profile derived from it."""
    eds = write_eds("elmo", bench.file.parent)
    bench.type_answers("node_id = 1\n", f'node_id = 1\nprofile = "cia402"\neds = "{eds.name}"\n')


def set_object(index: int, sub: int, value: int) -> Callable[[DriveBench], None]:
    return lambda bench: bench.peer.drive.overwrite_object(index, sub, value)


def set_fault(name: str, value: object) -> Callable[[DriveBench], None]:
    return lambda bench: setattr(bench.peer.drive.faults, name, value)


def replace_config_text(old: str, new: str) -> Callable[[DriveBench], None]:
    return lambda bench: bench.type_answers(old, new)


# what is wrong -> how it gets so, what is said, and whether the drive was switched on before that
WRONG: dict[str, tuple[Callable[[DriveBench], None], str, bool]] = {
    "goes on without communication": (set_object(0x6007, 0, 0), "0x6007 is 0: it continues", False),
    "window off": (set_object(0x6065, 0, 0xFFFFFFFF), "0x6065 is off: it never detects", False),
    "gear x 10": (set_object(0x6091, 1, 10), "it has 6553.6 position increments per motor revolution", False),
    "scale of the config": (
        replace_config_text("node_id = 1\n", "node_id = 1\nincrements_per_rev = 16384\n"), "but the configuration has "
                                                                                           "16384", False),
    "rated current": (set_object(0x6075, 0, 10_000), "its rated current is 10 A (0x6075)", False),
    "mapping": (
        lambda b: b.peer.drive.overwrite_mapping(0x1A01, [(0x6041, 0, 16), (0x2101, 0, 16), (0x6078, 0, 16)]),
        "TPDO2 maps 60410010, 21010010, 60780010", False),
    "offset of another node": (set_object(0x1401, 1, 0x305), "RPDO2 has the COB-ID 00000305", False),
    "other EDS": (write_other_eds, "choose another profile", False),
    "other profile": (
        replace_config_text("node_id = 1\n", 'node_id = 1\nprofile = "epos4"\n'),
        "which profile epos4 is not made for", False),
    "other cycle": (set_object(0x60C2, 1, 1), "it interpolates over 1 ms", False),
    "no heartbeat consumer": (lambda b: remove_object(b.peer, 0x1016), "it has no heartbeat consumer (0x1016)", True),
    "sign of the offset": (set_fault("offset_scale", -1.0), "does not add 0x60B0 to the target", True),
}  # fmt: skip


def read_audit_entries(bench: DriveBench) -> list[tuple[str, str, str | None]]:
    found = [entry for entry, wrong in audit_file.read_entries(bench.store) if wrong is None]
    return [(entry.get("asked") or entry["answered"], entry["axis"], entry.get("result")) for entry in found]


def test_action_is_in_audit_log_before_drive_is_accessed(
    drive_bench: DriveBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    before: list[Any] = []

    def commission(*_: object) -> None:
        before.extend(read_audit_entries(drive_bench))
        raise DriveFault("drive X", "it is not as it must be")

    monkeypatch.setattr("fdhil.commissioning.commissioning_steps.commission_axis", commission)
    monkeypatch.setattr("fdhil.commissioning.pdo_setup.set_up_pdos", commission)
    assert drive_bench.run_commission("--yes")[0] == 1
    assert before == [("commission", "X", None)]
    assert read_audit_entries(drive_bench)[1:] == [("commission", "X", "DriveFault")]
    assert drive_bench.run_commission("--yes", "--set-pdos")[0] == 1
    assert before[-1] == ("set the PDOs up", "X", None)
    drive_bench.run_commission("--dry-run")
    assert len(read_audit_entries(drive_bench)) == 4


@pytest.mark.fault("F5")
@pytest.mark.parametrize("options", [(), ("--set-pdos",)])
def test_commissioning_is_refused_when_audit_log_is_not_writable(
    options: tuple[str, ...], drive_bench: DriveBench
) -> None:
    (drive_bench.store / audit_file.AUDIT_FILE_NAME).mkdir(parents=True)
    code, _, err = drive_bench.run_commission("--yes", *options)
    assert (code, "could not be written" in err) == (3, True)
    assert drive_bench.peer.heard == []


@pytest.mark.goal("R20")
def test_at_least_twelve_wrong_setups_are_tested(record_property: Callable[[str, object], None]) -> None:
    assert len(WRONG) >= 12
    record_property("goal", f"{len(WRONG)} wrong set-ups ({', '.join(WRONG)}), each refused by the command")


@pytest.mark.usefixtures("long_computation")
@pytest.mark.goal("R20")
@pytest.mark.parametrize("what", WRONG)
def test_wrong_setup_is_refused(what: str, drive_bench: DriveBench) -> None:
    spoil, says, switched_on = WRONG[what]
    spoil(drive_bench)
    code, _, err = drive_bench.run_commission("--yes", "--room", "-5", "150")
    assert code == 1, err
    assert says in err
    assert "Traceback" not in err
    assert (0x080 in drive_bench.peer.heard) is switched_on
    assert drive_bench.peer.drive.power.state.name == "SWITCH_ON_DISABLED"
    assert drive_bench.peer.drive.dictionary.get_number(0x60B0) == 0
    assert load_record(drive_bench.store, "X") is None


@pytest.mark.parametrize("what", sampled(FOREIGN, every=3))
def test_nc_started_during_sign_test_leaves_no_record(what: str, drive_bench: DriveBench) -> None:
    config = machine_config.load_config(drive_bench.file)
    with ForeignNc(config.bus["can0"].channel, FOREIGN[what], is_offset_frame) as nc:
        code, out, err = drive_bench.run_commission("--yes", "--json")
        assert nc.on
        assert max(nc.count_frames(OFFSET), nc.count_frames(SYNC)) <= A_FEW
        assert nc.count_frames(NMT) == 0
    assert code == 3, err
    error = json.loads(out)["error"]
    assert error["class"] == "ForeignMaster"
    assert "an NC is sending" in error["text"]
    assert "switch it off while fdhil acts on the bus, then start again" in error["text"]
    assert load_record(drive_bench.store, "X") is None
    assert not list(drive_bench.store.glob("commissioning-X.json*"))
    assert read_audit_entries(drive_bench)[-1] == ("commission", "X", "ForeignMaster")


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    ("question", "sync"),
    [
        (1, 0),  # prompt for the room
        (2, 0),  # before the drive is switched on
        (3, A_FEW),  # before the jog: SYNC runs, the drive is off
        (4, A_FEW),  # prompt whether the table moved: the drive is on
    ],
)
def test_nc_started_during_prompt_prevents_motion(question: int, sync: int, drive_bench: DriveBench) -> None:
    config = machine_config.load_config(drive_bench.file)
    with ForeignNc(config.bus["can0"].channel, FOREIGN["SYNC"], lambda _: False) as nc:
        code, _, err = drive_bench.run_commission(said=LateOperator(nc, "-2 130\ny\ny\ny\n", question))
        assert nc.on
        assert nc.count_frames(SYNC) <= sync
        assert nc.count_frames(NMT) == nc.count_frames(SDO) == 0
        assert sync or nc.sent == []
    assert code == 3, err
    assert (load_record(drive_bench.store, "X") is None) is (question <= 2)
