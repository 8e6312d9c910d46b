"""Draws an identification: measured and modelled signals, residuals' whiteness, parameters and their correlation."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from fdhil.identification import predict_next_moves
from fdhil.records import INTERVAL_95, PARAMETERS, Estimate, Float, Verdict, WindowOutcome, get_unit
from fdhil.report.chart import Chart, Panel, Trace, decimate_curve, render_svg
from fdhil.report.parameter_format import INTERVAL_MEANING, PARAMETER_MEANINGS, format_cell, format_heading
from fdhil.report.report_page import Page, Section, Table
from fdhil.report.svg_drawing import COLOURS, INK, REFERENCE
from fdhil.validation import simulate_from_voltage

MOST_WINDOWS = 6
LAGS = 40
INCHES = 6.4, 6.8


class IdentificationResult(Protocol):
    """The result of one recording, or of several together."""

    @property
    def file(self) -> str: ...
    @property
    def axis(self) -> str | None: ...
    @property
    def outcomes(self) -> Sequence[WindowOutcome]: ...
    @property
    def pooled(self) -> Estimate | None: ...
    @property
    def verdict(self) -> Verdict: ...


def build_identification_page(found: IdentificationResult) -> Page:
    """Return the page of an identification."""
    verdict = found.verdict
    headline = [("validated", "yes" if verdict.accepted else "no"), ("windows", str(len(found.outcomes)))]
    if verdict.fit_percent is not None:
        headline.append(("fit", f"{verdict.fit_percent:.2f} %"))
    sections = [_build_parameter_section(found)]
    sections += [_build_window_section(outcome) for outcome in found.outcomes[:MOST_WINDOWS]]
    sections += [*_build_correlation_section(found.pooled), *_suggest_next_move(found)]
    return Page(f"Identification of axis {found.axis or '-'}", found.file, headline, sections)


def save_picture(found: IdentificationResult, path: Path) -> None:
    """Save a picture of the first window in the format of the file's suffix."""
    from fdhil.store import open_output

    figure = draw_identification(found)
    with open_output(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower(), dpi=150)


def draw_identification(found: IdentificationResult, number: int = 0) -> Any:
    """Return a matplotlib figure of one window: measured and modelled signals, the residual, and its whiteness."""
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(Path(__file__).with_name("fdhil.mplstyle")):
        figure = Figure(figsize=INCHES, layout="constrained")
        if not found.outcomes:
            figure.text(0.5, 0.5, "no move was found", ha="center")
            return figure
        charts = [_build_signal_chart(found.outcomes[number]), *_build_whiteness_charts(found.outcomes[number])]
        panels = [(panel, chart.x_label) for chart in charts for panel in chart.panels]
        shares = [panel.share for panel, _ in panels]
        every = figure.subplots(len(panels), 1, height_ratios=shares, squeeze=False)[:, 0]
        for axes, (panel, x_label) in zip(every, panels, strict=True):
            for trace in panel.traces:
                x, y = decimate_curve(trace.x, trace.y)
                wide = 2.6 if trace.style == "wide" else 1.0
                axes.plot(x, y, color=trace.colour, linewidth=wide, label=trace.label)
            for _, level in panel.levels:
                axes.axhline(level, color=REFERENCE, linewidth=0.8)
            axes.set(xlabel=x_label, ylabel=panel.y_label)
            axes.legend(loc="upper right", fontsize="small")
    return figure


def _build_parameter_section(found: IdentificationResult) -> Section:
    terms = found.pooled.terms if found.pooled is not None else ()
    rows = [_build_parameter_row(name, found.pooled, found.verdict) for name in (*PARAMETERS, *terms)]
    reasons = [[str(r), r.advice] for r in dict.fromkeys((*found.verdict.reasons, *found.verdict.warnings))]
    tables = [Table(("parameter", "value", "unit", "what it is"), rows, INTERVAL_MEANING)]
    tables += [Table(("finding", "what to do"), reasons)] if reasons else []
    return Section("Parameters", tables=tables)


def _build_parameter_row(name: str, estimate: Estimate | None, verdict: Verdict) -> tuple[str, str, str, str]:
    if estimate is None or not math.isfinite(estimate.get_value(name)):
        reason = estimate.missing.get(name) if estimate is not None else None
        reason = reason or next(iter(verdict.reasons), None)
        return name, "-", "", str(reason) if reason is not None else "not determined"
    if name in estimate.given:
        return name, f"{estimate.get_value(name):.4g}", get_unit(name) or "", "given, not estimated"
    shown = format_cell(name, estimate.get_value(name), INTERVAL_95 * estimate.get_std(name), " ")
    unit = format_heading(name).split("\n")[1] if name in PARAMETERS else get_unit(name) or ""
    return name, shown, unit, PARAMETER_MEANINGS.get(name, "additional term")


