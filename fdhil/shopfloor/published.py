"""Lists the published items, once for all protocols: named values derived from the daemon's status. Pure.

An unknown value is None, and so is every value while the daemon is silent: each protocol reports that in its own way (a
bad quality, UNAVAILABLE, no value at all), and never with an old number.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from fdhil.guard.protocol import FEEDFORWARD, Mode
from fdhil.records import PARAMETERS, UNITS, MoveKind

Kind = Literal["measure", "count", "flag", "state", "text"]
Plain = float | int | bool | str | None
GUARD_LIVE_S = 2.0  # the daemon polls the guard twice a second
NC_LIVE_S = 2.0
MEANING: Mapping[str, str] = {
    "R": "resistance of the motor's winding",
    "L": "inductance of the motor's winding",
    "K": "torque constant of the motor",
    "Jt": "inertia at the motor, the table's included",
    "ft": "viscous friction",
    "Cd": "Coulomb friction",
}
STATES = ("OFF(SHADOW)", *(mode.value for mode in Mode), FEEDFORWARD, "lost")
SOURCE_STATES = ("listening", "silent", "reconnecting")
MOTIONS = tuple(kind.value for kind in MoveKind)


@dataclass(frozen=True, slots=True)
class Item:
    """A published item; ``path`` leads to it in the status, {axis} and {bus} stand for their names.

    ``age`` leads to its age: beyond ``live_s`` it is unknown. ``choices`` are all values of a state. A ``count`` only
    grows, until the daemon restarts.
    """

    name: str
    kind: Kind
    unit: str
    description: str
    path: str
    shown: Callable[[Any], Plain] | None = None
    age: str = ""
    live_s: float = float("inf")
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Value:
    """One published value. ``axis`` and ``bus`` are empty for values of the whole machine; ``value`` None: unknown.

    ``stamp_ms`` is its time, Unix time in ms: that of the status, less the age where there is one.
    """

    item: Item
    value: Plain
    stamp_ms: int
    axis: str = ""
    bus: str = ""

    @property
    def key(self) -> tuple[str, str, str]:
        """Its identity: name, axis and bus."""
        return self.item.name, self.axis, self.bus


@dataclass(frozen=True, slots=True)
class Alarm:
    """An active problem: class, axis, cause and next action."""

    code: str
    severity: Literal["minor", "MAJOR"]
    text: str
    axis: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """A notice of the daemon, its time (Unix time in ms), and the daemon's uptime at that time."""

    code: str
    severity: Literal["info", "minor", "MAJOR"]
    text: str
    axis: str
    stamp_ms: int
    uptime_s: float


def _base_name(path: Any) -> Plain:
    return None if path is None else str(path).rpartition("/")[2]


def _joined(sentences: Any) -> Plain:
    return "; ".join(map(str, sentences))


def _armed_program(status: Any) -> Plain:
    """Return the file's name; empty while nothing is armed, or a correction without a program."""
    return _base_name(_at(status, "armed.program") or "") if status else None


def _newest_pass(path: str) -> Callable[[Any], Plain]:
    return lambda passes: _plain(_at(passes[-1], path)) if passes else None


_GUARD = {"age": "guard.heard_s_ago", "live_s": GUARD_LIVE_S}
_NC = {"age": "nc.heard_s_ago", "live_s": NC_LIVE_S}


def _measure(name: str, unit: str, path: str, description: str, **more: Any) -> Item:
    return Item(name, "measure", unit, description, path, **more)


def _count(name: str, path: str, description: str) -> Item:
    return Item(name, "count", "", description, path)


def _text(name: str, path: str, description: str, **more: Any) -> Item:
    return Item(name, "text", "", description, path, **more)


def _state(name: str, choices: tuple[str, ...], path: str, description: str, **more: Any) -> Item:
    return Item(name, "state", "", description, path, choices=choices, **more)


def _flag(name: str, path: str, description: str, **more: Any) -> Item:
    return Item(name, "flag", "", description, path, **more)


