"""The dialect of a program: LinuxCNC's, and other NCs' meaning of a dwell's P and of numbers without a decimal point.

On a Haas or a Fanuc X10000 is 10 mm and G4 P500 half a second; LinuxCNC reads them as 10 m and 500 s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from fdhil.config import Nc
from fdhil.program.modal_state import MM_PER_INCH, ModalState
from fdhil.program.words import Block

_LENGTHS = frozenset("xyzuvwijkr")
_ANGLES = frozenset("abc")
_PECKING = frozenset({730, 830})
_MM_STEP, _INCH_STEP, _DEGREE_STEP = 1e-3, 1e-4, 1e-3
_INCH, _INVERSE_TIME = 200, 930


@dataclass(frozen=True, slots=True)
class Dialect:
    """How numbers are read; see the keys of ``[nc]`` with these names for the values."""

    dwell_unit: Literal["s", "ms", "ms_without_point"] = "s"
    integers: Literal["whole", "thousandths", "thousandths_and_feed"] = "whole"
    wrapped_axes: tuple[str, ...] = ()

    @classmethod
    def create_from_config(cls, nc: Nc) -> Dialect:
        """Return the dialect of a machine's configuration."""
        return cls(nc.dwell_unit, nc.integers, nc.wrapped_axes)

    @property
    def is_plain(self) -> bool:
        """Whether every length and angle is in whole units."""
        return self.integers == "whole"

    def convert_dwell_s(self, value: float, pointless: bool) -> float:
        """Return a dwell in seconds; ``pointless``: it is written without a decimal point."""
        in_ms = self.dwell_unit == "ms" or (self.dwell_unit == "ms_without_point" and pointless)
        return value * 1e-3 if in_ms else value

    def scale_block(self, block: Block, modal: ModalState) -> Block:
        """Return a block with its integers converted to whole units; Q is a length in pecking cycles only."""
        if self.is_plain or not block.pointless:
            return block
        inch = block.g.get("units", _INCH if modal.scale == MM_PER_INCH else 0) == _INCH
        step = _INCH_STEP if inch else _MM_STEP
        steps = dict.fromkeys(_LENGTHS, step) | dict.fromkeys(_ANGLES, _DEGREE_STEP)
        if block.g.get("motion", modal.motion) in _PECKING:
            steps["q"] = step
        if self.integers == "thousandths_and_feed" and block.g.get("feed mode", modal.feed_mode) != _INVERSE_TIME:
            steps["f"] = step
        words = {
            letter: value * steps[letter] if letter in block.pointless and letter in steps else value
            for letter, value in block.words.items()
        }
        return replace(block, words=words)


LINUXCNC = Dialect()
