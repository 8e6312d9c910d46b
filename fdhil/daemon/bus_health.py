"""Monitors reception: frames, SYNC and samples with their ages, and deviations from the config.

Pure; times are inputs. A bus without a frame in the last second is silent.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fdhil.cia402 import decode_power_state
from fdhil.config import MachineConfig
from fdhil.daemon.move_monitor import MoveMonitor
from fdhil.pipeline import Record
from fdhil.records import AxisSamples, Notice, TickTimes

LIVE_S = 1.0
LOAD_S = 1.0  # averaging time of the bus load
SYNC_INTERVALS = 500
RATE_NS = 1_000_000_000  # averaging time of the SYNC rate
FEW_SYNCS = 32
PERIOD_TOLERANCE = 0.02
PERIOD_S = 60.0  # time whose median rate determines the period
STEADY = 0.01  # spread of 90 % of the rates, above which they determine no period
PATIENCE_S = 3.0  # until a problem is reported
START_S = 10.0  # until a drive must send samples when SYNC runs
FRAME_BITS = 121  # 8 data bytes, 11 bit identifier, stuffing between none and the worst case
SILENCES = {"BusSilent", "BusDown", "SyncLost"}

Trouble = tuple[str, str]


class BusHealth:
    """State of all reception: takes every record and, a few times per second, the source's counters."""

    def __init__(self, config: MachineConfig, now_s: float) -> None:
        self._config = config
        self.open = False
        self.opened_s = now_s
        self.lost_times = 0
        self.moves = {axis: MoveMonitor(axis, config) for axis in config.axis}
        self._realtime = config.guard.clock == "monotonic" and config.sim.pace == "realtime"
        self._buses = tuple(dict.fromkeys(axis.drive.bus for axis in config.axis.values()))
        self._last_record_s: float | None = None
        self._silent: set[str] = set()
        self._reset(now_s)

    def _reset(self, now_s: float) -> None:
        """Reset everything: earlier counts belong to another source."""
        self._frames: dict[str, int] = {}
        self._received_s = dict.fromkeys(("", *self._buses), now_s)
        self._counters: Mapping[str, Any] = {}
        self._loads: tuple[float, dict[str, int]] = (now_s, {})
        self.load_percent: dict[str, float] = {}
        self._sync: deque[tuple[int, int]] = deque(maxlen=SYNC_INTERVALS + 1)
        self._sync_s: float | None = None
        self._rates: deque[tuple[float, float]] = deque()
        self._samples_s: dict[str, float] = {}
        self._statuswords: dict[str, int] = {}
        self._since_s: dict[Trouble, float] = {}
        self._silent.clear()

    def note_source_opened(self, now_s: float) -> None:
        """Note that the source is open."""
        self.open, self.opened_s = True, now_s
        self._reset(now_s)

    def note_source_lost(self, now_s: float) -> None:
        """Note that the source is lost until it is opened again."""
        self.open, self.opened_s = False, now_s
        self.lost_times += 1
        self._reset(now_s)

    def is_alive(self, now_s: float, silence_s: float) -> bool:
        """Return whether records arrive, or the reason for their absence is known (source lost, bus silent)."""
        latest = max(self.opened_s, self._last_record_s or self.opened_s)
        return not self.open or bool(self._silent) or now_s - latest <= silence_s

    def take_record(self, record: Record | Notice, now_s: float) -> None:
        """Note the arrival of SYNC and samples, and silence that the source itself reports."""
        self._last_record_s = now_s
        if isinstance(record, TickTimes):
            self._sync.extend(zip(record.tick.tolist(), record.t_ns.tolist(), strict=True))
            self._sync_s = now_s
        elif isinstance(record, AxisSamples) and record.axis in self.moves:
            if record.tick.size:  # an empty block: a mapped TPDO is missing
                self._samples_s[record.axis] = now_s
                self._statuswords[record.axis] = int(record.statusword[-1])
            self.moves[record.axis].take_samples(record, now_s)
        elif isinstance(record, Notice) and record.code in SILENCES:
            if record.severity == "info":
                self._silent.discard(record.code)
            else:
                self._silent.add(record.code)

    def take_counters(self, counters: Mapping[str, Any], now_s: float) -> None:
        """Take the source's counters: a growing one shows reception."""
        self._counters = counters
        frames = {bus: int(counters.get(f"{bus}.frames" if bus else "frames", 0)) for bus in self._received_s}
        for bus, count in frames.items():
            if count != self._frames.get(bus, 0):
                self._received_s[bus] = now_s
        self._frames = frames
        then_s, before = self._loads
        if before and now_s - then_s < LOAD_S:
            return
        for bus in self._buses if before else ():
            bits = max(0, frames[bus] - before[bus]) * FRAME_BITS / (now_s - then_s)
            self.load_percent[bus] = round(100 * bits / self._config.bus[bus].bitrate, 1)
        self._loads = now_s, frames

    def measure_sync_rate_hz(self, now_s: float) -> float | None:
        """Return the SYNC rate of the newest arrivals; None with too few, or none within the last second."""
        if self._sync_s is None or now_s - self._sync_s > LIVE_S:
            return None
        newest_tick, newest_ns = self._sync[-1]
        recent = [(tick, t_ns) for tick, t_ns in self._sync if newest_ns - t_ns <= RATE_NS and tick <= newest_tick]
        ticks, span_s = newest_tick - recent[0][0], (newest_ns - recent[0][1]) * 1e-9
        # two buses that are read one after the other may show the same ticks twice
        return ticks / span_s if len(recent) >= FEW_SYNCS and ticks > 0 and span_s > 0 else None

    def build_status(self, now_s: float) -> dict[str, Any]:
        """Return the reception part of the status document, with ages."""
        rate = self.measure_sync_rate_hz(now_s)
        ages = {bus: round(now_s - at_s, 3) for bus, at_s in self._received_s.items()}
        heard_s_ago = ages.pop("")
        state = "reconnecting" if not self.open else "listening" if heard_s_ago <= LIVE_S else "silent"
        return {
            "source": {
                "state": state,
                "since_s": round(now_s - self.opened_s, 3),
                "lost_times": self.lost_times,
                "heard_s_ago": heard_s_ago,
                "buses": ages if self.open else {},
                "last_record_age_s": None if self._last_record_s is None else round(now_s - self._last_record_s, 3),
            },
            "sync": {
                "rate_hz": None if rate is None else round(rate, 3),
                "expected_hz": round(1 / self._config.machine.sync_period_s, 3),
                "heard_s_ago": None if self._sync_s is None else round(now_s - self._sync_s, 3),
                "tick": self._sync[-1][0] if self._sync else None,
            },
            "bus_load_percent": self.load_percent if heard_s_ago <= LIVE_S else {},
        }

    def get_samples_age_s(self, axis: str, now_s: float) -> float | None:
        """Return the age of an axis' last samples, s; None when there were none."""
        at_s = self._samples_s.get(axis)
        return None if at_s is None else round(now_s - at_s, 3)

    def get_drive_state(self, axis: str) -> str | None:
        """Return the last reported CiA 402 state of a drive; None when there was none."""
        word = self._statuswords.get(axis)
        return None if word is None else decode_power_state(word).value

    # deviations from the config --------------------------------------------------------------------------------

    def find_lasting_troubles(self, windows: Mapping[str, int], now_s: float) -> dict[Trouble, str]:
        """Return lasting problems: (class, axis) -> cause and next action. ``windows``: number found per axis."""
        found = dict(self._find_troubles(windows, now_s)) if self.open else {}
        self._since_s = {trouble: self._since_s.get(trouble, now_s) for trouble in found}
        patience = {"NoSamples": START_S, "MovesNotUsed": 0.0, "ScaleSuspect": 0.0, "PitchSuspect": 0.0}
        lasting = {t for t, since_s in self._since_s.items() if now_s - since_s >= patience.get(t[0], PATIENCE_S)}
        return {trouble: text for trouble, text in found.items() if trouble in lasting}

    def _find_troubles(self, windows: Mapping[str, int], now_s: float) -> Iterator[tuple[Trouble, str]]:
        rate = self.measure_sync_rate_hz(now_s)
        if (suspect := self._check_sync_period(rate, now_s)) is not None:
            yield ("SyncPeriodSuspect", ""), suspect
        for axis, settings in self._config.axis.items():
            missing = self._find_missing_data(axis, settings.drive.bus, rate is not None, now_s)
            if missing is not None:
                yield (missing[0], axis), missing[1]
            elif (unused := self.moves[axis].find_trouble(windows.get(axis, 0), now_s)) is not None:
                yield (unused[0], axis), unused[1]

    def _check_sync_period(self, rate: float | None, now_s: float) -> str | None:
        """Return what is wrong with the SYNC period, by the rates of the last minute; None: nothing."""
        if not self._realtime or rate is None:
            self._rates.clear()
            return None
        self._rates.append((now_s, rate))
        while self._rates and now_s - self._rates[0][0] > PERIOD_S:
            self._rates.popleft()
        if now_s - self._rates[0][0] < PERIOD_S - LIVE_S:
            return None
        least, typical, most = np.quantile([each for _, each in self._rates], (0.05, 0.5, 0.95)).tolist()
        expected = 1 / self._config.machine.sync_period_s
        if abs(typical / expected - 1) <= PERIOD_TOLERANCE:
            return None
        if most - least > STEADY * typical:
            text = f"SYNC is uneven, {least:.0f} to {most:.0f} Hz instead of the configured {expected:.4g} Hz"
            return f"{text}: no period can be determined; reduce the load of this PC and of the SYNC producer"
        text = f"SYNC runs at {typical:.4g} Hz instead of {expected:.4g} Hz as configured: all parameters are wrong"
        return f"{text}; set sync_period_s = {1 / typical:.4g}, or correct the NC's"

    def _find_missing_data(self, axis: str, bus: str, synced: bool, now_s: float) -> tuple[str, str] | None:
        """Return the problem of a drive from which no data arrive while its bus is active."""
        if now_s - self._received_s[bus] > LIVE_S:
            return None
        node = f"node {self._config.get_node_id(axis)} on {bus}"
        if self._counters.get(f"{bus}.{axis}.heard") == 0:
            text = f"the drive ({node}) has never sent a frame; its axis is not monitored"
            if not synced:
                text += "; without SYNC this is normal for a drive that sends no heartbeat (0x1017), else"
                return "NodeNeverHeard", f"{text} check node_id in the config, its supply and its wiring"
            return "NodeNeverHeard", f"{text}; check node_id in the config, its supply and its wiring"
        age_s = self.get_samples_age_s(axis, now_s)
        if synced and (age_s is None or age_s > LIVE_S):
            text = f"the drive ({node}) sends no samples although SYNC runs"
            return "NoSamples", f"{text}; check its NMT state (Operational), and its TPDO mapping with fdhil check"
        return None
