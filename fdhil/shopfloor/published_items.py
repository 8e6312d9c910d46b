"""Lists the published items, once for all protocols: named values derived from the daemon's status. Pure.

An unknown value is None, and so is every value while the daemon is silent: each protocol reports that in its own way (a
bad quality, UNAVAILABLE, no value at all), and never with an old number.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from fdhil.guard import FEEDFORWARD_STATE, Mode
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
STATES = ("OFF(SHADOW)", *(mode.value for mode in Mode), FEEDFORWARD_STATE, "lost")
SOURCE_STATES = ("listening", "silent", "reconnecting")
MOTIONS = tuple(kind.value for kind in MoveKind)


@dataclass(frozen=True, slots=True)
class PublishedItem:
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
class PublishedValue:
    """One published value. ``axis`` and ``bus`` are empty for values of the whole machine; ``value`` None: unknown.

    ``stamp_ms`` is its time, Unix time in ms: that of the status, less the age where there is one.
    """

    item: PublishedItem
    value: Plain
    stamp_ms: int
    axis: str = ""
    bus: str = ""

    @property
    def key(self) -> tuple[str, str, str]:
        """Its identity: name, axis and bus."""
        return self.item.name, self.axis, self.bus


@dataclass(frozen=True, slots=True)
class PublishedAlarm:
    """An active problem: class, axis, cause and next action."""

    code: str
    severity: Literal["minor", "MAJOR"]
    text: str
    axis: str = ""


@dataclass(frozen=True, slots=True)
class PublishedEvent:
    """A notice of the daemon, its time (Unix time in ms), and the daemon's uptime at that time."""

    code: str
    severity: Literal["info", "minor", "MAJOR"]
    text: str
    axis: str
    stamp_ms: int
    uptime_s: float


def _get_base_name(path: Any) -> Plain:
    return None if path is None else str(path).rpartition("/")[2]


def _join_sentences(sentences: Any) -> Plain:
    return "; ".join(map(str, sentences))


def _get_armed_program(status: Any) -> Plain:
    """Return the file's name; empty while nothing is armed, or a correction without a program."""
    return _get_base_name(_look_up(status, "armed.program") or "") if status else None


def _make_pass_reader(path: str) -> Callable[[Any], Plain]:
    return lambda passes: _get_plain_value(_look_up(passes[-1], path)) if passes else None


_GUARD = {"age": "guard.heard_s_ago", "live_s": GUARD_LIVE_S}
_NC = {"age": "nc.heard_s_ago", "live_s": NC_LIVE_S}


def _make_measure(name: str, unit: str, path: str, description: str, **more: Any) -> PublishedItem:
    return PublishedItem(name, "measure", unit, description, path, **more)


def _make_count(name: str, path: str, description: str) -> PublishedItem:
    return PublishedItem(name, "count", "", description, path)


def _make_text(name: str, path: str, description: str, **more: Any) -> PublishedItem:
    return PublishedItem(name, "text", "", description, path, **more)


def _make_state(name: str, choices: tuple[str, ...], path: str, description: str, **more: Any) -> PublishedItem:
    return PublishedItem(name, "state", "", description, path, choices=choices, **more)


def _make_flag(name: str, path: str, description: str, **more: Any) -> PublishedItem:
    return PublishedItem(name, "flag", "", description, path, **more)


def _make_parameter_items(name: str) -> Iterator[PublishedItem]:
    """Yield a parameter and the two ends of its 95 % interval."""
    for end, key, words in (("", "value", ""), ("_low", "low", ": lower end"), ("_high", "high", ": upper end")):
        words += " of its 95 % interval" if words else ""
        yield _make_measure(
            f"{name}{end}", UNITS[name], f"axes.{{axis}}.parameters.{name}.{key}", f"{MEANING[name]}{words}"
        )


