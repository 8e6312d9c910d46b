"""A running headless LinuxCNC, and the stream of its demands into the simulated machine."""

from __future__ import annotations

import fcntl
import json
import os
import queue
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

from fdhil.child_process import wrap_to_end_with_parent
from fdhil.records import Float
from tests.sim.simulator_process import SimulatorProcess

HERE = Path(__file__).parent
PATIENCE_S = 300.0
LEAVING_S = 30.0
# as in the how-to: a row of the demand per servo cycle of 1 ms
ROWS = r"""stdbuf -oL halsampler -t | mawk -W interactive '
BEGIN { print "time_s,X_mm,Y_mm" } NF >= 3 { printf "%.3f,%s,%s\n", $1 / 1000, $2, $3 }'"""

NOBODY = 65534
AXIS = """
[AXIS_{letter}]
MAX_VELOCITY = {speed}
MAX_ACCELERATION = {acceleration}
MIN_LIMIT = -1000
MAX_LIMIT = 1000
[JOINT_{number}]
TYPE = {kind}
HOME = 0
HOME_SEARCH_VEL = 0
HOME_LATCH_VEL = 0
MAX_VELOCITY = {speed}
MAX_ACCELERATION = {acceleration}
MIN_LIMIT = -1000
MAX_LIMIT = 1000
FERROR = 10
MIN_FERROR = 10
"""
MACHINE = """
[EMC]
VERSION = 1.1
MACHINE = bench
[DISPLAY]
DISPLAY = {folder}/nobody_at_the_panel.py
PROGRAM_PREFIX = {folder}
[TASK]
TASK = milltask
CYCLE_TIME = 0.001
[RS274NGC]
PARAMETER_FILE = {folder}/machine.var
[EMCMOT]
EMCMOT = motmod
COMM_TIMEOUT = 1.0
SERVO_PERIOD = 1000000
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.1
TOOL_TABLE = {folder}/machine.tbl
[HAL]
HALFILE = machine.hal
[KINS]
KINEMATICS = trivkins coordinates={axes}
JOINTS = {joints}
[TRAJ]
COORDINATES = {axes}
LINEAR_UNITS = mm
ANGULAR_UNITS = degree
NO_FORCE_HOMING = 1
DEFAULT_LINEAR_VELOCITY = {speed}
MAX_LINEAR_VELOCITY = 2000
DEFAULT_ANGULAR_VELOCITY = {speed}
MAX_ANGULAR_VELOCITY = 2000
DEFAULT_LINEAR_ACCELERATION = {acceleration}
MAX_LINEAR_ACCELERATION = {acceleration}
"""


