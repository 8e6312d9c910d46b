"""The report's section on the realistic machine: what it has, what was believed of it, what the correction left."""

from fdhil.cli.demo.realistic import AxisVerdict, Realistic
from fdhil.cli.demo.report import CUT_HEAD, PARAMETER_HEAD, cut_rows_of, identified_rows, rms
from fdhil.config import Reality
from fdhil.report import Section, Table, figures

SHAPES = ("_phase", "_speed")  # end the names of what belongs to another term
VERDICT_HEAD = ("axis", "rapids believed", "model", "why others were not")


def section(realistic: Realistic) -> Section:
    """Lay it out; a refusal is shown as such."""
    errors = {cut.label: cut.contour_um for cut in realistic.cuts}
    period_s = realistic.config.machine.sync_period_s
    text = (
        "The same loop on the same machine with what ordinary real ones have besides the equations of the paper. "
        "The errors are those of the true table. Its motors' encoders do not see how the screws give: that resonance "
        "is told to fdhil, the rest it found out from four rapids of each axis. The current sensors are 1 % off, and "
        "so are R, L, Jt, ft and Cd, which are told in their amperes."
    )
    if realistic.refused:
        text += f" It was not corrected: {realistic.refused}."
    return Section(
        "A realistic machine",
        text,
        tables=[
            Table(("what it has", *realistic.config.axis), effect_rows(realistic)),
            Table(VERDICT_HEAD, verdict_rows(realistic), "What was believed"),
            Table(PARAMETER_HEAD, parameter_rows(realistic), "Identified"),
            Table(CUT_HEAD, cut_rows(realistic), "Contour error, 10 m/min, at the true table"),
        ],
        figures=[("Contour error along the path, realistic machine", figures.contour_errors(period_s, errors))],
    )


def headline(realistic: Realistic) -> tuple[str, str]:
    """Return the one line of it for the top of the page."""
    if realistic.refused:
        return "on a realistic machine", "refused"
    return "on a realistic machine smaller by", f"{realistic.cuts[0].rms_um / realistic.cuts[-1].rms_um:.1f} x"


def effect_rows(realistic: Realistic) -> list[list[str]]:
    """Return every key that is set on some axis, and its value on each."""
    config = realistic.config
    levels = [config.sim.axis[axis].reality.model_dump(exclude_defaults=True) for axis in config.axis]
    return [[key, *(str(level.get(key, "")) for level in levels)]
            for key in Reality.model_fields if any(key in level for level in levels)]  # fmt: skip


def verdict_rows(realistic: Realistic) -> list[list[str]]:
    """Return one row per axis: rapids believed, whether a model was published, why the other rapids were not."""
    return [[axis, f"{told.believed} of {told.rapids}", _model(told),
             ", ".join(f"{count} x {code}" for code, count in told.reasons.items())]
            for axis, told in realistic.verdicts.items()]  # fmt: skip


def _model(told: AxisVerdict) -> str:
    if told.published is None:
        return "none published"
    terms = ", ".join(name for name, _ in told.published.parameters.terms if not name.endswith(SHAPES))
    return f"the six and {terms}" if terms else "the six"


def parameter_rows(realistic: Realistic) -> list[list[str]]:
    """Return the true and the identified parameters of the axes that have a model."""
    return [row for axis, told in realistic.verdicts.items() if told.published is not None
            for row in identified_rows(axis, realistic.truth[axis], told.published)]  # fmt: skip


def cut_rows(realistic: Realistic) -> list[list[str]]:
    """Return the contour errors, predicted where there was a model to predict with, and measured."""
    rows = []
    if realistic.predicted is not None:
        contour = realistic.predicted.contour_um
        rows.append(["predicted", "", f"{rms(contour):.2f}", f"{contour.max():.1f}", ""])
    return rows + cut_rows_of(realistic.cuts)
