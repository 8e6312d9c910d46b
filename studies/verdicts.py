"""Counts how often a good rapid is refused, and whether any bad one is accepted (``python -m studies.verdicts``).

Every recording is simulated again with its own seed: drive, move, noise, resolution and sampling are drawn; each bad
one gets one fault of random severity. The table goes to ``docs/studies/verdicts.md``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from studies import faults, pages
from studies.judging import GOOD, Judged, Tally, assess_recording, assess_seeds, count_by_kind, describe_results
from studies.scenes import draw_scene


def assess_good_recording(seed: int, study: int = 1) -> Judged:
    """Assess one valid recording."""
    draws = [study, 1, seed]
    return assess_recording(
        GOOD,
        seed,
        faults.make_good_recording(_make_rng(draws)),
        draw_scene(_make_rng(draws)),
        configured=bool(seed % 2),
    )


def assess_bad_recording(seed: int, study: int = 1) -> Judged:
    """Assess one recording with the kind of fault that ``seed`` chooses."""
    names = list(faults.KINDS)
    name = names[seed % len(names)]
    draws = [study, 2, seed]
    # the machine is the first that is drawn; half of them come with their configuration
    scene, configured = draw_scene(_make_rng(draws)), bool(seed // len(names) % 2)
    return assess_recording(name, seed, faults.KINDS[name].make(_make_rng(draws)), scene, configured=configured)


def _make_rng(draws: Sequence[int]) -> np.random.Generator:
    return np.random.default_rng(draws)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return for each study the results of its recordings, by kind."""
    path = options.out / "verdicts.json"
    found: dict[str, Any] = json.loads(path.read_text("utf-8"))["figures"] if options.add and path.is_file() else {}
    for study in options.study:
        results = list(
            assess_seeds(range(options.good), partial(assess_good_recording, study=study), options.processes)
        )
        results += assess_seeds(range(options.bad), partial(assess_bad_recording, study=study), options.processes)
        found[str(study)] = {name: vars(entry) for name, entry in count_by_kind(results, faults.KINDS).items()}
    return dict(sorted(found.items()))


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    lines = pages.write_head("Good windows refused, bad windows accepted", "verdicts", run)
    lines += pages.wrap_paragraph(
        """Every recording is simulated again: drives from 15 to 250 V and 3 to 150 A, windings of 3 to 20 ms, inertia
        and friction to match, pitch 5 to 40 mm, rapids of 9 to 60 m/min at 1.5 to 8 m/s2 with 5 to 60 ms smoothing,
        rows 0.25 to 2 ms apart, voltage as means or instants, noise 0.1 to 0.5 %, sensors in steps of 0.001 to 0.2 % of
        their peak, positions in 0.1 to 5 um. Each bad recording has one fault of random severity, whose smallest is
        listed. "Named rightly" means that one of the reasons or warnings given is the class of that fault. A bad
        recording is judged wrongly that does harm (a parameter beyond its interval, or a path beyond its tolerance): a
        fault that is too small for that may be told as a warning, and the model kept. One that is accepted without a
        warning is listed, too."""
    )
    for study, counted in figures.items():
        lines += [
            f"## Study {study}",
            "",
            *describe_results({k: Tally.parse(v) for k, v in counted.items()}, faults.KINDS),
        ]
    return "\n".join(lines)


def _list_seeds(options: argparse.Namespace) -> str:
    studies = pages.join_words([str(study) for study in options.study])
    return f"study {studies}, good recordings 0 to {options.good - 1}, bad ones 0 to {options.bad - 1}"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--good", type=int, default=1500, help="recordings; each holds one or two windows")
    parser.add_argument("--bad", type=int, default=3000)
    parser.add_argument("--study", type=int, nargs="+", default=[1], help="seeds of whole studies")
    parser.add_argument("--add", action="store_true", help="to the studies that the figures have")
    pages.run_study("verdicts", parser, _list_seeds, measure)


if __name__ == "__main__":
    main()
