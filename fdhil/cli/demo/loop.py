"""The loop of the demonstration: commission, identify, predict, execute, correct, warm up, correct again."""

import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fdhil import config as machine_config
from fdhil.cli.demo.demo_page import CutPass, DemoResult, Published, compute_rms
from fdhil.cli.demo.machines import load_machine_document
from fdhil.cli.demo.processes import PATIENCE_S, ChildProcess, SimulatorProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.commissioning import commission_axis, save_record
from fdhil.config import MachineConfig
from fdhil.daemon import SOCKET_NAME, ask_daemon
from fdhil.errors import DeviceTimeout, FdhilError, RecordingError
from fdhil.prediction import compute_contour_error_um, predict_path
from fdhil.program import load_trajectory
from fdhil.records import PARAMETERS, Parameters, ParameterSet, Window
from fdhil.sim import build_plant_parameters
from fdhil.store import History, read_window

Say = Callable[[str], None]

PROGRAMS: Mapping[str, str] = {
    "10 m/min": "bench_10m.ngc",
    "20 m/min": "bench_20m.ngc",
    "rounded": "bench_rounded_10m.ngc",
    "shuttle": "shuttle.ngc",
}
RAPIDS = 4  # of each axis in the shuttle
WARM_C = (20.5, 21.0, 21.5, 22.0)


@dataclass
class DemoRig:
    """A running demonstration: simulator with panel, guard and daemon, and the passes so far."""

    out: Path
    config: MachineConfig
    simulator: SimulatorProcess
    show_progress: Say
    programs: Mapping[str, Path]
    others: list[ChildProcess] = field(default_factory=list)
    cuts: list[CutPass] = field(default_factory=list)

    @property
    def run(self) -> Path:
        """Run directory of the machine."""
        folder = self.config.store.run_directory
        assert folder is not None
        return folder

    def ask_daemon(self, request: str, **fields: Any) -> dict[str, Any]:
        """Send a request to the daemon. Raises FdhilError with the daemon's text if it refuses."""
        answer = ask_daemon(self.run / SOCKET_NAME, {"request": request, **fields}, timeout_s=PATIENCE_S)
        if not answer.get("ok"):
            raise FdhilError(f"the daemon refuses the request {request}: {answer.get('code')}: {answer.get('text')}")
        return answer


def run_loop(out: Path, realtime: bool, say: Say) -> DemoResult:
    """Run the whole loop in ``out`` and return the results. Raises FdhilError if a step fails."""
    with start_machine(out, realtime, say, load_machine_document()) as stage:
        return _run_passes(stage)


