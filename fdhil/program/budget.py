"""Bound the resources of an interpretation, so that no input can block the machine's computer forever."""

from __future__ import annotations

from dataclasses import dataclass

from fdhil.config import Nc
from fdhil.program.nc_dialect import LINUXCNC, Dialect


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of one interpretation; exceeding one raises a ProgramError that names line and word.

    ``max_blocks`` lines read, those of a loop counted each time; ``max_repeated_blocks`` lines executed again by loops
    and calls, and the motions beyond one that each orders; ``max_motions_per_block`` motions of one block;
    ``max_call_depth`` nested calls; ``max_nesting`` brackets within a value, and loops or conditions within one
    another; ``max_line_chars`` characters of a line; ``max_coordinate_mm`` largest co-ordinate; ``max_kept_lines``,
    ``max_labels`` and ``max_parameters`` are kept in memory. ``dialect`` is how the program's numbers are read.
    """

    max_blocks: int = 10_000_000
    max_repeated_blocks: int = 500_000
    max_motions_per_block: int = 100_000
    max_call_depth: int = 50
    max_nesting: int = 50
    max_line_chars: int = 4096
    max_coordinate_mm: float = 1e7
    max_kept_lines: int = 2000
    max_labels: int = 100_000
    max_parameters: int = 100_000
    dialect: Dialect = LINUXCNC

    @classmethod
    def create_from_config(cls, nc: Nc) -> Budget:
        """Return the budget and dialect of a machine's configuration."""
        return cls(
            nc.max_blocks,
            nc.max_repeated_blocks,
            max_call_depth=nc.max_call_depth,
            dialect=Dialect.create_from_config(nc),
        )
