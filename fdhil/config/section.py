"""Base class of all configuration tables, and their kinds of number and name."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

# limits of every quantity, in the units used here; a key may have a narrower range
SMALLEST, LARGEST = 1e-12, 1e9


def _check_magnitude(value: float) -> float:
    # not by ge and le: those of a key would replace these instead of narrowing them
    if value != 0 and not SMALLEST <= abs(value) <= LARGEST:
        raise ValueError(f"must be from {SMALLEST:g} to {LARGEST:g}")
    return value


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), AfterValidator(_check_magnitude)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), AfterValidator(_check_magnitude)]
Finite = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_check_magnitude)]


def _refuse_control_characters(name: str) -> str:
    if any(unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in name):
        raise ValueError("must be one line without control characters")
    return name


ShownName = Annotated[
    str, AfterValidator(_refuse_control_characters)
]  # shown on terminals, pages and in other programs
AXIS_PATTERN = "[A-Z]2?"  # Y2 is the second drive of the gantry axis Y
AxisName = Annotated[str, Field(pattern=f"^{AXIS_PATTERN}$")]


def is_second_drive(axis: str) -> bool:
    """Whether a name, as Y2, is that of the second drive of a gantry axis."""
    return len(axis) == 2 and axis[1] == "2"


def _check_types(plan: Any, of: type[BaseModel]) -> None:
    """Insert the type check where the schema of ``of`` reads a number or a switch; other tables have their own."""
    if isinstance(plan, list | tuple):
        for part in plan:
            _check_types(part, of)
    elif isinstance(plan, dict) and plan.get("cls", of) is of:
        kind = plan.get("type")
        if kind in ("int", "float", "bool"):
            inner = dict(plan)
            plan.clear()
            plan.update(
                core_schema.no_info_before_validator_function(_check_switch if kind == "bool" else _check_number, inner)
            )
        else:
            for part in plan.values():
                _check_types(part, of)


def _check_number(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise PydanticCustomError("no_number", "must be a number")
    return value


def _check_switch(value: Any) -> Any:
    if not isinstance(value, bool):
        raise PydanticCustomError("no_switch", "must be true or false")
    return value


class Section(BaseModel):
    """A table of the TOML file: frozen, and an unknown key is a fault.

    Numbers and switches must have their TOML type: no text for either, no true for 1, no 1 for true. (Pydantic's strict
    mode is not used: a path, or a word of several, is always text.)
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def __get_pydantic_core_schema__(cls, source: type[BaseModel], handler: GetCoreSchemaHandler, /) -> CoreSchema:
        """Return the library's schema with the type checks of numbers and switches before all others."""
        plan = handler(source)
        _check_types(handler.resolve_ref_schema(plan), cls)
        return plan


class SectionWithFiles(Section):
    """A table whose paths are relative to the folder of its file."""

    def resolve_paths(self, folder: Path) -> Self:
        """Return a copy with its file paths resolved against ``folder``."""
        return self.model_copy(update={key: folder / value for key, value in self if isinstance(value, Path)})


def require_one_of(table: Mapping[str, str], or_suffix: str | None = None) -> AfterValidator:
    """Return the validator of a name from a table, or of a path that ends in ``or_suffix``."""

    def check_name(name: str) -> str:
        if name not in table and not (or_suffix and name.endswith(or_suffix)):
            near = difflib.get_close_matches(name, table, n=1)
            names = ", ".join(table) + (f", or a path that ends in {or_suffix}" if or_suffix else "")
            raise ValueError(f"must be one of {names}" + (f"; did you mean {near[0]!r}?" if near else ""))
        return name

    return AfterValidator(check_name)
