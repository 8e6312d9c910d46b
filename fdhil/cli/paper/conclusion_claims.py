"""Claims of the conclusion: open questions, computing time, and all effects on one machine."""

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from fdhil.cli.paper import path_predictions
from fdhil.cli.paper.claims import Claim, Trial, make_claim
from fdhil.cli.paper.scenarios import DEMANDED, load_machine
from fdhil.correction import compute_feedforward_offsets
from fdhil.prediction import build_nominal_models, predict_path
from fdhil.records import Prediction
from fdhil.report import Table

SEEN = ("figure-11", "figure-11-size", "figure-12", "figure-13", "figure-14", "figure-15", "figure-17",
        "figure-17-worse", "figure-18", "claim-d", "claim-f", "figure-20", "figure-20-oscillation")  # fmt: skip
"""Claims about the path."""


def evaluate_claims(others: Sequence[Claim]) -> list[Claim]:
    """Evaluate the claims of the conclusion; the last one counts those of ``others`` about the path."""
    return [_evaluate_flatness(), _evaluate_stop(), _evaluate_online(), _evaluate_single_machine(others)]


def _evaluate_flatness() -> Claim:
    trials = []
    for name in DEMANDED:
        mirror, flat = (
            path_predictions.compute_rms_um(name, path_predictions.predict_paper_correction(name, method))
            for method in ("mirror", "flatness")
        )
        trials.append(Trial(name, "RMS error of the mirror over that of flatness", mirror / flat, "x", least=2.0))
    return make_claim("conclusion-flat", trials)


def _evaluate_stop() -> Claim:
    trials = []
    for name in DEMANDED:
        reference, config = path_predictions.load_reference(name), load_machine(name)
        models = build_nominal_models(config)
        seconds = min(_measure_seconds(partial(predict_path, reference, models, config)) for _ in range(3))
        share = 100.0 * seconds / float(reference.time_s[-1])
        trials.append(Trial(name, "time to predict, of the time to cut", share, "%", least=100.0))
    return make_claim("conclusion-stop", trials)


def _measure_seconds(work: Callable[[], Prediction]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _evaluate_online() -> Claim:
    trials = []
    for name in DEMANDED:
        config, reference = load_machine(name), path_predictions.load_reference(name)
        model, axis = build_nominal_models(config)["X"], config.axis["X"]
        known = np.asarray(reference.position_mm["X"])
        middle = known.size // 2
        whole, part = (compute_feedforward_offsets(p, model, axis, reference.dt_s) for p in (known, known[:middle]))
        same = [np.flatnonzero(a[:middle] != b) for a, b in zip(whole, part, strict=True)]
        first = min((int(rows[0]) for rows in same if rows.size), default=middle)
        seconds = (middle - first) * reference.dt_s
        trials.append(Trial(name, "look-ahead of the feed-forward", 1e3 * seconds, "ms", most=100.0))
    return make_claim("conclusion-on-line", trials)


def _evaluate_single_machine(found: Sequence[Claim]) -> Claim:
    saw = [claim for claim in found if claim.key in SEEN]
    assert len(saw) == len(SEEN)
    trials = [
        Trial(name, "shown of what the paper saw", float(sum(claim.is_shown_by(name) for claim in saw)),
              f"of {len(saw)}", least=float(len(saw)))
        for name in DEMANDED
    ]  # fmt: skip
    rows = [
        [
            name,
            *("yes" if claim.is_shown_by(name) else "no" for claim in saw),
            str(sum(c.is_shown_by(name) for c in saw)),
        ]
        for name in DEMANDED
    ]
    return make_claim("all-at-once", trials, tables=[Table(("scenario", *(claim.key for claim in saw), "shown"), rows)])
