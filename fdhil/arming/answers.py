"""Answers who asks for something: yes with what is known, or no with its class, cause and next action."""

from collections.abc import Mapping
from typing import Any

Answer = Mapping[str, Any]


def refusal(code: str, text: str, advice: str = "") -> dict[str, Any]:
    """Return the answer that says no: its class, cause and next action."""
    return {"ok": False, "code": code, "text": text, "advice": advice}


ABANDONED: Answer = refusal(
    "Abandoned", "the arming was abandoned while it was prepared", "arm again when it is wanted"
)