class LinuxCnc:
    """LinuxCNC, switched on and homed at 0; leaving the with block ends it.

    ``hal`` are additional lines of its HAL file, for example to load the bridge; ``base`` replaces the HAL file of
    joints without drives, and ``beside`` are files in its folder. AssertionError in LinuxCNC's own words if it fails.
    """

    def __init__(
        self,
        speed_mm_s: float = 500.0,
        acceleration_mm_s2: float = 2000.0,
        hal: str = "",
        axes: str = "XYZ",
        base: str | None = None,
        beside: Mapping[str, str] | None = None,
    ) -> None:
        self._alone = _lock_linuxcnc()
        self.folder = Path(tempfile.mkdtemp(prefix="fdhil-linuxcnc-"))
        self._lines: IO[str] | None = None
        write_machine(self.folder, speed_mm_s, acceleration_mm_s2, hal, axes, base)
        for name, text in (beside or {}).items():
            (self.folder / name).write_text(text.replace("{folder}", str(self.folder)))
        with socket.create_server(("127.0.0.1", 0)) as door:
            self._start(door.getsockname()[1], axes)
            try:
                self._connect_operator(door)
            except BaseException:
                self.close()
                raise

    def _start(self, port: int, axes: str) -> None:
        if os.geteuid() == 0:
            for path in (self.folder, *self.folder.iterdir()):
                os.chown(path, NOBODY, NOBODY)
        environment = os.environ | {"HOME": str(self.folder), "OPERATOR_PORT": str(port), "AXES": axes}
        environment.pop("DISPLAY", None)
        with (self.folder / "log").open("ab") as log:
            self._child = self._start_unprivileged(
                "linuxcnc", str(self.folder / "machine.ini"), environment=environment, log=log
            )

    def _start_unprivileged(
        self, *command: str, environment: Mapping[str, str] | None = None, log: IO[bytes], out: int | None = None
    ) -> subprocess.Popen[bytes]:
        """Start a command in its own process group, not as root, since LinuxCNC refuses to run as root."""
        if os.geteuid() == 0:
            command = (
                "setpriv",
                "--pdeathsig=TERM",
                f"--reuid={NOBODY}",
                f"--regid={NOBODY}",
                "--clear-groups",
                *command,
            )
        return subprocess.Popen(
            wrap_to_end_with_parent(command),
            cwd=self.folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log if out is None else out,
            stderr=log,
            start_new_session=True,
        )

    def _connect_operator(self, door: socket.socket) -> None:
        door.settimeout(0.2)
        end = time.monotonic() + PATIENCE_S
        while True:
            try:
                wire, _ = door.accept()
                break
            except TimeoutError:
                assert self._child.poll() is None, self._read_log()
                assert time.monotonic() < end, self._read_log()
        wire.settimeout(PATIENCE_S)
        self._lines = wire.makefile("rw")
        wire.close()
        self._read_answer()

    def _read_answer(self) -> None:
        assert self._lines is not None
        line = self._lines.readline()
        reported: dict[str, Any] = json.loads(line) if line else {"failed": "LinuxCNC has ended"}
        assert "done" in reported, f"{reported}\n{self._read_log()}"

    def _read_log(self) -> str:
        files = ("log", "linuxcnc_print.txt", "linuxcnc_debug.txt")
        return "\n".join((self.folder / name).read_text()[-2000:] for name in files if (self.folder / name).exists())

    def send_order(self, order: str, **what: Any) -> None:
        assert self._lines is not None
        self._lines.write(json.dumps({"order": order, **what}) + "\n")
        self._lines.flush()
        self._read_answer()

    def run(self, program: str) -> None:
        self.start(program)
        self.send_order("rest")

    def start(self, program: str) -> None:
        path = self.folder / "program.ngc"
        path.write_text(program)
        path.chmod(0o644)
        self.send_order("run", program=str(path))

    @contextmanager
    def drive_simulator(self, twin: SimulatorProcess) -> Iterator[None]:
        """Let the demand drive the simulated machine until the end of the block, which ends the demand.

        The complete demand up to the end of the block is transferred, however slow the host is.
        """
        with (self.folder / "log").open("ab") as log:
            sampling = self._start_unprivileged("sh", "-c", ROWS, log=log, out=subprocess.PIPE)
        assert sampling.stdout is not None
        pouring = threading.Thread(target=_forward_demand, args=(sampling.stdout, twin), name="demand")
        pouring.start()
        try:
            yield
            self._wait_until_fetched()
        finally:
            _end_process(sampling)
            pouring.join()
            sampling.stdout.close()
            twin.close_panel()

    def _wait_until_fetched(self) -> None:
        """Wait until no more samples are queued than arrive during one request."""
        end = time.monotonic() + PATIENCE_S
        while (depth := self._count_queued()) > 100:
            assert time.monotonic() < end, f"{depth} samples of the demand are still queued"

    def _count_queued(self) -> int:
        with (self.folder / "log").open("ab") as log:
            asking = self._start_unprivileged(
                "halcmd", "-s", "getp", "sampler.0.curr-depth", log=log, out=subprocess.PIPE
            )
        reported, _ = asking.communicate()
        assert asking.returncode == 0, self._read_log()
        return int(reported)

    def close(self) -> None:
        """End LinuxCNC: its operator leaves, and it cleans up."""
        if self._lines is not None:
            self._lines.close()
            with suppress(subprocess.TimeoutExpired):
                self._child.wait(LEAVING_S)
        _end_process(self._child)
        self._alone.close()
        shutil.rmtree(self.folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def write_machine(
    folder: Path, speed_mm_s: float, acceleration_mm_s2: float, hal: str, axes: str, base: str | None = None
) -> None:
    """Write the files of a machine as an integrator does: machine.ini, and its HAL file."""
    text = (HERE / "machine.hal").read_text() if base is None else base
    if base is None:
        text = text.replace("=xyz", f"={axes.lower()}").replace("joints=3", f"joints={len(axes)}")
    if axes == "XY" and base is None:  # the bridge's channel has only its joints
        lines = text.replace(",fffssff", ",ffssff").splitlines()
        text = "\n".join(line for line in lines if "joint.2" not in line)
    (folder / "machine.hal").write_text(f"{text}\n{hal}")
    shutil.copy(HERE / "remote_operator.py", folder / "nobody_at_the_panel.py")
    (folder / "nobody_at_the_panel.py").chmod(0o755)
    limits = {"speed": speed_mm_s, "acceleration": acceleration_mm_s2}
    ini = MACHINE.format(folder=folder, axes=axes, joints=len(axes), **limits)
    kinds = ["ANGULAR" if letter in "ABC" else "LINEAR" for letter in axes]
    ini += "".join(
        AXIS.format(letter=letter, number=number, kind=kind, **limits)
        for number, (letter, kind) in enumerate(zip(axes, kinds, strict=True))
    )
    (folder / "machine.ini").write_text(ini)
    for name in ("machine.tbl", "machine.var", "log"):
        (folder / name).touch()


def _lock_linuxcnc() -> IO[bytes]:
    """Wait until no other test has a LinuxCNC: a computer runs one at a time."""
    lock = (Path(tempfile.gettempdir()) / "fdhil-linuxcnc.lock").open("ab")
    fcntl.flock(lock, fcntl.LOCK_EX)
    return lock


class DemandRecorder(LinuxCnc):
    """A LinuxCNC without drives whose demand in each servo cycle is recorded."""

    def __init__(self, speed_mm_s: float = 500.0, acceleration_mm_s2: float = 2000.0, axes: str = "XYZ") -> None:
        super().__init__(speed_mm_s, acceleration_mm_s2, axes=axes)
        with (self.folder / "log").open("ab") as log:
            self._sampling = self._start_unprivileged("stdbuf", "-oL", "halsampler", "-t", log=log, out=subprocess.PIPE)
        self._samples: queue.Queue[list[float]] = queue.Queue()
        self._thread = threading.Thread(target=self._store_samples, name="demand")
        self._thread.start()

    def _store_samples(self) -> None:
        assert self._sampling.stdout is not None
        for line in self._sampling.stdout:
            words = line.split()
            if len(words) == 5:  # the others mean that samples were not fetched in time
                self._samples.put([float(word) for word in words])

    def record_demand(self, program: str) -> Float:
        """Return the demand (n, 3), mm or degrees, of each servo cycle of a program, from first to last motion.

        It begins at zero, in the state after power-up. AssertionError if a cycle was not recorded or nothing moved.
        """
        self.send_order("reset")
        self.run(program)
        self.send_order("mark")
        samples = np.array(list(self._yield_between_marks()))
        assert (np.diff(samples[:, 0]) == 1).all(), "a cycle is missing in the recorded demand"
        moving = np.flatnonzero(np.abs(np.diff(samples[:, 1:4], axis=0)).max(axis=1) > 0.0)
        assert moving.size, f"nothing moved\n{self._read_log()}"
        return np.asarray(samples[moving[0] : moving[-1] + 2, 1:4])

    def _yield_between_marks(self) -> Iterator[list[float]]:
        """Yield the samples between the end of the reset's mark and the start of the mark after the program."""
        marks = 0
        marked = False
        while marks < 2:
            sample = self._samples.get(timeout=PATIENCE_S)
            marks += bool(sample[4]) and not marked
            marked = bool(sample[4])
            if marks == 1 and not marked:
                yield sample

    def close(self) -> None:
        _end_process(self._sampling)
        self._thread.join()
        assert self._sampling.stdout is not None
        self._sampling.stdout.close()
        super().close()


def _forward_demand(rows: IO[bytes], twin: SimulatorProcess) -> None:
    for line in rows:
        twin.send_line(line.decode().rstrip())


def _end_process(child: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGTERM)
    try:
        child.wait(LEAVING_S)
    except subprocess.TimeoutExpired:
        os.killpg(child.pid, signal.SIGKILL)
        child.wait()