def _build_window_section(outcome: WindowOutcome) -> Section:
    window, verdict = outcome.window, outcome.verdict
    title = f"From {window.start_s:.2f} s"
    figures = [
        (
            "Measured signals, and the model's response to the measured voltage",
            render_svg(_build_signal_chart(outcome), 6.4, 5.6),
        )
    ]
    figures += [
        ("Correlation of the residuals; white residuals stay between the lines", render_svg(c, 6.4, 2.4))
        for c in _build_whiteness_charts(outcome)
    ]
    text = "Validated." if verdict.accepted else "; ".join(map(str, verdict.reasons))
    return Section(title, text, figures=figures, wide=True)


def _build_signal_chart(outcome: WindowOutcome) -> Chart:
    window = outcome.window
    time_s = np.arange(window.n, dtype=np.float64) * window.dt_s
    model = None if outcome.estimate is None else simulate_from_voltage(window, outcome.estimate, None)
    panels = []
    if window.voltage_v is not None:
        panels.append(Panel("voltage (V)", [Trace("measured voltage", time_s, window.voltage_v, COLOURS[1])], 0.7))
    measured = {"current (A)": window.current_a, "speed (rad/s)": window.speed_rad_s}
    answers = {} if model is None else {"current (A)": model.current_a, "speed (rad/s)": model.speed_rad_s}
    for label, values in measured.items():
        traces = [Trace("measured", time_s, values, REFERENCE, "wide")]
        if model is not None:
            traces.append(Trace("model", model.time_s, answers[label], COLOURS[0]))
        panels.append(Panel(label, traces))
    if model is not None:
        left = model.measured_rad_s - model.speed_rad_s
        panels.append(Panel("residual (rad/s)", [Trace("measured - model", model.time_s, left, INK)], 0.6))
    fit = "" if outcome.verdict.fit_percent is None else f", fit {outcome.verdict.fit_percent:.2f} %"
    return Chart("time (s)", panels, f"Axis {window.axis}: signals of {time_s[-1]:.2f} s with the model's{fit}.")


def _build_whiteness_charts(outcome: WindowOutcome) -> Iterator[Chart]:
    residuals = {} if outcome.estimate is None else outcome.estimate.residuals
    traces, rows = [], 0
    for colour, (equation, values) in zip(COLOURS, residuals.items(), strict=False):
        known = values[np.isfinite(values)]
        if known.size > 4 * LAGS and float(np.var(known)) > 0.0:
            traces.append(
                Trace(f"{equation} equation", np.arange(1.0, LAGS + 1), compute_autocorrelation(known), colour)
            )
            rows = known.size
    if traces:
        limit = INTERVAL_95 / math.sqrt(rows)
        levels = [("", limit), ("", -limit)]
        panel = Panel("correlation", traces, 0.8, levels=levels)
        yield Chart("lag (samples)", [panel], f"Correlation of the residuals over {LAGS} lags.")


def compute_autocorrelation(values: Float) -> Float:
    """Return the autocorrelation (LAGS,) of residuals (m,) at lags of 1 and more."""
    centred = values - values.mean()
    power = float(centred @ centred)
    return np.array([float(centred[lag:] @ centred[:-lag]) / power for lag in range(1, LAGS + 1)])


def _build_correlation_section(estimate: Estimate | None) -> Iterator[Section]:
    if estimate is None:
        return
    names = [n for n in estimate.names if math.isfinite(estimate.get_std(n)) and estimate.get_std(n) > 0.0]
    if len(names) < 2:
        return
    kept = [estimate.names.index(name) for name in names]
    part = estimate.covariance[np.ix_(kept, kept)]
    deviations = np.sqrt(np.diag(part))
    shares = part / np.outer(deviations, deviations)
    rows = [(name, *(f"{value:+.2f}" for value in row)) for name, row in zip(names, shares, strict=True)]
    text = "Two parameters with a correlation near 1 or -1 can only be separated by another kind of move."
    yield Section("Correlation of the estimates", text, [Table(("", *names), rows)])


def _suggest_next_move(found: IdentificationResult) -> Iterator[Section]:
    estimate = found.pooled
    window = max((outcome.window for outcome in found.outcomes), key=lambda window: window.n, default=None)
    if estimate is None or window is None or estimate.missing or estimate.given:
        return
    p = estimate.build_parameters()
    if min(p.R, p.L, p.K, p.Jt) <= 0.0:
        return
    widest = max(PARAMETERS, key=lambda name: estimate.get_std(name) / max(abs(estimate.get_value(name)), 1e-300))
    moves = predict_next_moves(window, estimate)
    rows = [(move.name, *(f"{move.shares[name]:.2f}" for name in PARAMETERS)) for move in moves]
    best = min(moves, key=lambda move: move.shares[widest], default=None)
    if best is None:
        return
    left = f"reduces it to {best.shares[widest]:.0%} at best"
    text = (
        f"{widest} has the widest relative interval. One more recording of this length, {best.name}, {left}. What "
        "the model itself leaves open remains. The table lists the smallest share of each interval that remains."
    )
    yield Section("Most informative further recording", text, [Table(("further move", *PARAMETERS), rows)])
