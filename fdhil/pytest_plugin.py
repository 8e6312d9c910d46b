"""The pytest fixture ``feed_drive_bench``: a simulated machine for anybody's tests of a CANopen master or tool.

    def test_my_master(feed_drive_bench):
        bench = feed_drive_bench(axes="X")
        master = MyMaster(bench.join())           # any python-can program
        master.home_and_move(30.0)
        assert bench.position_mm("X") == pytest.approx(30.0, abs=0.01)

The machine speaks on python-can's ``virtual`` bus, on a TCP hub of its own, or on a real CAN interface: option
``--feed-drive-bus``. The bench ends with the test.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import json
import queue
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import can

    from fdhil.sim import FrameFault, SimulatorService

BUSES = ("virtual", "hub")  # any other name is that of a CAN interface, as vcan0
DEFAULT_PATIENCE_S = 60.0
_channel = itertools.count()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that chooses the bus."""
    text = "bus of the simulated machine: virtual (default), hub, or a CAN interface such as vcan0"
    parser.addoption("--feed-drive-bus", default=BUSES[0], metavar="BUS", help=text)


@pytest.fixture
def feed_drive_bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., FeedDriveBench]]:
    """Return :func:`start`, which starts a simulated machine; it ends with the test."""
    bus = str(request.config.getoption("--feed-drive-bus"))
    with contextlib.ExitStack() as benches:

        def start(axes: str = "XY", **options: Any) -> FeedDriveBench:
            folder = tmp_path / f"bench{next(_channel)}"
            folder.mkdir()
            return benches.enter_context(FeedDriveBench(folder, **{"axes": axes, "bus": bus} | options))

        yield start


