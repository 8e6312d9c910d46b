"""Claims of the paper as trials, with the rule of their verdicts.

A trial is a number that must lie within bounds in a scenario. A scenario shows a claim if all its trials do. A claim
holds if all its scenarios show it, holds with a condition if some do, and is otherwise not reproduced. Nothing else
decides, and no verdict is stored. ``claims.toml`` has the texts of the claims.
"""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from importlib.resources import files
from typing import Any

from fdhil.report import Table


class Verdict(Enum):
    """Verdict on a claim."""

    HOLDS = "holds"
    CONDITION = "holds with a condition"
    NOT = "not reproduced"


@dataclass(frozen=True, slots=True)
class Trial:
    """A measured ``value`` that must lie between ``least`` and ``most`` in a scenario; nan never does."""

    scenario: str
    what: str
    value: float
    unit: str
    least: float = -math.inf
    most: float = math.inf

    @property
    def holds(self) -> bool:
        """Whether the value lies within its bounds."""
        return self.least <= self.value <= self.most

    @property
    def bounds(self) -> str:
        """The bounds as text."""
        if math.isinf(self.most):
            return f"at least {self.least:g}"
        if math.isinf(self.least):
            return f"at most {self.most:g}"
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawing as inline SVG with a self-contained caption."""

    caption: str
    svg: str


@dataclass(frozen=True, slots=True)
class Claim:
    """A statement of the paper, the paper's own value, and the trials that test it.

    ``kind`` is equation, figure or claim; ``source`` is the place in the paper; ``note`` explains limits of the trials.
    """

    key: str
    title: str
    kind: str
    source: str
    says: str
    paper: str
    rule: str
    trials: Sequence[Trial]
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    note: str = ""

    @property
    def scenarios(self) -> tuple[str, ...]:
        """The distinct scenarios of the trials."""
        return tuple(dict.fromkeys(trial.scenario for trial in self.trials))

    def is_shown_by(self, scenario: str) -> bool:
        """Return whether all trials of a scenario hold."""
        return all(trial.holds for trial in self.trials if trial.scenario == scenario)

    @property
    def verdict(self) -> Verdict:
        """The verdict by the rule of this module."""
        shown = [self.is_shown_by(scenario) for scenario in self.scenarios]
        if all(shown) and shown:
            return Verdict.HOLDS
        return Verdict.CONDITION if any(shown) else Verdict.NOT

    @property
    def condition(self) -> str:
        """Where the claim holds and where it does not; empty unless it holds with a condition."""
        if self.verdict is not Verdict.CONDITION:
            return ""
        where = [scenario for scenario in self.scenarios if self.is_shown_by(scenario)]
        rest = [scenario for scenario in self.scenarios if scenario not in where]
        return f"in {', '.join(where)}; not in {', '.join(rest)}"


@cache
def _read_texts() -> Mapping[str, Mapping[str, str]]:
    return tomllib.loads(files("fdhil.cli.paper").joinpath("claims.toml").read_text("utf-8"))


def make_claim(
    key: str,
    trials: Sequence[Trial],
    pictures: Sequence[Picture] = (),
    tables: Sequence[Table] = (),
    **values: Any,
) -> Claim:
    """Return a claim with its texts from ``claims.toml``, in which ``values`` replace the placeholders."""
    texts = {name: text.format(**values) for name, text in _read_texts()[key].items()}
    return Claim(key=key, trials=trials, pictures=pictures, tables=tables, **texts)
