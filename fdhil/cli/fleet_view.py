"""Shows the answers of ``fdhil fleet`` to a person, or as one JSON document."""

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import click

BEYOND = 1000.0  # deviations: sisters that are all the same
Lines = Callable[[Mapping[str, Any]], Iterator[str]]


def tell(answer: Mapping[str, Any], question: str, as_json: bool, lines: Lines) -> None:
    """Write an answer."""
    from fdhil.daemon.journal import printable

    if as_json:
        click.echo(json.dumps({"schema": f"fdhil-fleet-{question}-1", **answer}))
        return
    for line in lines(answer):
        click.echo(printable(line))


def status(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each machine, and what is wrong."""
    for machine in answer["machines"]:
        notices = f", {machine['open_notices']} notices wait" if machine["open_notices"] else ""
        missing = f", {machine['missing']} RECORDS MISSING" if machine["missing"] else ""
        axes = ", ".join(f"{axis} revision {told['revision']}" for axis, told in machine["axes"].items())
        heard = f"last heard {machine['last_heard']}, {machine['records']} records"
        yield f"{machine['machine']}: {axes or 'no parameters yet'}; {heard}{missing}{notices}{_doubt(machine)}"
    if not answer["machines"]:
        yield "no machine was heard yet"
    yield from map(_due, answer["due"])
    if answer["refused_messages"]:
        yield f"{answer['refused_messages']} messages were none of ours and are put aside in fleet.refused"


def _doubt(told: Mapping[str, Any]) -> str:
    return f"; NOT OF ONE MACHINE: {told['doubt']}; give each machine a name of its own" if told["doubt"] else ""


def _due(each: Mapping[str, Any]) -> str:
    what = f"{each['machine']} axis {each['axis']}: {each['parameter']} = {_number(each['value'])} {each['unit']}"
    limit = f"its limit {_number(each['limit'])}"
    if each["reached"]:
        return f"{what} HAS REACHED {limit}"
    latest = each["latest"][:10] if each["latest"] else "open"
    return f"{what} will reach {limit} on {each['date'][:10]} ({each['earliest'][:10]} to {latest})"


def trend(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each set, and the slope."""
    unit = answer["unit"]
    for told in answer["sets"]:
        at = f"{told['temperature_c']:5.1f} °C" if told["temperature_c"] is not None else "       "
        between = f"  95 %: {told['low']:.6g} ... {told['high']:.6g}" if told["low"] is not None else ""
        yield f"{told['time']}  {at}  {answer['parameter']} = {_number(told['value'])} {unit}{between}"
    slope = answer["slope_per_30_days"]
    if not answer["sets"]:
        yield f"no parameters of axis {answer['axis']} of {answer['machine']} were collected"
    elif slope is not None:
        yield f"slope: {slope:+.3g} {unit} per 30 days"


def compare(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield each group, the smallest value first."""
    for group in answer["groups"]:
        yield f"{answer['by']} {group['label'] or '(none)'}, axis {group['axis']}: {len(group['sisters'])} machines"
        unlike = {each["machine"] for each in group["outliers"]}
        for each in group["sisters"]:
            mark = "  UNLIKE ITS SISTERS" if each["machine"] in unlike else ""
            yield f"  {each['machine']:24}  {answer['parameter']} = {_number(each['value'])} {answer['unit']}{mark}"
        if group["median"] is not None:
            yield f"  median {_number(group['median'])}, spread {100 * group['spread']:.1f} %"
    if not answer["groups"]:
        yield "no parameters were collected yet"


def outliers(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each axis that is unlike its sisters."""
    for each in answer["outliers"]:
        what = f"{each['parameter']} = {_number(each['value'])} {each['unit']}, {100 * each['off']:+.1f} %"
        far = each["score"] is None or abs(each["score"]) > BEYOND
        score = "beyond all bounds" if far else f"{each['score']:+.1f} of {each['bound']:.1f}"
        sisters = f"what {each['sisters']} sisters let expect (median {_number(each['median'])})"
        shared = each["off_by_its_other_axes"] / each["off"] > 0.5 if each["off"] else False
        where = "as its other axes are: look at the machine, its oil and its room" if shared else "look at this axis"
        yield f"{each['machine']} axis {each['axis']}: {what} off {sisters}, {score}; {where}{_doubt(each)}"
    if not answer["outliers"]:
        yield "no axis is unlike its sisters"


def service(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield what was entered, or taken out."""
    what = f"axis {answer['axis']} of {answer['machine']}" if answer["axis"] else answer["machine"]
    if answer.get("removed"):
        yield f"the service of {what} on {answer['serviced_at'][:10]} is taken out"
    else:
        yield f"{what} was serviced at {answer['serviced_at']}; its age and its limits count from there"


def services(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield each service, and what it changed."""
    for each in answer["services"]:
        axis = f" axis {each['axis']}" if each["axis"] else ""
        yield f"{each['serviced_at']}  {each['machine']}{axis}  {each['note']}".rstrip()
        for change in each["changes"]:
            figures = f"{_number(change['before'])} {change['unit']} {change['change']:+.3g}"
            between = f"95 %: {change['low']:+.3g} ... {change['high']:+.3g}"
            sure = "" if change["sure"] else ", may be chance"
            yield f"  {change['axis']}  {change['parameter']} {figures}  ({between}{sure})"
        if not each["changes"]:
            yield "  not known yet what it changed: two sets before and two after are needed"
    if not answer["services"]:
        yield "no service was entered yet; fdhil fleet service does so"


def retain(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield what went."""
    months = ", ".join(name.removeprefix("records_").replace("_", "-") for name in answer["months"])
    yield f"months of records that went: {months or 'none'}"
    if answer["records_of_wrong_clocks"]:
        yield f"records of wrong clocks that went: {answer['records_of_wrong_clocks']}"
    freed = f"{answer['files_removed']} files, {answer['bytes_freed'] / 1e6:.1f} MB"
    yield f"recorded windows that went: {freed}"


def export(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield how much was written."""
    rows = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in answer["rows"].items())
    yield f"{answer['folder']}: {rows}; keep the key at the works"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.6g}"
