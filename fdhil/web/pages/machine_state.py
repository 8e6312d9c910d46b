"""Assesses a status document: the state of each axis, and what to do next. Pure: a document in, sentences out."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from pydantic import BaseModel

from fdhil.arming import ADOPT_ADVICE, ORDERED_ENDS, START_AND_ADOPT

Light = Literal["good", "warn", "bad", "none"]
LIVE_S = 2.0
NEAR = 0.5
"""The share of a maintenance limit from which a changed parameter is reported."""
ENABLED = "Operation enabled"
DRIVE_FAULTS = ("Fault", "Fault reaction active")


class AxisLight(BaseModel):
    """The state of an axis, as a colour and in words."""

    light: Light
    text: str


class Step(BaseModel):
    """What to do next: ``urgent`` with a residual offset or a lost guard, ``page`` if it is done in the browser."""

    text: str
    advice: str
    urgent: bool = False
    page: str = ""


def classify_axis(axis: Mapping[str, Any], troubles: list[str]) -> AxisLight:
    """Return the state of an axis: faults first, then missing data, then warnings."""
    received_s, last = axis.get("samples_s_ago"), axis.get("last_window")
    if axis.get("drive_state") in DRIVE_FAULTS:
        return AxisLight(
            light="bad", text=f"the drive is in state {axis['drive_state']}; read its fault code at the drive"
        )
    if troubles:
        return AxisLight(light="bad", text=troubles[0])
    if received_s is None or received_s > LIVE_S:
        ago = "no samples yet" if received_s is None else f"no samples for {received_s:.0f} s"
        return AxisLight(light="none", text=f"{ago}; switch the drive on, or check its bus")
    if axis.get("parameters") is None:
        return AxisLight(light="none", text=_explain_missing_parameters(axis))
    if last and not last["accepted"]:
        why = f": {last['reasons'][0]}" if last["reasons"] else ""
        return AxisLight(light="warn", text=f"the last rapid was refused{why}")
    if axis.get("warnings"):
        return AxisLight(light="warn", text=str(axis["warnings"][0]))
    return AxisLight(light="good", text="in order")


def _explain_missing_parameters(axis: Mapping[str, Any]) -> str:
    refused = axis.get("refused_by") or {}
    if not refused:
        return "no parameters yet; run a few rapids (G0) of this axis"
    code, count = max(refused.items(), key=lambda pair: pair[1])
    return f"no parameters yet: {count} rapids were refused because of {code}"


def classify_change(value: float, half: float | None, first: float | None, limit: float) -> tuple[float | None, Light]:
    """Return a parameter's relative change from its first value, and how near it is to the maintenance limit.

    Bad only if the change less half its 95 % interval exceeds the limit. Without an interval it is unknown.
    """
    if not first or half is None or not math.isfinite(half):
        return None, "none"
    change, doubt = value / first - 1, half / abs(first)
    if abs(change) - doubt > limit:
        return change, "bad"
    return change, "warn" if abs(change) > NEAR * limit else "good"


def suggest_steps(status: Mapping[str, Any], acting: bool) -> Iterator[Step]:
    """Yield what to do next, the most urgent first; at least one step."""
    found = [
        *_suggest_guard_steps(status),
        *_suggest_bus_steps(status),
        *_suggest_fault_steps(status),
        *_suggest_notice_steps(status),
        *_suggest_identification_steps(status),
    ]
    yield from found or _suggest_next_step(status, acting)


def _suggest_guard_steps(status: Mapping[str, Any]) -> Iterator[Step]:
    guard, residual = status.get("guard") or {}, status.get("may_stand") or {"nothing": True}
    if status["state"] == "lost":
        yield Step(text=f"The guard is lost: {residual.get('text', '')}", advice=START_AND_ADOPT, urgent=True)
    elif not residual["nothing"] and status["state"] in ("OFF", "FROZEN", "OFF(SHADOW)"):
        yield Step(text=f"{residual['text']}", advice=ADOPT_ADVICE, urgent=True)
    cause = guard.get("cause")
    if cause and cause["code"] not in ORDERED_ENDS:
        yield Step(text=f"{cause['code']}: {cause['text']}", advice=cause.get("advice", ""))


def _suggest_bus_steps(status: Mapping[str, Any]) -> Iterator[Step]:
    source = status["source"]["state"]
    if source == "reconnecting":
        yield Step(text="The bus is lost.", advice="check the adapter and the cable; it is reopened automatically")
    elif source == "silent":
        yield Step(text="The bus is silent.", advice="switch the machine on; then check wiring and bit rate")
    if fault := status["store"]["fault"]:
        yield Step(text=f"Nothing is stored: {fault}", advice="free or repair the disk; nothing can be armed meanwhile")


def _suggest_fault_steps(status: Mapping[str, Any]) -> Iterator[Step]:
    for trouble in status["troubles"]:
        text, _, advice = str(trouble["text"]).partition("; ")
        where = f"{trouble['axis']}: " if trouble["axis"] else ""
        yield Step(text=f"{where}{text} ({trouble['code']})", advice=advice)


def _suggest_notice_steps(status: Mapping[str, Any]) -> Iterator[Step]:
    if active := (status.get("alarms") or {}).get("active"):
        count = "One alarm is active." if active == 1 else f"{active} alarms are active."
        yield Step(text=count, advice="see the page Events", page="/events")
    waiting = status.get("unacknowledged") or {"count": 0}
    if waiting["count"]:
        major = f", {waiting['MAJOR']} of them major" if waiting.get("MAJOR") else ""
        count = "One notice waits" if waiting["count"] == 1 else f"{waiting['count']} notices wait"
        yield Step(text=f"{count} to be acknowledged{major}.", advice="see the page Events", page="/events")


def _suggest_identification_steps(status: Mapping[str, Any]) -> Iterator[Step]:
    unknown = [axis for axis, state in status["axes"].items() if state["parameters"] is None]
    if unknown and status["source"]["state"] == "listening":
        text = f"The parameters of {', '.join(unknown)} are not identified yet."
        yield Step(text=text, advice="run a few rapids (G0) of each in both directions, over most of the travel")


def _suggest_next_step(status: Mapping[str, Any], acting: bool) -> Iterator[Step]:
    if status.get("armed"):
        yield Step(
            text="A correction is armed.", advice="start the program at the NC; its error is measured as it runs"
        )
    elif status["state"] == "OFF(SHADOW)":
        advice = "to correct, run fdhil commission and start fdhil-guard; without it the machine is only monitored"
        yield Step(text="Everything is in order. No guard is running, so nothing can be corrected.", advice=advice)
    else:
        by = "below" if acting else "with fdhil arm CONFIG PROGRAM"
        yield Step(text="Everything is in order.", advice=f"arm a program {by}, or judge one on the page Program")