def _parameter(name: str) -> Iterator[Item]:
    """Yield a parameter and the two ends of its 95 % interval."""
    for end, key, words in (("", "value", ""), ("_low", "low", ": lower end"), ("_high", "high", ": upper end")):
        words += " of its 95 % interval" if words else ""
        yield _measure(f"{name}{end}", UNITS[name], f"axes.{{axis}}.parameters.{name}.{key}", f"{MEANING[name]}{words}")


MACHINE: tuple[Item, ...] = (
    _state("state", STATES, "state", "state of the correction"),
    _flag("offset_stands", "may_stand.nothing", "whether an offset may be applied in a drive", shown=lambda no: not no),
    _state("hearing", SOURCE_STATES, "source.state", "whether frames are received from the machine's buses"),
    _count("source_lost", "source.lost_times", "how often the connection to the buses was lost"),
    _measure("uptime", "s", "uptime_s", "how long the daemon has been running"),
    _measure("sync_rate", "Hz", "sync.rate_hz", "rate of the SYNC messages"),
    _measure("sync_expected", "Hz", "sync.expected_hz", "rate of SYNC by the configuration"),
    _count("frames_received", "frames.received", "CAN frames received"),
    _count("frames_lost", "frames.lost", "CAN frames that were lost"),
    _count("records_dropped", "counters.records_dropped", "records that were dropped unread"),
    _measure("troubles", "", "troubles", "number of deviations from the configuration", shown=len),
    _measure("unacknowledged", "", "unacknowledged.count", "number of unacknowledged notices"),
    _measure("unacknowledged_major", "", "unacknowledged.MAJOR", "how many of them are MAJOR"),
    _text("store_fault", "store", "why nothing is stored, empty while all is well", shown=lambda s: s["fault"] or ""),
    _text("config_digest", "config_digest", "digest of the configuration"),
    _text("armed_program", "", "the armed program, empty without one", shown=_armed_program),
    _text("armed_method", "armed.method", "method of the armed correction"),
    _measure("predicted_before", "um", "armed.before.rms_um", "contour error (RMS) predicted without correction"),
    _measure("predicted_after", "um", "armed.after.rms_um", "contour error (RMS) predicted with the correction"),
    _measure("pass_number", "", "passes", "number of the program's last pass", shown=_newest_pass("pass")),
    _measure("pass_rms", "um", "passes", "contour error (RMS) measured in it", shown=_newest_pass("measured.rms_um")),
    _measure("pass_max", "um", "passes", "largest contour error measured in it", shown=_newest_pass("measured.max_um")),
    _state("nc_motion", MOTIONS, "nc.motion", "motion of the NC", **_NC),
    _text("nc_program", "nc.program", "the NC's program", shown=_base_name, **_NC),
    _measure("nc_line", "", "nc.line", "line of the NC's program being executed", **_NC),
    _measure("nc_feed", "mm/min", "nc.feed_mm_min", "feed along the path", **_NC),
    _measure("nc_feed_override", "1", "nc.feed_override", "feed override, 1 is 100 %", **_NC),
    _measure("nc_rapid_override", "1", "nc.rapid_override", "rapid override, 1 is 100 %", **_NC),
)

