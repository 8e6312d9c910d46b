"""Tracks the configuration changes that were offered to this machine, and the decisions on them.

``fdhil uplink`` writes the offers into a folder, one file each, ``NAME-VERSION.offer``; other modules read their
content. The decisions are in one file of the store, written only by the operator's own command: it records which
version of each offer was accepted last, so that older versions are recognised.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from fdhil.errors import StoreError
from fdhil.store.atomic_file import make_folder, make_store_error, write_file

ANSWERS_FILE = "offers.json"
SCHEMA = "fdhil-offers-1"
OFFER_NAME_PATTERN = r"[a-z0-9][a-z0-9-]{0,39}"
LARGEST_ANSWERS = 4 << 20
_FILE = re.compile(rf"({OFFER_NAME_PATTERN})-([1-9][0-9]{{0,8}})\.offer")


@dataclass(frozen=True, slots=True)
class OfferDecision:
    """The decision on an offer, by whom and when; ``config_digest`` is that of the configuration after it."""

    name: str
    version: int
    stage: int
    document: str
    answer: Literal["accepted", "rejected"]
    by: str
    reason: str
    at_s: float
    config_digest: str


def read_decisions(store: Path) -> list[OfferDecision]:
    """Return all decisions, oldest first. Raises StoreError if the file cannot be read."""
    path = store / ANSWERS_FILE
    try:
        with path.open("rb") as file:
            document = json.loads(file.read(LARGEST_ANSWERS))
        if document["schema"] != SCHEMA:
            raise ValueError
        return [_parse_decision(each) for each in document["answers"]]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        cause = (isinstance(error, OSError) and error.strerror) or "it is damaged"
        text = f"{path} cannot be read ({cause}): older offers cannot be recognised; restore or remove it"
        raise StoreError(text) from None


def _parse_decision(document: dict[str, Any]) -> OfferDecision:
    answer = OfferDecision(**document)
    numbers = type(answer.version) is int and type(answer.stage) is int and isinstance(answer.at_s, float)
    texts = (answer.name, answer.document, answer.by, answer.reason, answer.config_digest)
    if not numbers or not all(isinstance(text, str) for text in texts) or answer.answer not in ("accepted", "rejected"):
        raise ValueError
    return answer


def add_decision(store: Path, answer: OfferDecision) -> None:
    """Record a decision durably. Raises StoreError."""
    answers = [asdict(each) for each in (*read_decisions(store), answer)]
    try:
        make_folder(store)
    except OSError as error:
        raise make_store_error(store, error) from None
    content = json.dumps({"schema": SCHEMA, "answers": answers}).encode()
    if len(content) > LARGEST_ANSWERS:  # a larger file would not be read
        raise StoreError(f"{store / ANSWERS_FILE} has no room for another decision; it was not recorded")
    write_file(store / ANSWERS_FILE, content)


def find_newest_accepted(answers: Sequence[OfferDecision], name: str) -> int:
    """Return the newest accepted version of an offer; 0: none."""
    return max((each.version for each in answers if each.name == name and each.answer == "accepted"), default=0)


def make_file_name(name: str, version: int) -> str:
    return f"{name}-{version}.offer"


def list_offers(folder: Path) -> dict[Path, tuple[str, int]]:
    """Return the offers in a folder with name and version; none if it cannot be read."""
    try:
        found = {path: _FILE.fullmatch(path.name) for path in sorted(folder.iterdir())}
    except OSError:
        return {}
    return {path: (match[1], int(match[2])) for path, match in found.items() if match}


def list_undecided(folder: Path, store: Path) -> list[str]:
    """Return the names of the offers without a decision. Raises StoreError."""
    answered = {(each.name, each.version) for each in read_decisions(store)}
    return [
        f"{name} version {version}" for name, version in list_offers(folder).values() if (name, version) not in answered
    ]
