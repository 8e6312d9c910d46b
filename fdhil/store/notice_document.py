"""Formats a stored notice and its acknowledgement for JSON."""

from datetime import UTC, datetime
from typing import Any

from fdhil.store.history_rows import Acknowledgement, StoredNotice, TimeStamp


def make_notice_document(stored: StoredNotice) -> dict[str, Any]:
    notice = stored.notice
    return {
        "number": stored.number,
        "time": format_date(stored.stamp),
        "axis": notice.axis,
        "code": notice.code,
        "severity": notice.severity,
        "text": notice.text,
        "acknowledged": make_acknowledgement_document(stored.acknowledged),
    }


def make_acknowledgement_document(given: Acknowledgement | None) -> dict[str, Any] | None:
    """Return a notice's acknowledgement (who, when, note) for JSON; None without one."""
    return None if given is None else {"who": given.who, "time": format_date(given.stamp), "note": given.note}


def format_date(stamp: TimeStamp) -> str:
    """Return when a row was stored, in UTC by ISO 8601."""
    return datetime.fromtimestamp(stamp.wall_s, UTC).isoformat(timespec="seconds")
