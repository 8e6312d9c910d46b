"""Shows a person what a re-analysis changed."""

from collections.abc import Iterator, Mapping
from typing import Any

MOST_SHOWN = 20


def changes(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield how far each parameter moved, then whose verdict is another, then what could not be read."""
    unknown = f", {answer['without_config']} of them without a configuration" if answer["without_config"] else ""
    yield f"revision {answer['revision']}: {answer['windows']} windows analysed again{unknown}"
    for each in answer["moved"]:
        where = f"{answer['by']} {each['label'] or '(none)'}, axis {each['axis']}"
        change = "" if each["change"] is None else f" {100 * each['change']:+.3g} %"
        off = "no interval is known" if each["off"] is None else (
            f"{each['off']:.2g} of its 95 % interval, at most {each['most']:.2g}, {each['outside']} outside"
        )  # fmt: skip
        yield f"  {where}: {each['parameter']}{change} in {each['windows']} windows ({off})"
    for each in answer["verdicts"]:
        what = "newly accepted, was refused for" if each["accepted"] else "newly REFUSED for"
        where = f"{answer['by']} {each['label'] or '(none)'}, axis {each['axis']}"
        yield f"  {where}: {each['windows']} windows {what} {each['reason'] or 'no reason that was told'}"
    shown = answer["listed"][:MOST_SHOWN]
    for each in shown:
        verdict = "accepted now" if each["accepted"] else "; ".join(each["reasons"])
        yield f"  {each['machine']} axis {each['axis']} window {each['number']}: {each['error'] or verdict}"
    if len(answer["listed"]) > len(shown):
        yield "  and more; --json lists up to a thousand, and the view fleet.reanalysed all"
    if not answer["windows"]:
        yield "  no stored window is of that time, machine and axis; [uplink] windows says which are sent whole"
    elif not (answer["moved"] or answer["listed"]):
        yield "  nothing changed"
    if answer["unreadable"]:
        yield f"{answer['unreadable']} windows could not be read: see why, and call this again"