MACHINE: tuple[PublishedItem, ...] = (
    _make_state("state", STATES, "state", "state of the correction"),
    _make_flag(
        "offset_stands", "may_stand.nothing", "whether an offset may be applied in a drive", shown=lambda no: not no
    ),
    _make_state("hearing", SOURCE_STATES, "source.state", "whether frames are received from the machine's buses"),
    _make_count("source_lost", "source.lost_times", "how often the connection to the buses was lost"),
    _make_measure("uptime", "s", "uptime_s", "how long the daemon has been running"),
    _make_measure("sync_rate", "Hz", "sync.rate_hz", "rate of the SYNC messages"),
    _make_measure("sync_expected", "Hz", "sync.expected_hz", "rate of SYNC by the configuration"),
    _make_count("frames_received", "frames.received", "CAN frames received"),
    _make_count("frames_lost", "frames.lost", "CAN frames that were lost"),
    _make_count("records_dropped", "counters.records_dropped", "records that were dropped unread"),
    _make_measure("troubles", "", "troubles", "number of deviations from the configuration", shown=len),
    _make_measure("unacknowledged", "", "unacknowledged.count", "number of unacknowledged notices"),
    _make_measure("unacknowledged_major", "", "unacknowledged.MAJOR", "how many of them are MAJOR"),
    _make_text(
        "store_fault", "store", "why nothing is stored, empty while all is well", shown=lambda s: s["fault"] or ""
    ),
    _make_text("config_digest", "config_digest", "digest of the configuration"),
    _make_text("armed_program", "", "the armed program, empty without one", shown=_get_armed_program),
    _make_text("armed_method", "armed.method", "method of the armed correction"),
    _make_measure("predicted_before", "um", "armed.before.rms_um", "contour error (RMS) predicted without correction"),
    _make_measure("predicted_after", "um", "armed.after.rms_um", "contour error (RMS) predicted with the correction"),
    _make_measure("pass_number", "", "passes", "number of the program's last pass", shown=_make_pass_reader("pass")),
    _make_measure(
        "pass_rms", "um", "passes", "contour error (RMS) measured in it", shown=_make_pass_reader("measured.rms_um")
    ),
    _make_measure(
        "pass_max", "um", "passes", "largest contour error measured in it", shown=_make_pass_reader("measured.max_um")
    ),
    _make_state("nc_motion", MOTIONS, "nc.motion", "motion of the NC", **_NC),
    _make_text("nc_program", "nc.program", "the NC's program", shown=_get_base_name, **_NC),
    _make_measure("nc_line", "", "nc.line", "line of the NC's program being executed", **_NC),
    _make_measure("nc_feed", "mm/min", "nc.feed_mm_min", "feed along the path", **_NC),
    _make_measure("nc_feed_override", "1", "nc.feed_override", "feed override, 1 is 100 %", **_NC),
    _make_measure("nc_rapid_override", "1", "nc.rapid_override", "rapid override, 1 is 100 %", **_NC),
)

_LAST, _SKILL = "axes.{axis}.last_window", "axes.{axis}.skill"
AXIS: tuple[PublishedItem, ...] = (
    *(item for name in PARAMETERS for item in _make_parameter_items(name)),
    _make_measure("revision", "", "axes.{axis}.revision", "revision of the parameters"),
    _make_measure("windows_used", "", "axes.{axis}.windows_used", "rapids that the parameters were identified from"),
    _make_count("windows_accepted", "axes.{axis}.accepted", "rapids that passed all checks"),
    _make_count("windows_refused", "axes.{axis}.refused", "rapids that were refused"),
    _make_flag("last_rapid_accepted", f"{_LAST}.accepted", "whether the last rapid passed all checks"),
    _make_measure(
        "last_rapid_fit", "%", f"{_LAST}.fit_percent", "share of the last rapid's speed that the model explains"
    ),
    _make_text("last_rapid_reasons", f"{_LAST}.reasons", "why the last rapid was refused", shown=_join_sentences),
    _make_measure("unexplained", "um", "axes.{axis}.unexplained_um", "residual error of a rapid at the table (RMS)"),
    _make_text("warnings", "axes.{axis}.warnings", "deficiencies of the model", shown=_join_sentences),
    _make_measure(
        "following_error", "um", f"{_SKILL}.measured_rms_um", "following error (RMS) in the last recorded move"
    ),
    _make_measure("prediction_error", "um", f"{_SKILL}.rms_um", "error of its prediction (RMS)"),
    _make_measure("identified_at", "degC", "axes.{axis}.temperature_c", "temperature at the identification"),
    _make_measure("slideway", "degC", "axes.{axis}.slideway_c", "temperature of the slideway"),
    _make_measure("samples_age", "s", "axes.{axis}.samples_s_ago", "age of the last samples"),
    _make_measure("offset", "um", "guard.offset_um.{axis}", "correction offset sent last", **_GUARD),
    _make_measure("may_stand", "um", "guard.may_stand_um.{axis}", "offset that may be applied in the drive", **_GUARD),
)

