"""Answers to requests: granted with the result, or refused with code, cause and next action."""

from collections.abc import Mapping
from typing import Any

Answer = Mapping[str, Any]


def make_refusal(code: str, text: str, advice: str = "") -> dict[str, Any]:
    """Return a refusal: its code, cause and next action."""
    return {"ok": False, "code": code, "text": text, "advice": advice}


CHECK_ABANDONED: Answer = make_refusal(
    "Abandoned", "arming was abandoned during preparation; nothing is armed", "arm again if needed"
)
