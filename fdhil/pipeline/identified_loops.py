"""Identifies a drive's own loops if the configured ones do not explain its rapids, and analyses these again.

If other loops do not explain them, a resonance between motor and table may: the motor's position is measured far better
than its speed, and the closed loop along the demand shows the table's reaction on the motor in it, so that the
resonance with the smallest residual of the replays is used.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification import (
    apply_loops,
    bound_estimate,
    correct_current_to_means,
    find_changed_regulators,
    identify_loops,
    is_better_than_configured,
)
from fdhil.pipeline.window_analysis import analyse_window, select_matching_axis
from fdhil.records import LoopEstimate, Parameters, Window, WindowOutcome
from fdhil.validation import LOOPS_DIFFER, replay_with_load_search

GRID = np.geomspace(40.0, 250.0, 14)  # Hz
HALVINGS = 2  # of the grid's steps around the best
NOTICED = 0.01  # of the following error: below, nothing is searched for
BETTER = 0.5  # of the residual, at most, with an accepted resonance
MOST_RAPIDS = 4

Rapids = Sequence[tuple[Window, Parameters]]
ENOUGH = 4  # windows, both directions twice
KEPT = 6
SIGNALS_AT_FAULT = frozenset({"StuckValue", "Implausible", "NotFinite", "StaleData", "EpisodeAborted"})
# of a motor with unknown data sheet: fast enough not to affect the loops
UNKNOWN_R, UNKNOWN_L = 1.0, 5e-3
Work = Callable[[Window], WindowOutcome]
Spread = Callable[[Work, Sequence[Window]], Iterable[WindowOutcome]]


def find_resonance(rapids: Rapids, axis: Axis, sync_period_s: float) -> Axis | None:
    """Return the axis with the resonance that the rapids show.

    None if one is configured already, if the rapids are explained, and if none explains them.
    """
    rapids = [pair for pair in rapids if not pair[1].get_term("resonance")][-MOST_RAPIDS:]
    if axis.resonance_hz is not None or not rapids:
        return None
    left, following = _compute_residual_um(rapids, axis, sync_period_s)
    if not left > NOTICED * following:
        return None
    found = _search_frequency(rapids[-1:], axis, sync_period_s)
    soft = _set_resonance(axis, found)
    return soft if _compute_residual_um(rapids, soft, sync_period_s)[0] < BETTER * left else None


def _search_frequency(rapids: Rapids, axis: Axis, sync_period_s: float) -> float:
    left: dict[float, float] = {}

    def evaluate(*resonances: float) -> float:
        for hertz in resonances:
            left[hertz] = _compute_residual_um(rapids, _set_resonance(axis, hertz), sync_period_s)[0]
        return min(left, key=left.__getitem__)

    best, ratio = evaluate(*GRID.tolist()), float(GRID[1] / GRID[0])
    for _ in range(HALVINGS):
        ratio **= 0.5
        best = evaluate(best / ratio, best * ratio)
    return best


def _set_resonance(axis: Axis, hertz: float) -> Axis:
    return axis.model_copy(update={"resonance_hz": hertz})


def _compute_residual_um(rapids: Rapids, axis: Axis, sync_period_s: float) -> tuple[float, float]:
    """Return the RMS residual of the rapids' replays, and of the following error; zero without any."""
    replays = [replay_with_load_search(window, drive, axis, sync_period_s) for window, drive in rapids]
    residuals = [(one.unexplained_um, one.measured_um) for one in replays if one is not None]
    left, following = np.sqrt(np.mean(np.square(residuals), axis=0)) if residuals else (0.0, 0.0)
    return float(left), float(following)