BUS: tuple[PublishedItem, ...] = (_make_measure("bus_load", "%", "bus_load_percent.{bus}", "load of the bus"),)


def list_published_values(
    axes: Sequence[str], buses: Sequence[str], status: Mapping[str, Any] | None, now_ms: int
) -> tuple[PublishedValue, ...]:
    """Return every published value of a status; None: the daemon is silent."""
    known: Mapping[str, Any] = {} if status is None else status
    return tuple(
        _make_value(item, known, now_ms, axis, bus)
        for items, axis, bus in _iterate_places(axes, buses)
        for item in items
    )


def _iterate_places(axes: Sequence[str], buses: Sequence[str]) -> Iterator[tuple[tuple[PublishedItem, ...], str, str]]:
    yield MACHINE, "", ""
    yield from ((AXIS, axis, "") for axis in axes)
    yield from ((BUS, "", bus) for bus in buses)


def _make_value(item: PublishedItem, status: Mapping[str, Any], now_ms: int, axis: str, bus: str) -> PublishedValue:
    found = _look_up(status, item.path.replace("{axis}", axis).replace("{bus}", bus))
    age_s = _look_up(status, item.age) if item.age else 0.0
    if not isinstance(age_s, int | float) or age_s > item.live_s:
        return PublishedValue(item, None, now_ms, axis, bus)
    shown = None if found is None else item.shown(found) if item.shown else _get_plain_value(found)
    return PublishedValue(item, shown, now_ms - round(1000 * age_s), axis, bus)


def _look_up(document: Any, path: str) -> Any:
    for part in filter(None, path.split(".")):
        document = document.get(part) if isinstance(document, Mapping) else None
    return document


def _get_plain_value(value: Any) -> Plain:
    return value if isinstance(value, bool | int | float | str) else None


def list_alarms(status: Mapping[str, Any] | None) -> tuple[PublishedAlarm, ...]:
    """Return the active problems that the daemon reports; its own silence is not among them."""
    known: Mapping[str, Any] = {} if status is None else status
    found = [
        PublishedAlarm(each["code"], each["severity"], each["text"], each["axis"]) for each in known.get("troubles", [])
    ]
    # not while the guard itself moves an offset
    if known.get("state") in ("OFF", "FROZEN", "lost") and _look_up(known, "may_stand.nothing") is False:
        found.append(
            PublishedAlarm(
                "OffsetStands", "MAJOR", f"{_look_up(known, 'may_stand.text')}; hold the feed, run fdhil adopt"
            )
        )
    if _look_up(known, "source.state") == "reconnecting":
        found.append(PublishedAlarm("SourceLost", "MAJOR", "the machine's buses cannot be read; see fdhil status"))
    if fault := _look_up(known, "store.fault"):
        found.append(PublishedAlarm("StoreFault", "MAJOR", f"{fault}: nothing is stored; see fdhil status"))
    return tuple(found)


def list_events(status: Mapping[str, Any], now_ms: int) -> tuple[PublishedEvent, ...]:
    """Return the newest notices of the daemon, oldest first."""
    return tuple(
        PublishedEvent(
            notice["code"],
            notice["severity"],
            notice["text"],
            notice["axis"],
            now_ms - round(1000 * notice["age_s"]),
            status["uptime_s"] - notice["age_s"],
        )
        for notice in status.get("notices", [])
    )