_LAST, _SKILL = "axes.{axis}.last_window", "axes.{axis}.skill"
AXIS: tuple[Item, ...] = (
    *(item for name in PARAMETERS for item in _parameter(name)),
    _measure("revision", "", "axes.{axis}.revision", "revision of the parameters"),
    _measure("windows_used", "", "axes.{axis}.windows_used", "rapids that the parameters were identified from"),
    _count("windows_accepted", "axes.{axis}.accepted", "rapids that passed all checks"),
    _count("windows_refused", "axes.{axis}.refused", "rapids that were refused"),
    _flag("last_rapid_accepted", f"{_LAST}.accepted", "whether the last rapid passed all checks"),
    _measure("last_rapid_fit", "%", f"{_LAST}.fit_percent", "share of the last rapid's speed that the model explains"),
    _text("last_rapid_reasons", f"{_LAST}.reasons", "why the last rapid was refused", shown=_joined),
    _measure("unexplained", "um", "axes.{axis}.unexplained_um", "residual error of a rapid at the table (RMS)"),
    _text("warnings", "axes.{axis}.warnings", "deficiencies of the model", shown=_joined),
    _measure("following_error", "um", f"{_SKILL}.measured_rms_um", "following error (RMS) in the last recorded move"),
    _measure("prediction_error", "um", f"{_SKILL}.rms_um", "error of its prediction (RMS)"),
    _measure("identified_at", "degC", "axes.{axis}.temperature_c", "temperature at the identification"),
    _measure("slideway", "degC", "axes.{axis}.slideway_c", "temperature of the slideway"),
    _measure("samples_age", "s", "axes.{axis}.samples_s_ago", "age of the last samples"),
    _measure("offset", "um", "guard.offset_um.{axis}", "correction offset sent last", **_GUARD),
    _measure("may_stand", "um", "guard.may_stand_um.{axis}", "offset that may be applied in the drive", **_GUARD),
)

BUS: tuple[Item, ...] = (_measure("bus_load", "%", "bus_load_percent.{bus}", "load of the bus"),)


def published(
    axes: Sequence[str], buses: Sequence[str], status: Mapping[str, Any] | None, now_ms: int
) -> tuple[Value, ...]:
    """Return every published value of a status; None: the daemon is silent."""
    known: Mapping[str, Any] = {} if status is None else status
    return tuple(_value(item, known, now_ms, axis, bus) for items, axis, bus in _places(axes, buses) for item in items)


def _places(axes: Sequence[str], buses: Sequence[str]) -> Iterator[tuple[tuple[Item, ...], str, str]]:
    yield MACHINE, "", ""
    yield from ((AXIS, axis, "") for axis in axes)
    yield from ((BUS, "", bus) for bus in buses)


def _value(item: Item, status: Mapping[str, Any], now_ms: int, axis: str, bus: str) -> Value:
    found = _at(status, item.path.replace("{axis}", axis).replace("{bus}", bus))
    age_s = _at(status, item.age) if item.age else 0.0
    if not isinstance(age_s, int | float) or age_s > item.live_s:
        return Value(item, None, now_ms, axis, bus)
    shown = None if found is None else item.shown(found) if item.shown else _plain(found)
    return Value(item, shown, now_ms - round(1000 * age_s), axis, bus)


def _at(document: Any, path: str) -> Any:
    for part in filter(None, path.split(".")):
        document = document.get(part) if isinstance(document, Mapping) else None
    return document


def _plain(value: Any) -> Plain:
    return value if isinstance(value, bool | int | float | str) else None


def alarms(status: Mapping[str, Any] | None) -> tuple[Alarm, ...]:
    """Return the active problems that the daemon reports; its own silence is not among them."""
    known: Mapping[str, Any] = {} if status is None else status
    found = [Alarm(each["code"], each["severity"], each["text"], each["axis"]) for each in known.get("troubles", [])]
    # not while the guard itself moves an offset
    if known.get("state") in ("OFF", "FROZEN", "lost") and _at(known, "may_stand.nothing") is False:
        found.append(Alarm("OffsetStands", "MAJOR", f"{_at(known, 'may_stand.text')}; hold the feed, run fdhil adopt"))
    if _at(known, "source.state") == "reconnecting":
        found.append(Alarm("SourceLost", "MAJOR", "the machine's buses cannot be read; see fdhil status"))
    if fault := _at(known, "store.fault"):
        found.append(Alarm("StoreFault", "MAJOR", f"{fault}: nothing is stored; see fdhil status"))
    return tuple(found)


def events(status: Mapping[str, Any], now_ms: int) -> tuple[Event, ...]:
    """Return the newest notices of the daemon, oldest first."""
    return tuple(
        Event(
            notice["code"],
            notice["severity"],
            notice["text"],
            notice["axis"],
            now_ms - round(1000 * notice["age_s"]),
            status["uptime_s"] - notice["age_s"],
        )
        for notice in status.get("notices", [])
    )
