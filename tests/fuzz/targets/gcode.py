"""NC programs, with O-words, macros, cycles and splines: motions or a ProgramError with its line, within the budget."""

from __future__ import annotations

import math
from pathlib import Path

from fdhil.errors import ProgramError
from fdhil.program import Budget, Dwell, interpret
from tests.fuzz.input_assessment import Target

ROOT = Path(__file__).resolve().parents[3]
BUDGET = Budget(max_blocks=2000, max_repeated_blocks=2000, max_call_depth=10, max_motions_per_block=2000)
PROGRAMS = """\
O100 sub;G1 X#1 F[#2+1];O100 endsub;O100 call [1] [2];O1 while [#5 lt 3];#5=[#5+1];G91 G0 X1;O1 endwhile;M2
O1 if [#1 eq 0];(debug, #1);G2 X1 Y1 I1 J0 F100;O1 else;O2 repeat [2];G3 X0 Y0 R5;O2 endrepeat;O1 endif;M30
G21 G17 G41.1 D1 G1 X1 Y1 F10;G40;G81 X1 Y1 Z-1 R1 L3;G73 Z-2 Q0.1 R1;G80;G5 I1 J1 P1 Q1 X2 Y2;G5.1 I1 J1 X3 Y3
#<_a>=[atan[1]/[2] ** 2 mod 3];G10 L2 P1 X1 R45;G92 X1;G52 X2;G43.1 Z1;G64 P0.01;G96 S100 D200;G33 Z-1 K1
G7;G71 Q1 X1 Z1 D0.1;O1 sub;G1 X1 Z0;Z-1;X2;O1 endsub;G76 P1 Z-1 I1 J.1 R1 K1 Q29 H2;G5.2 P1 L3 X1 Y1;X2 Y2 P2;G5.3
%;N10 M98 P100 L2;/N20 G53 G0 Z0;O100;M99;%"""
WORDS = """\
G0 G1 G2 G3 G41 G42 G40 G5.2 G5.3 G10L2 G33.1 G38.2 G53 G61 G71 G72 G76 G81 G83 G91 G92 G95 G98 M98 M99 M70 M73 O1 O<a>
#1= #<a>= [ ] sub endsub call return while endwhile do if elseif else endif repeat endrepeat break continue sin[ sqrt[
1e308 99999999 ##1"""


def taste(data: bytes) -> None:
    count = 0
    try:
        for motion in interpret(data.decode("latin-1").split("\n"), BUDGET):
            count += 1
            if not isinstance(motion, Dwell):
                assert all(map(math.isfinite, motion.end)), motion
    except ProgramError as error:
        assert 0 <= error.line <= data.count(b"\n") + 1
        assert len(str(error)) < 600
    assert count <= BUDGET.max_repeated_blocks + BUDGET.max_blocks + BUDGET.max_motions_per_block


def target() -> Target:
    shuttle = (ROOT / "configs" / "programs" / "shuttle.ngc").read_bytes()
    seeds = [shuttle, *(line.replace(";", "\n").encode() for line in PROGRAMS.splitlines())]
    return Target("gcode", seeds, taste, WORDS.encode().split(), 1500)
