"""States the paper's claims as trials, and judges them by one rule.

A trial is a number that has to lie within bounds in a scenario. A scenario shows a claim when all its trials lie
within theirs. A claim that all its scenarios show holds; one that some show holds with a condition; the rest is not
reproduced. Nothing else decides, and no verdict is written down anywhere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from fdhil.report import Table


class Verdict(Enum):
    """What became of a claim."""

    HOLDS = "holds"
    CONDITION = "holds with a condition"
    NOT = "not reproduced"


@dataclass(frozen=True, slots=True)
class Trial:
    """A measured ``value`` that has to lie from ``least`` to ``most`` in a scenario; a nan lies nowhere."""

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
        """The bounds in words."""
        if math.isinf(self.most):
            return f"at least {self.least:g}"
        if math.isinf(self.least):
            return f"at most {self.most:g}"
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawing as inline SVG with a caption that stands alone."""

    caption: str
    svg: str


@dataclass(frozen=True, slots=True)
class Claim:
    """What the paper says in one place, what it measured there, and the trials that it is put to.

    ``kind`` is equation, figure or claim; ``source`` is the place in the paper; ``note`` says what the trials cannot.
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
        """The scenarios of the trials, each once."""
        return tuple(dict.fromkeys(trial.scenario for trial in self.trials))

    def shown_by(self, scenario: str) -> bool:
        """Whether all trials of a scenario hold."""
        return all(trial.holds for trial in self.trials if trial.scenario == scenario)

    @property
    def verdict(self) -> Verdict:
        """The verdict by the rule of this module."""
        shown = [self.shown_by(scenario) for scenario in self.scenarios]
        if all(shown) and shown:
            return Verdict.HOLDS
        return Verdict.CONDITION if any(shown) else Verdict.NOT

    @property
    def condition(self) -> str:
        """Where the claim holds and where it does not; empty unless it holds with a condition."""
        if self.verdict is not Verdict.CONDITION:
            return ""
        where = [scenario for scenario in self.scenarios if self.shown_by(scenario)]
        rest = [scenario for scenario in self.scenarios if scenario not in where]
        return f"in {', '.join(where)}; not in {', '.join(rest)}"