def identify_from_outcomes(
    outcomes: Sequence[WindowOutcome],
    axis: Axis | None,
    settings: Identification,
    sync_period_s: float | None = None,
    *,
    growing: bool = True,
) -> LoopEstimate | None:
    """Return the loops of a drive by its analysed windows; None where they show none.

    Without ``growing`` no keys are tried but the configured ones. Unknown values of the winding are assumed: the
    current loop hides them. Accepted windows precede the others, and a section of another machine is ignored.
    """
    axis = select_matching_axis(outcomes[0].window, axis) if outcomes else None
    pairs = [(o, complete_parameters(o, axis)) for o in outcomes]
    known = [(o, plant) for o, plant in pairs if plant is not None]
    accepted = [(o, plant) for o, plant in known if o.verdict.accepted]
    chosen = accepted or known
    windows, plants = [o.window for o, _ in chosen], [p for _, p in chosen]
    return identify_loops(windows, plants, axis, settings, sync_period_s, growing=growing)


def complete_parameters(outcome: WindowOutcome, axis: Axis | None) -> Parameters | None:
    """Return the parameters of a window's estimate, its winding completed; None without K, Jt, ft or Cd."""
    if outcome.estimate is None:
        return None
    found = bound_estimate(outcome.estimate, outcome.window.direction).build_parameters()
    values = found.as_dict()
    winding = {"R": UNKNOWN_R, "L": UNKNOWN_L} if axis is None else {"R": axis.nominal.R, "L": axis.nominal.L}
    filled = {name: winding.get(name, value) if value != value else value for name, value in values.items()}
    if any(value != value for value in filled.values()) or filled["Jt"] <= 0.0 or filled["K"] <= 0.0:
        return None
    return found.replace_values(**filled)


def has_loop_mismatch(outcomes: Sequence[WindowOutcome]) -> bool:
    """Return whether some window is refused for its loops: the model explains its torque, and not its replay.

    A window with faulty signals says nothing of the loops.
    """
    codes = ({reason.code for reason in o.verdict.reasons} for o in outcomes)
    return any(LOOPS_DIFFER in found and not found & SIGNALS_AT_FAULT for found in codes)


def adopt_loops(axis: Axis | None, found: LoopEstimate | None) -> Axis | None:
    """Return the axis with the loops that were found, if they explain what the configured ones do not; else None."""
    return (
        apply_loops(axis, found)
        if axis is not None and found is not None and is_better_than_configured(found)
        else None
    )


def search_resonance(
    outcomes: Collection[WindowOutcome], axis: Axis | None, sync_period_s: float | None
) -> Axis | None:
    """Return the axis with the resonance that explains outcomes that its loops do not, or all; else None."""
    left = [o for o in outcomes if has_loop_mismatch([o])] or [o for o in outcomes if o.verdict.accepted]
    if axis is None or sync_period_s is None or not left or select_matching_axis(left[0].window, axis) is None:
        return None
    pairs = [(o.window, complete_parameters(o, axis)) for o in left]
    return find_resonance([(w, plant) for w, plant in pairs if plant is not None], axis, sync_period_s)


def reanalyse_with_loops(
    outcomes: Sequence[WindowOutcome],
    axis: Axis | None,
    settings: Identification,
    sync_period_s: float | None,
    again: Callable[[Axis], Sequence[WindowOutcome]],
) -> tuple[Sequence[WindowOutcome], LoopEstimate | None]:
    """Return the outcomes by the best model of a recording's drive, and its loops if they were identified.

    ``again`` analyses its windows with another section of the axis.
    """
    softer = search_resonance(outcomes, axis, sync_period_s)
    if softer is not None:
        soft = again(softer)
        if not has_loop_mismatch(soft):
            return soft, None
    loops = identify_from_outcomes(outcomes, axis, settings, sync_period_s) if has_loop_mismatch(outcomes) else None
    better = adopt_loops(axis, loops)
    if better is None:
        return outcomes, loops
    outcomes = again(better)
    softer = search_resonance(outcomes, better, sync_period_s)
    return (outcomes if softer is None else again(softer)), loops


