"""Text and JSON output of ``fdhil fleet``."""

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import click

BEYOND = 1000.0  # deviations; larger ones come from peers with identical values
Lines = Callable[[Mapping[str, Any]], Iterator[str]]


def print_answer(answer: Mapping[str, Any], question: str, as_json: bool, lines: Lines | None = None) -> None:
    """Print an answer as text, by default with the ``LINES`` of its question, or as one JSON document."""
    from fdhil.daemon import escape_unprintable

    if as_json:
        click.echo(json.dumps({"schema": f"fdhil-fleet-{question}-1", **answer}))
        return
    for line in (lines or LINES[question])(answer):
        click.echo(escape_unprintable(line))


def describe_status(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield one line per machine, then due maintenance."""
    for machine in answer["machines"]:
        notices = f", {machine['open_notices']} notices pending" if machine["open_notices"] else ""
        missing = f", {machine['missing']} RECORDS MISSING" if machine["missing"] else ""
        axes = ", ".join(f"{axis} revision {found['revision']}" for axis, found in machine["axes"].items())
        seen = f"last seen {machine['last_heard']}, {machine['records']} records"
        yield f"{machine['machine']}: {axes or 'no parameters yet'}; {seen}{missing}{notices}{_describe_doubt(machine)}"
    if not answer["machines"]:
        yield "no machine has sent records yet"
    yield from map(_describe_due_limit, answer["due"])
    if answer["refused_messages"]:
        yield f"{answer['refused_messages']} messages are not from fdhil; they are stored in fleet.refused"


def _describe_doubt(each: Mapping[str, Any]) -> str:
    return f"; NOT ONE MACHINE: {each['doubt']}; give each machine a unique name" if each["doubt"] else ""


def _describe_due_limit(each: Mapping[str, Any]) -> str:
    what = (
        f"{each['machine']} axis {each['axis']}: {each['parameter']} = {_format_number(each['value'])} {each['unit']}"
    )
    limit = f"its limit {_format_number(each['limit'])}"
    if each["reached"]:
        return f"{what} HAS REACHED {limit}"
    latest = each["latest"][:10] if each["latest"] else "open"
    return f"{what} will reach {limit} on {each['date'][:10]} ({each['earliest'][:10]} to {latest})"


def describe_trend(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield one line per parameter set, then the slope."""
    unit = answer["unit"]
    for each in answer["sets"]:
        at = f"{each['temperature_c']:5.1f} °C" if each["temperature_c"] is not None else "       "
        between = f"  95 %: {each['low']:.6g} ... {each['high']:.6g}" if each["low"] is not None else ""
        yield f"{each['time']}  {at}  {answer['parameter']} = {_format_number(each['value'])} {unit}{between}"
    slope = answer["slope_per_30_days"]
    if not answer["sets"]:
        yield f"no parameters of axis {answer['axis']} of {answer['machine']} were collected"
    elif slope is not None:
        yield f"slope: {slope:+.3g} {unit} per 30 days"


def describe_groups(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield the machines of each group, smallest value first."""
    for group in answer["groups"]:
        yield f"{answer['by']} {group['label'] or '(none)'}, axis {group['axis']}: {len(group['sisters'])} machines"
        outliers = {each["machine"] for each in group["outliers"]}
        for each in group["sisters"]:
            mark = "  DIFFERS FROM ITS PEERS" if each["machine"] in outliers else ""
            value = f"{_format_number(each['value'])} {answer['unit']}"
            yield f"  {each['machine']:24}  {answer['parameter']} = {value}{mark}"
        if group["median"] is not None:
            yield f"  median {_format_number(group['median'])}, spread {100 * group['spread']:.1f} %"
    if not answer["groups"]:
        yield "no parameters collected yet"


def describe_outliers(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield one line per axis that differs from its peers."""
    for each in answer["outliers"]:
        what = f"{each['parameter']} = {_format_number(each['value'])} {each['unit']}, {100 * each['off']:+.1f} %"
        far = each["score"] is None or abs(each["score"]) > BEYOND
        score = "far beyond the bound" if far else f"{each['score']:+.1f} of {each['bound']:.1f}"
        peers = f"the value expected from {each['sisters']} peers (median {_format_number(each['median'])})"
        shared = each["off_by_its_other_axes"] / each["off"] > 0.5 if each["off"] else False
        where = (
            "its other axes differ likewise: inspect the machine, its oil and its environment"
            if shared
            else "inspect this axis"
        )
        yield f"{each['machine']} axis {each['axis']}: {what} from {peers}, {score}; {where}{_describe_doubt(each)}"
    if not answer["outliers"]:
        yield "no axis differs from its peers"


def describe_service(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield the recorded or deleted service."""
    what = f"axis {answer['axis']} of {answer['machine']}" if answer["axis"] else answer["machine"]
    if answer.get("removed"):
        yield f"service of {what} on {answer['serviced_at'][:10]} deleted"
    else:
        yield f"service of {what} at {answer['serviced_at']} recorded; age and limits count from then"


def describe_services(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield each service and the parameters it changed."""
    for each in answer["services"]:
        axis = f" axis {each['axis']}" if each["axis"] else ""
        yield f"{each['serviced_at']}  {each['machine']}{axis}  {each['note']}".rstrip()
        for change in each["changes"]:
            figures = f"{_format_number(change['before'])} {change['unit']} {change['change']:+.3g}"
            between = f"95 %: {change['low']:+.3g} ... {change['high']:+.3g}"
            sure = "" if change["sure"] else ", not significant"
            yield f"  {change['axis']}  {change['parameter']} {figures}  ({between}{sure})"
        if not each["changes"]:
            yield "  effect unknown yet: two sets before and two after are needed"
    if not answer["services"]:
        yield "no service recorded yet; record one with fdhil fleet service"


def describe_retention(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield the amount of deleted data."""
    months = ", ".join(name.removeprefix("records_").replace("_", "-") for name in answer["months"])
    yield f"deleted months of records: {months or 'none'}"
    if answer["records_of_wrong_clocks"]:
        yield f"deleted records of wrong clocks: {answer['records_of_wrong_clocks']}"
    freed = f"{answer['files_removed']} files, {answer['bytes_freed'] / 1e6:.1f} MB"
    yield f"deleted recorded windows: {freed}"


def describe_export(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield the amount of exported data."""
    rows = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in answer["rows"].items())
    yield f"{answer['folder']}: {rows}; keep the key inside your company"


def _format_number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.6g}"


LINES: Mapping[str, Lines] = {
    "status": describe_status, "trend": describe_trend, "compare": describe_groups, "outliers": describe_outliers,
    "service": describe_service, "services": describe_services, "retain": describe_retention, "export": describe_export,
}  # fmt: skip
