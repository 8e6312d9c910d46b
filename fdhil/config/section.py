"""All tables of the file share their base class and the kinds of number and name."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

# no quantity of a machine lies beyond, in the units used here; a key states its own range where that is narrower
SMALLEST, LARGEST = 1e-12, 1e9


def _of_a_machine(value: float) -> float:
    # no ge and le: those of a key would not narrow these but take their place, or lose theirs
    if value != 0 and not SMALLEST <= abs(value) <= LARGEST:
        raise ValueError(f"must be from {SMALLEST:g} to {LARGEST:g}")
    return value


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), AfterValidator(_of_a_machine)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), AfterValidator(_of_a_machine)]
Finite = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_of_a_machine)]
AxisName = Annotated[str, Field(pattern="^[A-Z]$")]


class Section(BaseModel):
    """A table of the TOML file: frozen, and a key it does not know is a fault."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class SectionWithFiles(Section):
    """A table in which a path is taken from the folder of the file that says it."""

    def placed(self, folder: Path) -> Self:
        """Return it with the paths of its files taken from ``folder``."""
        return self.model_copy(update={key: folder / value for key, value in self if isinstance(value, Path)})


def one_of(table: Mapping[str, str], or_suffix: str | None = None) -> AfterValidator:
    """Return the check that a name is of a table, or a path that ends in ``or_suffix``."""

    def check(name: str) -> str:
        if name not in table and not (or_suffix and name.endswith(or_suffix)):
            near = difflib.get_close_matches(name, table, n=1)
            names = ", ".join(table) + (f", or a path that ends in {or_suffix}" if or_suffix else "")
            raise ValueError(f"must be one of {names}" + (f"; did you mean {near[0]!r}?" if near else ""))
        return name

    return AfterValidator(check)
