"""Which offers of a works lie here to be looked at, and what was answered to each so far.

The offers are in a folder that ``fdhil uplink`` writes, one file each, ``NAME-VERSION.offer``; what stands in them is
looked at elsewhere. The answers are one file of the store, which the operator's own command alone writes: they say
which version of each offer was accepted last, so that an older one is known.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from fdhil.errors import StoreError
from fdhil.store.atomic import make_folder, store_error, write_file

ANSWERS_FILE = "offers.json"
SCHEMA = "fdhil-offers-1"
NAME = r"[a-z0-9][a-z0-9-]{0,39}"
LARGEST_ANSWERS = 4 << 20
_FILE = re.compile(rf"({NAME})-([1-9][0-9]{{0,8}})\.offer")


@dataclass(frozen=True, slots=True)
class Answer:
    """What was answered to an offer, by whom and when; ``config_digest``: of the configuration after it."""

    name: str
    version: int
    stage: int
    document: str
    answer: Literal["accepted", "rejected"]
    by: str
    reason: str
    at_s: float
    config_digest: str


def read_answers(store: Path) -> list[Answer]:
    """Return all answers, oldest first; StoreError where there is a file that cannot be read: nothing is known then."""
    path = store / ANSWERS_FILE
    try:
        with path.open("rb") as file:
            told = json.loads(file.read(LARGEST_ANSWERS))
        if told["schema"] != SCHEMA:
            raise ValueError
        return [_answer(each) for each in told["answers"]]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        cause = (isinstance(error, OSError) and error.strerror) or "it is damaged"
        text = (
            f"{path} cannot be read ({cause}), so that an older offer would not be known; bring it back, or remove it"
        )
        raise StoreError(text) from None


def _answer(told: dict[str, Any]) -> Answer:
    answer = Answer(**told)
    numbers = type(answer.version) is int and type(answer.stage) is int and isinstance(answer.at_s, float)
    texts = (answer.name, answer.document, answer.by, answer.reason, answer.config_digest)
    if not numbers or not all(isinstance(text, str) for text in texts) or answer.answer not in ("accepted", "rejected"):
        raise ValueError
    return answer


def add_answer(store: Path, answer: Answer) -> None:
    """Note an answer, on the disk when it returns; StoreError."""
    answers = [asdict(each) for each in (*read_answers(store), answer)]
    try:
        make_folder(store)
    except OSError as error:
        raise store_error(store, error) from None
    content = json.dumps({"schema": SCHEMA, "answers": answers}).encode()
    if len(content) > LARGEST_ANSWERS:  # more would not be read again
        raise StoreError(f"{store / ANSWERS_FILE} has no room for another answer; it was not noted")
    write_file(store / ANSWERS_FILE, content)


def newest_accepted(answers: Sequence[Answer], name: str) -> int:
    """Return the newest version of an offer that was accepted; 0: none."""
    return max((each.version for each in answers if each.name == name and each.answer == "accepted"), default=0)


def file_name(name: str, version: int) -> str:
    """Return the name of an offer's file."""
    return f"{name}-{version}.offer"


def lying(folder: Path) -> dict[Path, tuple[str, int]]:
    """Return the offers that lie in a folder, name and version of each; none where it cannot be read."""
    try:
        found = {path: _FILE.fullmatch(path.name) for path in sorted(folder.iterdir())}
    except OSError:
        return {}
    return {path: (told[1], int(told[2])) for path, told in found.items() if told}


def waiting(folder: Path, store: Path) -> list[str]:
    """Return the names of the offers that lie there and were not answered; StoreError."""
    answered = {(each.name, each.version) for each in read_answers(store)}
    return [f"{name} version {version}" for name, version in lying(folder).values() if (name, version) not in answered]