class FeedDriveBench:
    """A running machine: drives that speak CiA 402, voltage sensors that speak Modbus, and an NC, initially off.

    ``changes`` are merged into its configuration (as of ``configs/machine-template.toml``), ``pace`` is ``realtime`` or
    ``lockstep``: then the next SYNC of its NC waits for the set-points of all participants. ``ready`` is the first
    event of ``fdhil sim --json``: buses, node-IDs, PDO mappings, EDS files, Modbus ports.
    """

    def __init__(
        self,
        folder: Path,
        axes: str = "XY",
        bus: str = "virtual",
        pace: str = "realtime",
        modbus: bool = False,
        changes: Mapping[str, Any] | None = None,
        patience_s: float = DEFAULT_PATIENCE_S,
    ) -> None:
        from fdhil.cli.demo.machines import merge_tables

        document = _build_bench_document(axes, bus) | {"sim": {"pace": pace, "modbus": modbus}}
        merge_tables(document, changes or {})
        self.folder = folder
        self._document, self._patience_s = document, patience_s
        self._events: queue.Queue[dict[str, Any]] = queue.Queue()
        self._service: SimulatorService | None = None
        self._thread: threading.Thread | None = None
        self._joined: list[can.BusABC] = []
        self.ready: Mapping[str, Any] = {}

    def __enter__(self) -> FeedDriveBench:
        from fdhil import config
        from fdhil.program import load_trajectory
        from fdhil.sim import SimulatorService

        service = SimulatorService(
            config.parse_config(self._document, folder=self.folder), self._events.put, load_trajectory
        )
        self._service = service
        self._thread = threading.Thread(target=service.run, name="feed drive bench")
        self._thread.start()
        try:
            self.ready = self.wait_for("ready")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for bus in self._joined:
            bus.shutdown()
        if self._service is not None and self._thread is not None:
            self._service.stop()
            self._thread.join()

    # -- the bus

    @property
    def bus_arguments(self) -> dict[str, Any]:
        """The arguments with which ``can.Bus`` and ``canopen.Network.connect`` join the machine's bus."""
        return {key: value for key, value in self.ready["buses"]["can0"].items() if value is not None}

    def join(self, plan: Sequence[FrameFault] = (), seed: int = 0) -> can.BusABC:
        """Join the bus as a participant of its own, until the bench ends.

        With a ``plan`` of faults it is a :class:`fdhil.sim.wire.fault_bus.FaultBus`: the faults affect only the frames
        that this participant sends and receives.
        """
        import can

        from fdhil.sim import FaultBus

        bus = can.Bus(**self.bus_arguments)
        self._joined.append(FaultBus(bus, plan, seed) if plan else bus)
        return self._joined[-1]

    def drive(self, axis: str = "X") -> Mapping[str, Any]:
        """Return the data of a drive: ``node_id``, ``eds``, ``increments_per_mm``, ``tpdo``, ``rpdo``."""
        drive: Mapping[str, Any] = self.ready["drives"][axis]
        return drive

    def write_config(self, path: Path | None = None) -> Path:
        """Write the configuration with which fdhil's own commands join this machine; return its path."""
        from fdhil.cli.demo.toml_writer import format_toml

        document = copy.deepcopy(self._document)
        document["bus"]["can0"] |= self.bus_arguments
        for axis, place in self.ready["modbus"].items():
            document["axis"][axis].setdefault("voltage", {}).update(place)
        path = path or self.folder / "machine.toml"
        path.write_text(format_toml(document), "utf-8")
        return path

    # -- state and commands

    def position_mm(self, axis: str = "X") -> float:
        """Return the true position of the table, whatever the drive reports."""
        assert self._service is not None
        return float(self._service.machine.units[axis].drive.table_mm)

    def command(self, command: str, **more: Any) -> None:
        """Send a command of the operator's panel, as of ``fdhil sim --help``: ``command("override", percent=50)``.

        A command that the machine refuses fails the test.
        """
        assert self._service is not None
        if wrong := self._service.execute_command(json.dumps({"command": command, **more})):
            pytest.fail(f"the feed drive bench failed: {wrong}")

    def fault(self, name: str, axis: str | None = "X", **more: Any) -> None:
        """Inject a fault of docs/reference/faults.md: ``fault("load_torque", value=5.0, duration_s=0.3)``."""
        self.command("fault", fault=name, **({} if axis is None else {"axis": axis}), **more)

    def play(self, program: str | Path, trace: Path | None = None) -> None:
        """Switch the machine's own NC on and run a program: its text, or an NC or demand file."""
        if isinstance(program, str):
            path = self.folder / f"program{next(_channel)}.ngc"
            path.write_text(program, "utf-8")
            program = path
        if trace is not None:
            self.command("trace", file=str(trace))
        self.command("nc", on=True)
        self.command("play", file=str(program))

    def wait_for(self, event: str) -> dict[str, Any]:
        """Wait for an event (``ready``, ``nc``, ``playing``, ``finished``) and return it; drop earlier ones.

        Fails the test when the machine cannot do what was commanded, or reports nothing for ``patience_s``.
        """
        while True:
            try:
                received = self._events.get(timeout=self._patience_s)
            except queue.Empty:
                pytest.fail(f"the feed drive bench did not report {event!r} within {self._patience_s:g} s")
            if received["event"] == "error":
                pytest.fail(f"the feed drive bench failed: {received['text']}")
            if received["event"] == event:
                return received


def _build_bench_document(axes: str, bus: str) -> dict[str, Any]:
    from fdhil.cli.demo.machines import load_machine_document

    document = load_machine_document()
    first = next(iter(document["axis"].values()))
    kept = {"machine": document["machine"], "axis": {name: copy.deepcopy(first) for name in axes}}
    places: Mapping[str, dict[str, Any]] = {
        "virtual": {"interface": "virtual", "channel": f"feed-drive-bench-{next(_channel)}"},
        "hub": {"interface": "socketcand", "port": 0},
    }
    return kept | {"bus": {"can0": places.get(bus, {"interface": "socketcan", "channel": bus})}}
