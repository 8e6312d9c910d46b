"""Record one axis as the daemon would while commissioning moves it: the samples of its drive and sensors."""

import asyncio
import threading
from collections.abc import Callable
from typing import Self

from fdhil.config import MachineConfig
from fdhil.drivers import open_machine
from fdhil.errors import DeviceError
from fdhil.pipeline import Record, SampleBuffer
from fdhil.records import AxisSamples, NcState, Notice, Recording, TableSamples, TickTimes, VoltageSamples

LONGEST_S = 600.0


class LiveCapture:
    """Records of one axis, collected in its own thread until it is closed; a context manager.

    It has its own connection, so that the traffic on the bus is assessed. ``records`` grow while it is open.
    """

    def __init__(self, config: MachineConfig, axis: str, rapid_mm_s: float | None = None) -> None:
        """``rapid_mm_s`` is the speed of the test rapids; default: the axis' own."""
        self._config, self.axis = select_single_axis(config, axis, rapid_mm_s), axis
        self.records: list[Record] = []
        self._opened = threading.Event()
        self._stop: Callable[[], object] = lambda: None
        self._failure: DeviceError | None = None
        self._thread = threading.Thread(target=self._run_thread, name="fdhil-overhearing", daemon=True)

    def _run_thread(self) -> None:
        try:
            asyncio.run(self._gather_records())
        except DeviceError as error:
            self._failure = error
        finally:
            self._opened.set()

    async def _gather_records(self) -> None:
        async with open_machine(self._config) as source:
            running = asyncio.create_task(source.run(self._store_record))
            loop = asyncio.get_running_loop()
            self._stop = lambda: loop.call_soon_threadsafe(running.cancel)
            self._opened.set()
            await asyncio.wait([running])

    def _store_record(self, record: Record | NcState | Notice) -> None:
        if not isinstance(record, NcState | Notice):
            self.records.append(record)

    @property
    def newest_tick(self) -> int:
        """Newest tick received from the axis; -1 before the first."""
        blocks = (r for r in reversed(list(self.records)) if isinstance(r, AxisSamples) and r.tick.size)
        return next((int(block.tick[-1]) for block in blocks), -1)

    def raise_if_failed(self) -> None:
        """Raise what ended the recording: a ConnectError of the bus or a sensor."""
        if self._failure is not None:
            raise self._failure

    def build_recording(self) -> Recording:
        """Return all samples received."""
        period_s = self._config.machine.sync_period_s
        recent = SampleBuffer(self.axis, self._config.axis[self.axis], round(LONGEST_S / period_s), period_s)
        for record in self.records:
            if isinstance(record, AxisSamples | VoltageSamples | TableSamples | TickTimes):
                recent.append_block(record)
        return recent.extract_recording(0, self.newest_tick + 1)

    def __enter__(self) -> Self:
        self._thread.start()
        self._opened.wait()
        self.raise_if_failed()
        return self

    def __exit__(self, *_error: object) -> None:
        if self._thread.is_alive():
            self._stop()
        self._thread.join()


def select_single_axis(config: MachineConfig, axis: str, rapid_mm_s: float | None = None) -> MachineConfig:
    """Return the configuration of one axis, with rapids inferred from its demand: no NC is there to report them."""
    settings = config.axis[axis]
    drive = settings.drive.model_copy(update={"node_id": config.get_node_id(axis)})
    rapid = rapid_mm_s or settings.rapid_speed_mm_s
    settings = settings.model_copy(update={"drive": drive, "rapid_speed_mm_s": rapid})
    g0 = config.g0.model_copy(update={"source": "inferred"})
    return config.model_copy(update={"axis": {axis: settings}, "g0": g0})
