"""Every motion compared with LinuxCNC's own interpreter, over generated programs and the package's examples."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from fdhil.errors import ProgramError
from fdhil.program import Budget, Motion, interpret
from fdhil.program.nc_dialect import Dialect
from tests.program.program_generator import GROUPS, generate_program
from tests.program.rs274_reference import ReferenceAnswer, find_difference, read_cases, run_reference

pytestmark = pytest.mark.debian

EXAMPLES = Path("/usr/share/linuxcnc/ncfiles")
# examples that fdhil executes differently, and why
OTHERWISE = {
    "cone.ngc": "W words: the reference has no such axis, fdhil lists them",
    "lathe_g70_71_demo.ngc": "G70 with cutter compensation: goes to the contour's end first, mended in LinuxCNC 2.9.3",
    "systems.ngc": "splines: the reference does not tell their points",
    "smartprobe.ngc": "a loop that ends when a probe trips before its target; fdhil's never do",
    "x-trim.ngc": "a probe's end: fdhil's target, the reference 0.01 inch before it",
    "tool-length-probe.ngc": "a probe that begins where another ended",
}
# seeds whose path has a cusp: an inside corner for one interpreter, an outside one for the other
CUSPS = {("compensation", seed) for seed in (140, 243, 287, 289, 290)}
ROUNDING_MM = 5e-4
ROUNDING_INCH_MM = 2e-2


def interpret_file(path: Path) -> tuple[list[Motion], str]:
    """Interpret a file: its motions up to its end or error, and the error."""
    motions: list[Motion] = []
    try:
        motions.extend(interpret(path))
    except ProgramError as error:
        return motions, str(error)
    return motions, ""


def compare_with_reference(motions: list[Motion], error: str, reference: ReferenceAnswer, tolerance_mm: float) -> str:
    """Return the difference: an error on one side only, or a motion."""
    if bool(error) != bool(reference.error):
        return f"ours: {error or 'accepted'}, theirs: {reference.error or 'accepted'}"
    if error:
        return ""
    return find_difference(motions, reference.motions, tolerance_mm)


def test_wrapped_rotary_axis_matches_reference(tmp_path: Path) -> None:
    """Absolute words of either sign, G91, G53 and G92, in random order."""
    path, random = tmp_path / "program.ngc", np.random.default_rng(4)
    budget = Budget(dialect=Dialect(wrapped_axes=("A",)))
    for _ in range(20):
        words = [f"A{angle:.3f}" for angle in random.choice([-1, 1], 40) * random.uniform(0.0, 359.0, 40)]
        heads = random.choice(["G90 G0", "G90 G0", "G91 G0", "G90 G53 G0", "G92"], 40)
        path.write_text("\n".join(map(" ".join, zip(heads, words, strict=True))) + "\nM2\n")
        reference = run_reference(path, ini="[AXIS_A]\nWRAPPED_ROTARY = 1\n[RS274NGC]\n")
        assert compare_with_reference(list(interpret(path, budget)), "", reference, ROUNDING_MM) == ""


@pytest.mark.parametrize("group", GROUPS)
def test_generated_programs_match_reference(group: str, tmp_path: Path) -> None:
    path = tmp_path / "program.ngc"
    for seed in range(40):
        text = generate_program(group, seed, 3 if group in ("compensation", "contours") else 25)
        path.write_text(text)
        tolerance_mm = ROUNDING_INCH_MM if "G20" in text else ROUNDING_MM
        try:
            reference = run_reference(path, 3.0)
        except subprocess.SubprocessError:  # some contours block the reference forever, or crash it; fdhil answers
            interpret_file(path)
            continue
        reported = compare_with_reference(*interpret_file(path), reference, tolerance_mm)
        assert not reported or (group, seed) in CUSPS, f"{group} {seed}: {reported}\n{text}"


def test_package_examples_match_reference() -> None:
    differing = {}
    agreed = 0
    for path in sorted(p for p in EXAMPLES.rglob("*.ngc") if p.name not in OTHERWISE):
        reference = run_reference(path)
        if "no percent sign or program end" in reference.error:  # for fdhil the end of the file ends the program
            reference.error = ""
        reported = compare_with_reference(*interpret_file(path), reference, ROUNDING_INCH_MM)
        if reported and "no tool table" not in reported:
            differing[path.name] = reported
        else:
            agreed += 1
    assert not differing, f"{agreed} agree"


def test_written_programs_match_reference(tmp_path: Path) -> None:
    path = tmp_path / "program.ngc"
    for text, why in read_cases():
        path.write_text(text)
        tolerance_mm = ROUNDING_INCH_MM if "G20" in text else ROUNDING_MM
        reported = compare_with_reference(*interpret_file(path), run_reference(path), tolerance_mm)
        assert bool(reported) == bool(why), f"{reported or 'agrees, though it should not: ' + why}\n{text}"


REFUSED = [
    "G1 X5", "G0 X1 X2", "G0 G1 X1 F1", "G2 X1 F1", "F1 G2 X10 I2", "F1 G2 X10 R2", "G4 P-1", "G0 X[1/0]", "X5",
    "G80 X5", "G0 X5 N6", "G93 G1 X1", "G95 G1 X1 F1", "F1 G2 X10 I5 P2.5", "F1 G2 X10 I5 P0", "F1 G2 R5", "G92",
    "G92 X5 G0", "G10 L2 P10 X1", "G10 L2 X1", "G10 L20 P1 R3", "G91 G53 G0 X1", "G0 @5", "G18\nG0 @5 ^3", "P5", "I5",
    "G0 X1 Q3", "H5", "M7 M9", "M3 M4", "G17 G18", "N-1 G0 X1", "G1.04 X1", "#5420=1", "#0=1", "#5602=1", "#1.5=1",
    "G0 X#<nope>", "o1 endif", "o1 while [0]", "o1 sub", "o1 foo", "o<nowhere> call", "o1 return", "o1 if 1",
    "o1 call G0 X1", "o1 if [1]\no1 endif\no2 if [1]\no1 if [1]", "M98", "M98 P77", "F10 G81 X1 Z3 R2", "F1 G81 X1 R2",
    "F10 G81 X1 Z-3 R2 L0", "F10 G83 X1 Z-3 R2 Q0", "F10 G84 X1 Z-3 R2", "G33 Z-5 K1", "F10 G38.2", "G19 G41.1 D2",
    "G41.1", "F100 G41.1 D2\nG1 X0.5", "F100 G41.1 D2\nG1 X10\nG55", "M72", "G0 X1 (open", "G0 X1 (a (b) c)", "%%",
    "S-5", "F-5", "#1=[5 mod 0]", "#1=ln[0]", "#1=asin[2]", "#1=sqrt[-1]", "#1=[-8 ** 0.3]", "G0 X1.2.3", "M1234",
]  # fmt: skip


@pytest.mark.parametrize("text", REFUSED)
def test_programs_refused_by_reference_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "program.ngc"
    path.write_text(text + "\nM2\n")
    assert run_reference(path).error
    assert interpret_file(path)[1]
