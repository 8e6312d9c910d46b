"""Fault responses: one kind of document for every fault, with its HTTP status."""

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel

from fdhil.arming import make_refusal
from fdhil.errors import ConfigError, ConnectError, DeviceTimeout, FdhilError, ProgramError, RecordingError, StoreError

STATUS: Mapping[type[FdhilError], int] = {
    ConnectError: 503,
    DeviceTimeout: 504,
    StoreError: 503,
    ConfigError: 422,
    ProgramError: 422,
    RecordingError: 422,
}
BY_CODE = {"AuthRequired": 403, "BadRequest": 422, "BadName": 400, "NoHistory": 404, "NotKept": 404, "Busy": 503}
REFUSED = 409
"""A refusal of the daemon or the guard is a conflict with the machine's state."""


class Fault(BaseModel):
    """A fault: its code, what happened and what it means for the machine, and the next action."""

    ok: Literal[False] = False
    code: str
    text: str
    advice: str


class RequestRefused(Exception):
    """Ends a request with a status and a :class:`Fault`; ``more`` is added to the document."""

    def __init__(self, status: int, code: str, text: str, advice: str = "", more: Mapping[str, Any] | None = None):
        self.status = status
        self.document = {**(more or {}), **make_refusal(code, text, advice)}
        super().__init__(text)


def find_http_status(error: FdhilError) -> int:
    code = getattr(error, "code", "")
    if code in BY_CODE:
        return BY_CODE[code]
    return next((status for kind, status in STATUS.items() if isinstance(error, kind)), 500)


def make_fault_document(error: FdhilError) -> dict[str, Any]:
    """Return an fdhil error as a fault; the text after the last semicolon is the advice."""
    text, _, advice = str(error).rpartition("; ")
    code = getattr(error, "code", None)
    return make_refusal(code if isinstance(code, str) else type(error).__name__, text or advice, advice if text else "")


def require_granted(answer: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the daemon's answer if it was granted; raise Refused with its reasons if not."""
    if answer.get("ok") is True:
        return answer
    code = str(answer.get("code", "NoAnswer"))
    reason = (str(answer.get("text", "the daemon gave no reason")), str(answer.get("advice", "see the daemon's log")))
    raise RequestRefused(BY_CODE.get(code, REFUSED), code, *reason, more=answer)
