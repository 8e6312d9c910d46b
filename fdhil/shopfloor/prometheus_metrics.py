"""Makes Prometheus metrics of the published items: base units, and names by Prometheus' conventions. Pure.

https://prometheus.io/docs/practices/naming/. Unknown values are absent; texts are not metrics, except those that name
what is running. All names begin with ``fdhil_``.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from importlib.metadata import version

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from fdhil.shopfloor.published_items import PublishedItem, PublishedValue
from fdhil.shopfloor.status_poller import StatusUpdate

VERSION = version("fdhil")  # read once, from files
UNITS: Mapping[str, tuple[str, float]] = {
    "": ("", 1.0),
    "1": ("ratio", 1.0),
    "%": ("ratio", 0.01),
    "s": ("seconds", 1.0),
    "Hz": ("hertz", 1.0),
    "um": ("meters", 1e-6),
    "mm/min": ("meters_per_second", 1e-3 / 60),
    "degC": ("celsius", 1.0),
    "ohm": ("ohms", 1.0),
    "H": ("henries", 1.0),
    "N.m/A": ("newton_meters_per_ampere", 1.0),
    "kg.m2": ("kilogram_square_meters", 1.0),
    "N.m.s": ("newton_meter_seconds", 1.0),
    "N.m": ("newton_meters", 1.0),
}
WORDS: Mapping[str, str] = {
    "R": "resistance",
    "L": "inductance",
    "K": "torque_constant",
    "Jt": "inertia",
    "ft": "viscous_friction",
    "Cd": "coulomb_friction",
}
TEXTS: Mapping[str, tuple[str, str]] = {  # texts that say what runs: metric and label
    "config_digest": ("fdhil", "config_digest"),
    "armed_program": ("fdhil_armed", "program"),
    "armed_method": ("fdhil_armed", "method"),
}


def name_metric(item: PublishedItem) -> str:
    """Return the name of an item's metric, without the _total of a counter."""
    first, _, rest = item.name.partition("_")
    words = "_".join(filter(None, [WORDS[first], rest])) if first in WORDS else item.name
    return "_".join(filter(None, ["fdhil", words, UNITS[item.unit][0]]))


class MetricsCollector(Collector):
    """The metrics of the newest update; only ``fdhil_up`` while there is none."""

    def __init__(self) -> None:
        self._news: StatusUpdate | None = None
        self._heard_ms: int | None = None
        self._notices: Counter[tuple[str, str]] = Counter()

    def take_update(self, news: StatusUpdate) -> None:
        """Take the newest update."""
        self._news = news
        self._heard_ms = self._heard_ms if news.silent else news.stamp_ms
        self._notices.update((event.code, event.severity) for event in news.events)

    def collect(self) -> Iterator[Metric]:
        """Yield every metric that has a value."""
        news = self._news
        up = news is not None and not news.silent
        yield GaugeMetricFamily("fdhil_up", "whether the daemon answers", float(up))
        if self._heard_ms is not None:
            words = "time of the daemon's last answer"
            yield GaugeMetricFamily("fdhil_answered_timestamp_seconds", words, self._heard_ms * 1e-3)
        if news is None or news.silent:
            return
        families: dict[str, Metric] = {}
        for value in news.values:
            if value.value is not None and value.item.kind != "text":
                _add_sample(families, value)
        yield from families.values()
        yield from _make_info_metrics(news)
        yield _make_alarm_metric(news)
        yield self._count_notices()

    def _count_notices(self) -> Metric:
        words = "notices of the daemon since this process started"
        family = CounterMetricFamily("fdhil_notices", words, labels=["code", "severity"])
        for (code, severity), count in sorted(self._notices.items()):
            family.add_metric([code, severity], count)
        return family


def _add_sample(families: dict[str, Metric], value: PublishedValue) -> None:
    item, name = value.item, name_metric(value.item)
    labels = {key: name for key, name in (("axis", value.axis), ("bus", value.bus)) if name}
    if item.kind == "count":
        family = families.setdefault(name, CounterMetricFamily(name, item.description, labels=list(labels)))
        family.add_sample(f"{name}_total", labels, float(value.value or 0))
        return
    family = families.setdefault(name, GaugeMetricFamily(name, item.description, labels=list(labels)))
    if item.kind == "state":
        for choice in item.choices:
            family.add_sample(name, {**labels, "state": choice}, float(choice == value.value))
    elif isinstance(value.value, bool | int | float):
        family.add_sample(name, labels, float(value.value) * UNITS[item.unit][1])


def _make_info_metrics(news: StatusUpdate) -> Iterator[Metric]:
    infos: dict[str, dict[str, str]] = {"fdhil": {"version": VERSION}}
    for value in news.values:
        if value.item.name in TEXTS and value.value:
            metric, label = TEXTS[value.item.name]
            infos.setdefault(metric, {})[label] = str(value.value)
    words = {"fdhil": "running version and configuration", "fdhil_armed": "armed correction"}
    for metric, labels in infos.items():
        yield InfoMetricFamily(metric, words[metric], labels)


def _make_alarm_metric(news: StatusUpdate) -> Metric:
    labels = ["code", "severity", "axis"]
    family = GaugeMetricFamily("fdhil_alarm", "an active problem; absent otherwise", labels=labels)
    for code, severity, axis in sorted({(each.code, each.severity, each.axis) for each in news.alarms}):
        family.add_metric([code, severity, axis], 1.0)
    return family
