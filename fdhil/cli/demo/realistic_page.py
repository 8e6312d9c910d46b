"""Report section on the realistic machine: imperfections, accepted rapids, parameters, contour errors."""

from fdhil.cli.demo.demo_page import CUT_HEAD, PARAMETER_HEAD, compute_rms, format_cut_rows, list_identified_rows
from fdhil.cli.demo.realistic_machine import AxisOutcome, RealisticResult
from fdhil.config import Reality
from fdhil.report import Section, Table, draw_contour_errors

SHAPES = ("_phase", "_speed")  # suffixes of values that belong to another term
VERDICT_HEAD = ("axis", "accepted rapids", "model", "reasons of refusals")


def build_section(realistic: RealisticResult) -> Section:
    """Return the section, which states a refused correction."""
    errors = {cut.label: cut.contour_um for cut in realistic.cuts}
    period_s = realistic.config.machine.sync_period_s
    text = (
        "The same loop on the same machine with imperfections of ordinary machines beyond the equations of the paper. "
        "Errors are those of the true table. The motor encoders do not measure the compliance of the screws; this "
        "resonance is configured, everything else is identified from four rapids per axis. The current sensors have "
        "a gain error of 1 %, and so have R, L, Jt, ft and Cd, which scale with the current."
    )
    if realistic.refused:
        text += f" The correction was refused: {realistic.refused}."
    return Section(
        "A realistic machine",
        text,
        tables=[
            Table(("imperfection", *realistic.config.axis), list_effect_rows(realistic)),
            Table(VERDICT_HEAD, list_verdict_rows(realistic), "Accepted rapids"),
            Table(PARAMETER_HEAD, list_parameter_rows(realistic), "Identified"),
            Table(CUT_HEAD, list_cut_rows(realistic), "Contour error, 10 m/min, at the true table"),
        ],
        figures=[("Contour error along the path, realistic machine", draw_contour_errors(period_s, errors))],
    )


def build_headline(realistic: RealisticResult) -> tuple[str, str]:
    """Return the line for the top of the page."""
    if realistic.refused:
        return "on a realistic machine", "refused"
    return "on a realistic machine reduced by", f"{realistic.cuts[0].rms_um / realistic.cuts[-1].rms_um:.1f} x"


def list_effect_rows(realistic: RealisticResult) -> list[list[str]]:
    """Return every key that is set for an axis, with its value per axis."""
    config = realistic.config
    levels = [config.sim.axis[axis].reality.model_dump(exclude_defaults=True) for axis in config.axis]
    return [[key, *(str(level.get(key, "")) for level in levels)]
            for key in Reality.model_fields if any(key in level for level in levels)]  # fmt: skip


def list_verdict_rows(realistic: RealisticResult) -> list[list[str]]:
    """Return one row per axis: accepted rapids, published model, reasons of refusals."""
    return [[axis, f"{found.accepted} of {found.rapids}", _describe_model(found),
             ", ".join(f"{count} x {code}" for code, count in found.reasons.items())]
            for axis, found in realistic.verdicts.items()]  # fmt: skip


def _describe_model(found: AxisOutcome) -> str:
    if found.published is None:
        return "none published"
    terms = ", ".join(name for name, _ in found.published.parameters.terms if not name.endswith(SHAPES))
    return f"six parameters and {terms}" if terms else "six parameters"


def list_parameter_rows(realistic: RealisticResult) -> list[list[str]]:
    """Return the true and the identified parameters of axes with a model."""
    return [row for axis, found in realistic.verdicts.items() if found.published is not None
            for row in list_identified_rows(axis, realistic.truth[axis], found.published)]  # fmt: skip


def list_cut_rows(realistic: RealisticResult) -> list[list[str]]:
    """Return the contour errors: predicted, if there is a model, and measured."""
    rows = []
    if realistic.predicted is not None:
        contour = realistic.predicted.contour_um
        rows.append(["predicted", "", f"{compute_rms(contour):.2f}", f"{contour.max():.1f}", ""])
    return rows + format_cut_rows(realistic.cuts)