class LoopTracker:
    """Tracks an axis' own loops as its rapids arrive one by one: each is analysed through the best known ones.

    They are fitted once after the first ``ENOUGH`` rapids, to be reported, and again when a replayed rapid is refused:
    at once, and each time after twice as many refused rapids as before, since it takes long.
    """

    def __init__(
        self, axis: Axis | None, settings: Identification, sync_period_s: float, known: LoopEstimate | None = None
    ) -> None:
        """Start with the machine's section, None for an unknown machine: then no loops are searched for.

        ``known`` are those that were found in an earlier run.
        """
        self._configured = axis
        self._settings = settings
        self._period_s = sync_period_s
        self._outcomes: deque[WindowOutcome] = deque(maxlen=KEPT)
        self._seen = self._refused = 0
        self._due = 1
        self.axis = adopt_loops(axis, known) or axis

    @property
    def changed_regulators(self) -> dict[str, float | str] | None:
        """The keys of the regulators by which the best known loops differ from the configured ones."""
        if self._configured is None or self.axis is None:
            return None
        return find_changed_regulators(self._configured, self.axis)

    def analyse_rapid(self, window: Window) -> tuple[WindowOutcome, LoopEstimate | None]:
        """Return a window's outcome, and the loops if they were identified again."""
        if self._configured is not None:
            known = select_matching_axis(window, self._configured)
            (window,) = correct_current_to_means([window], self._settings, known, self._period_s)
        outcome = analyse_window(window, self._settings, self.axis, self._period_s)
        if self._configured is None:
            return outcome, None
        self._outcomes.append(outcome)
        self._seen += 1
        self._refused += has_loop_mismatch([outcome])
        wanted = self._refused >= self._due
        if wanted:
            self._refused, self._due = 0, 2 * self._due
        elif self._seen != ENOUGH:
            return outcome, None
        softer = search_resonance(self._outcomes, self.axis, self._period_s)
        if softer is not None:
            soft = analyse_window(window, self._settings, softer, self._period_s)
            if not has_loop_mismatch([soft]):
                self.axis, outcome, wanted = softer, soft, False
        if has_loop_mismatch([outcome]) or self._seen == ENOUGH:
            return self._reanalyse_with_loops(window, outcome, growing=wanted)
        return outcome, None

    def _reanalyse_with_loops(
        self, window: Window, outcome: WindowOutcome, *, growing: bool
    ) -> tuple[WindowOutcome, LoopEstimate | None]:
        found = identify_from_outcomes(
            tuple(self._outcomes), self._configured, self._settings, self._period_s, growing=growing
        )
        better = adopt_loops(self._configured, found)
        if better is None and found is not None and found.verdict.accepted:
            better = self._configured  # which explain the rapids as well
        if better is None or self.axis is None:
            return outcome, found
        self.axis = better.model_copy(update={"resonance_hz": self.axis.resonance_hz})
        return (analyse_window(window, self._settings, self.axis, self._period_s) if growing else outcome), found


def analyse_windows(
    windows: Sequence[Window],
    settings: Identification,
    axis: Axis | None = None,
    sync_period_s: float | None = None,
    spread: Spread = map,
    done: Callable[[], None] = lambda: None,
) -> tuple[Sequence[WindowOutcome], LoopEstimate | None]:
    """Return the outcome of each window, and the drive's own loops if they had to be identified.

    ``spread`` may use further processes, in order; ``done`` is called after each window.
    """
    if windows:
        windows = correct_current_to_means(windows, settings, select_matching_axis(windows[0], axis), sync_period_s)
    work = partial(analyse_window, settings=settings, axis=axis, sync_period_s=sync_period_s)

    def iterate_outcomes() -> Iterator[WindowOutcome]:
        for outcome in spread(work, windows):
            done()
            yield outcome

    def reanalyse(better: Axis) -> Sequence[WindowOutcome]:
        return list(spread(partial(work, axis=better), windows))

    return reanalyse_with_loops(list(iterate_outcomes()), axis, settings, sync_period_s, reanalyse)
