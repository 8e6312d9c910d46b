"""Text output of ``fdhil fleet reanalyse``."""

from collections.abc import Iterator, Mapping
from typing import Any

MOST_SHOWN = 20


def describe_changes(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield the change of each parameter, then the changed verdicts, then the unreadable windows."""
    unknown = f", {answer['without_config']} of them without a configuration" if answer["without_config"] else ""
    yield f"revision {answer['revision']}: {answer['windows']} windows analysed again{unknown}"
    for each in answer["moved"]:
        where = f"{answer['by']} {each['label'] or '(none)'}, axis {each['axis']}"
        change = "" if each["change"] is None else f" {100 * each['change']:+.3g} %"
        off = "unknown interval" if each["off"] is None else (
            f"{each['off']:.2g} of its 95 % interval, at most {each['most']:.2g}, {each['outside']} outside"
        )  # fmt: skip
        yield f"  {where}: {each['parameter']}{change} in {each['windows']} windows ({off})"
    for each in answer["verdicts"]:
        what = "newly accepted, was refused for" if each["accepted"] else "newly REFUSED for"
        where = f"{answer['by']} {each['label'] or '(none)'}, axis {each['axis']}"
        yield f"  {where}: {each['windows']} windows {what} {each['reason'] or 'no stated reason'}"
    shown = answer["listed"][:MOST_SHOWN]
    for each in shown:
        verdict = "accepted now" if each["accepted"] else "; ".join(each["reasons"])
        yield f"  {each['machine']} axis {each['axis']} window {each['number']}: {each['error'] or verdict}"
    if len(answer["listed"]) > len(shown):
        yield "  and more; --json lists up to a thousand, the view fleet.reanalysed lists all"
    if not answer["windows"]:
        yield "  no stored window matches that time, machine and axis; [uplink] windows selects which are sent complete"
    elif not (answer["moved"] or answer["listed"]):
        yield "  nothing changed"
    if answer["unreadable"]:
        yield f"{answer['unreadable']} windows could not be read: correct the cause, then run this again"