def make_folder(out: Path) -> None:
    """Create the folder of a machine. Raises FdhilError if that fails."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FdhilError(f"the folder {out} cannot be created: {error.strerror}; choose another --out") from None


@contextmanager
def start_machine(out: Path, realtime: bool, say: Say, document: dict[str, Any]) -> Iterator[DemoRig]:
    """Start a commissioned machine with guard, daemon and NC; all processes end with the block."""
    make_folder(out)
    with ExitStack() as stack:
        say("starting the simulator: two drives, two voltage sensors, an NC")
        stage = _start_simulator(out, realtime, say, stack, document)
        _commission_axes(stage)
        for name, module in (("guard", ["fdhil.cli.guard"]), ("daemon", ["fdhil", "run"])):
            process = ChildProcess(name, [*module, str(out / "machine.toml")], out / f"{name}.log")
            stage.others.append(stack.enter_context(process))
        _wait_until(lambda: _is_daemon_ready(stage), "the daemon did not get ready", stage)
        stage.simulator.send_command("nc", on=True)
        stage.simulator.await_event("nc")
        yield stage


def _start_simulator(out: Path, realtime: bool, say: Say, stack: ExitStack, document: dict[str, Any]) -> DemoRig:
    shutil.rmtree(out / "data", ignore_errors=True)
    document["sim"]["pace"] = "realtime" if realtime else "lockstep"
    (out / "twin.toml").write_text(format_toml(document), "utf-8")
    twin = stack.enter_context(SimulatorProcess(out / "twin.toml", out / "twin.log"))
    document["bus"] = twin.ready["buses"]
    # the simulated voltage sensors also measure the slide-way temperature
    for axis, sensor in twin.ready["modbus"].items():
        document["axis"][axis]["temperature"] = {**sensor, "period_s": 0.2}
    (out / "machine.toml").write_text(format_toml(document), "utf-8")
    folder = Path(__file__).parent
    programs = {label: folder / name for label, name in PROGRAMS.items()}
    return DemoRig(out, machine_config.load_config(out / "machine.toml"), twin, say, programs)


def _is_daemon_ready(stage: DemoRig) -> bool:
    try:
        return bool(stage.ask_daemon("status"))
    except FdhilError:
        return False


def _wait_until(done: Callable[[], bool], failure: str, stage: DemoRig) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not done():
        for process in (stage.simulator, *stage.others):
            process.check_running()
        if time.monotonic() > deadline:
            raise DeviceTimeout("demonstration", f"{failure} within {PATIENCE_S:.0f} s; see the logs in {stage.out}")
        time.sleep(0.05)


def _commission_axes(stage: DemoRig) -> None:
    for axis in stage.config.axis:
        stage.show_progress(f"commissioning {axis}: identity, read-back, +10 um, feed-forward, watchdog")
        record = commission_axis(stage.config, axis)
        save_record(record, stage.config.store.directory, stage.config.store.commissioning_key)
        where = "includes" if record.offset_in_feedforward else "does not include"
        stage.show_progress(
            f"  the offset moved the axis by {record.sign_test_um:+.1f} um; the feed-forward {where} it"
        )


def _run_passes(stage: DemoRig) -> DemoResult:
    config = stage.config
    programs = {label: load_trajectory(path, config) for label, path in stage.programs.items() if label != "shuttle"}
    published: dict[str, list[Published]] = {axis: [] for axis in config.axis}
    stage.show_progress("shuttling both axes at rapid speed")
    cold = _identify_by_shuttle(stage, published)
    models = {axis: found[0].parameters for axis, found in published.items()}
    predicted = predict_path(programs["10 m/min"], models, config)
    stage.show_progress(f"predicted contour error of the path: {compute_rms(predicted.contour_um):.1f} um RMS")
    cut_path(stage, "uncorrected", 20.0)
    cut_path(stage, "mirror", 20.0, "mirror")
    cut_path(stage, "inverse", 20.0, "inverse")
    warm = cold
    for celsius in WARM_C:
        stage.show_progress(f"slide-ways at {celsius:.1f} degC, shuttling")
        stage.simulator.send_command("temperature", celsius=celsius)
        warm = _identify_by_shuttle(stage, published)
    cut_path(stage, "inverse, warm", WARM_C[-1], "inverse")
    counters = stage.ask_daemon("status")["frames"]
    return DemoResult(
        config=config,
        truth=compute_true_parameters(config),
        published=published,
        cold=cold,
        warm={axis: window for axis, (window, _) in warm.items()},
        predicted=predicted,
        programs=programs,
        cuts=stage.cuts,
        frames=(int(counters["received"]), int(counters["lost"])),
    )


def _identify_by_shuttle(
    stage: DemoRig, published: dict[str, list[Published]]
) -> dict[str, tuple[Window, float | None]]:
    # the last accepted window of each axis with its fit
    play_shuttle(stage)
    newest: dict[str, tuple[Window, float | None]] = {}
    with History.open_read_only(stage.config.store.directory) as history:
        for axis in stage.config.axis:
            published[axis].append(summarise_published_set(history.read_revisions(axis, limit=1)[0].set))
            stored = [row for row in history.read_windows(axis) if row.accepted][-1]
            window = read_window(stage.config.store.directory / "windows" / stored.file)
            newest[axis] = (window, stored.fit_percent)
    return newest


def play_shuttle(stage: DemoRig) -> None:
    """Play the shuttle program and wait until all its rapids are analysed."""
    before = _count_analysed_rapids(stage)
    stage.simulator.play_program(stage.programs["shuttle"])
    _wait_until(
        lambda: all(now >= before[axis] + RAPIDS for axis, now in _count_analysed_rapids(stage).items()),
        "the rapids of the shuttle were not analysed",
        stage,
    )


def summarise_published_set(found: ParameterSet) -> Published:
    """Return a published set for the report."""
    names = (*PARAMETERS, *(name for name, _ in found.parameters.terms))
    std = dict(zip(names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
    return Published(found.parameters, std, found.temperature_c or 20.0)


def compute_true_parameters(config: MachineConfig) -> dict[str, Parameters]:
    """Return the true parameters of each axis."""
    return {
        axis: build_plant_parameters(settings.nominal, config.sim.axis[axis]) for axis, settings in config.axis.items()
    }


def _count_analysed_rapids(stage: DemoRig) -> dict[str, int]:
    axes = stage.ask_daemon("status")["axes"]
    return {axis: found["accepted"] + found["refused"] for axis, found in axes.items()}


def cut_path(stage: DemoRig, label: str, celsius: float, method: str | None = None) -> None:
    """Execute the path, with the correction ``method`` if given. Raises FdhilError if the daemon refuses it."""
    program, trace = stage.programs["10 m/min"], stage.out / f"cut-{len(stage.cuts) + 1}.csv"
    finished = (
        stage.simulator.play_program(program, trace)
        if method is None
        else _cut_corrected(stage, program, trace, method)
    )
    reference, table = read_trace(trace, tuple(stage.config.axis))
    contour = compute_contour_error_um(reference, table, stage.config.machine.sync_period_s)
    late = sum(int(n) for n in finished["late_rpdo"].values())
    done = CutPass(label, celsius, reference, table, contour, late)
    stage.cuts.append(done)
    stage.show_progress(
        f"pass {label}: {done.rms_um:.2f} um RMS, {done.max_um:.1f} um at most, {late} late offset frames"
    )


def _cut_corrected(stage: DemoRig, program: Path, trace: Path, method: str) -> dict[str, Any]:
    stage.show_progress(f"arming {method}: improvement predicted, within limits, drives commissioned")
    stage.ask_daemon("arm", program=str(program), method=method, token=(stage.run / "token").read_text("utf-8").strip())
    finished = stage.simulator.play_program(program, trace)
    _wait_until(lambda: stage.ask_daemon("status")["state"] == "OFF", "the guard did not become idle", stage)
    cause = stage.ask_daemon("status")["guard"]["cause"]
    if cause["code"] != "Finished":
        raise FdhilError(f"the guard ended the correction: {cause['code']}: {cause['text']}; {cause['advice']}")
    return finished


def read_trace(path: Path, axes: Sequence[str]) -> tuple[Any, Any]:
    """Return reference and table positions, (n, axes) each, mm, of a simulator trace. Raises RecordingError."""
    rows = np.genfromtxt(path, delimiter=",", names=True)
    if rows.dtype.names is None or rows.size == 0:
        raise RecordingError(f"the trace {path} is empty")
    pick = [np.column_stack([rows[f"{axis}_{what}_mm"] for axis in axes]) for what in ("reference", "table")]
    return pick[0], pick[1]
