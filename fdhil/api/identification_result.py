"""Identifies drives from recordings, and presents the results."""

import html
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fdhil import config
from fdhil.api.compilation_notice import announce_compilation
from fdhil.api.drive_model import Model
from fdhil.api.identification_json import build_identification_document
from fdhil.api.loop_comparison import identify_all_loops
from fdhil.api.machine_interface import Machine
from fdhil.api.recording_analysis import FileResult, analyse_recordings, compare_with_data_sheet
from fdhil.api.recording_interface import Recording, read
from fdhil.errors import FdhilError, RecordingError
from fdhil.records import INTERVAL_95, PARAMETERS, Estimate, Float, LoopEstimate, Reason, get_unit


@dataclass(frozen=True)
class Parameter:
    """One identified value: ``value`` and ``std`` are None where it is undetermined, with the ``reason``.

    ``std`` is one standard deviation; ``interval`` contains the true value in 95 % of cases. A ``given`` value was not
    identified.
    """

    name: str
    value: float | None
    std: float | None
    unit: str
    reason: Reason | None = None
    given: bool = False

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval; None without a value."""
        if self.value is None or self.std is None:
            return None
        return self.value - INTERVAL_95 * self.std, self.value + INTERVAL_95 * self.std

    def __str__(self) -> str:
        """Return value, half of the interval, and unit."""
        if self.value is None or self.std is None:
            return f"{self.name}: not determined ({self.reason})"
        if self.given:
            return f"{self.name} = {self.value:.5g} {self.unit} (given)"
        return f"{self.name} = {self.value:.5g} ± {INTERVAL_95 * self.std:.2g} {self.unit}"


class Result:
    """The result of an identification: ``parameters`` R, L, K, Jt, ft, Cd and additional ``terms``.

    It is ``validated`` where the model explains the recordings; otherwise ``reasons`` say why not. ``warnings`` name
    effects that the model lacks; they only widen the intervals.
    """

    def __init__(self, found: FileResult, machine: Machine | None = None) -> None:
        self.found, self._axes = found, {} if machine is None else machine.config.axis

    @property
    def axis(self) -> str:
        """The name of the axis."""
        return self.found.axis or ""

    @cached_property
    def parameters(self) -> Mapping[str, Parameter]:
        """The six parameters by symbol."""
        return {name: self._build_parameter(name) for name in PARAMETERS}

    @cached_property
    def terms(self) -> Mapping[str, Parameter]:
        """The additional terms, by name."""
        return {} if self._estimate is None else {name: self._build_parameter(name) for name in self._estimate.terms}

    @property
    def covariance(self) -> Float | None:
        """The covariance (k, k) of ``names``, SI units, NaN where a value is undetermined; None without an estimate."""
        return None if self._estimate is None else self._estimate.covariance

    @property
    def names(self) -> tuple[str, ...]:
        """The rows of ``covariance``: the six, then the terms."""
        return PARAMETERS if self._estimate is None else self._estimate.names

    @property
    def residuals(self) -> Mapping[str, Float]:
        """The residuals (m,) of the "electrical" and the "mechanical" equation, in standard deviations."""
        return {} if self._estimate is None else self._estimate.residuals

    @property
    def loops(self) -> LoopEstimate | None:
        """The drive's own loops, where they were identified."""
        return self.found.loops

    @property
    def validated(self) -> bool:
        """Whether the model explains the recordings."""
        return self.found.verdict.accepted

    @property
    def fit_percent(self) -> float | None:
        """The share of the speed that the model explains when simulated from the voltage."""
        return self.found.verdict.fit_percent

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why the model is not validated; each has ``code``, ``text`` and ``advice``."""
        return self.found.verdict.reasons

    @property
    def warnings(self) -> tuple[Reason, ...]:
        """Effects that the model lacks."""
        return self.found.verdict.warnings

    @property
    def windows(self) -> Sequence[Any]:
        """The moves, each with its ``window``, ``estimate`` and ``verdict``."""
        return self.found.outcomes

    @property
    def model(self) -> Model:
        """The drive as a model. FdhilError where a parameter is not determined."""
        open_ends = [str(p) for p in self.parameters.values() if p.value is None]
        if open_ends or self._estimate is None:
            raise FdhilError(f"the model of axis {self.axis} is incomplete: {'; '.join(open_ends)}")
        return Model.from_mapping({name: self._estimate.get_value(name) for name in (*PARAMETERS, *self.terms)})

    def plot(self, window: int = 0) -> Any:
        """Return a ``matplotlib.figure.Figure`` of a window: measured and modelled signals, residuals, their whiteness.

        FdhilError without the extra ``report``.
        """
        from fdhil.report import require_libraries

        require_libraries()
        from fdhil.report import draw_identification

        return draw_identification(self.found, window)

    def report(self, path: str | Path) -> None:
        """Write an HTML page of the result. FdhilError without the extra ``report``, OutputError for an unwritable
        path.
        """
        from fdhil.report import build_identification_page, write_page

        write_page(build_identification_page(self.found), Path(path))

    def to_json(self) -> str:
        """Return the document of ``fdhil identify --json`` (schema fdhil-identify-1)."""
        document = build_identification_document([self.found], self._axes, with_loops=self.loops is not None)
        return json.dumps(document, allow_nan=False)

    def __repr__(self) -> str:
        """Return a line per value, and the verdict."""
        lines = [
            f"<fdhil.Result axis {self.axis}: {'validated' if self.validated else 'not validated'}{self._format_fit()}"
        ]
        lines += [f"  {value}" for value in (*self.parameters.values(), *self.terms.values())]
        return "\n".join([*lines, *(f"  {line}" for line in self._list_notes())]) + ">"

    def _repr_html_(self) -> str:
        """Return a table for a notebook."""
        rows = "".join(
            f"<tr><th>{html.escape(p.name)}</th><td>{html.escape(str(p).split(maxsplit=1)[1])}</td></tr>"
            for p in (*self.parameters.values(), *self.terms.values())
        )
        head = f"axis {self.axis}: {'validated' if self.validated else 'not validated'}{self._format_fit()}"
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in self._list_notes())
        return f"<table><caption>{html.escape(head)}</caption>{rows}</table>" + (f"<ul>{notes}</ul>" if notes else "")

    def _format_fit(self) -> str:
        return "" if self.fit_percent is None else f", fit {self.fit_percent:.2f} %"

    def _list_notes(self) -> Iterator[str]:
        for reason in dict.fromkeys((*self.reasons, *self.warnings)):
            text = f"{reason}; {reason.advice}" if reason.advice else str(reason)
            yield text if reason in self.reasons else f"warning: {text}"

    @property
    def _estimate(self) -> Estimate | None:
        return self.found.pooled

    def _build_parameter(self, name: str) -> Parameter:
        estimate, unit = self._estimate, get_unit(name) or ""
        if estimate is not None and name in estimate.given:
            return Parameter(name, estimate.get_value(name), 0.0, unit, None, given=True)
        if estimate is not None and math.isfinite(estimate.get_value(name)) and math.isfinite(estimate.get_std(name)):
            return Parameter(name, estimate.get_value(name), estimate.get_std(name), unit)
        reason = None if estimate is None else estimate.missing.get(name)
        return Parameter(name, None, None, unit, reason or next(iter(self.reasons), None))


def identify(
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    machine: Machine | str | Path | None = None,
    *,
    any_move: bool = False,
    method: str | None = None,
    loops: bool = False,
) -> Result:
    """Identify a drive from one recording or several of one axis, each a :class:`fdhil.Recording` or a file.

    By default the rapid moves of each are used. With ``any_move`` a recording is used whole, whatever its moves: steps,
    ramps, chirps, back and forth, a locked rotor (R and L). Undetermined values are None, with a reason. A ``machine``
    adds its regulators, by which the model is assessed in micrometres, and its nominal values. ``method`` is
    "least_squares", "partial_moments" or "maximum_likelihood" (the default); with ``loops`` the drive's own loops are
    identified, which requires a demand.

    Raises :class:`fdhil.errors.RecordingError` for recordings of several axes or none.

    >>> import numpy as np, fdhil
    >>> truth = fdhil.Model(R=1.0, L=0.002, K=0.2, Jt=1e-3, ft=1e-3, Cd=0.05)
    >>> voltage = np.repeat([0.0, 12.0, 24.0, -18.0, 6.0, 0.0], 250)
    >>> made = fdhil.simulate(truth, voltage, 1e-3)
    >>> noise = np.random.default_rng(1).normal(size=(3, voltage.size))
    >>> recording = fdhil.Recording(
    ...     made.time, made.voltage + 0.05 * noise[0], made.current + 0.02 * noise[1], made.speed + 0.1 * noise[2])
    >>> result = fdhil.identify(recording, any_move=True)
    >>> result.validated, result.parameters["K"].unit
    (True, 'N.m/A')
    >>> all(p.interval[0] - p.std < getattr(truth, n) < p.interval[1] + p.std for n, p in result.parameters.items())
    True
    """
    listed = [recordings] if isinstance(recordings, Recording | str | Path) else list(recordings)
    read_in = [each if isinstance(each, Recording) else read(each) for each in listed]
    if len({each.axis for each in read_in}) != 1:
        axes = ", ".join(sorted({each.axis for each in read_in})) or "none"
        raise RecordingError(f"identify takes recordings of one axis, and these are of {axes}: call it for each axis")
    known = None if machine is None else Machine.of(machine)
    announce_compilation("identify")
    settings = config.Identification() if known is None else known.config.identification
    if method is not None:
        settings = config.Identification(**{**settings.model_dump(), "method": method})
    section = None if known is None else known.config
    signals, name = [each.signals for each in read_in], ", ".join(each.name for each in read_in)
    found = analyse_recordings(signals, name, settings, section, any_move=any_move)
    if known is not None:
        found = compare_with_data_sheet(found, known.config.axis)
    if loops:
        found = identify_all_loops([found], settings, section)[0]
    return Result(found, known)
