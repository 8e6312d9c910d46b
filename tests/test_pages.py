"""The generated pages under docs/: each matches its figures, and other figures change its conclusions."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as benchmarks
from studies.__main__ import STUDIES
from studies.pages import FOLDER, convert_to_json, describe_provenance, render_page

ROOT = Path(__file__).parents[1]
Figures = dict[str, Any]


def load_document(study: str) -> Figures:
    reported: Figures = json.loads((FOLDER / f"{study}.json").read_text("utf-8"))
    return reported


def extract_prose(page: str) -> str:
    """Return a page's text without its tables, in one line."""
    return " ".join(line for line in page.splitlines() if not line.startswith("|"))


@pytest.mark.parametrize("study", STUDIES)
def test_page_matches_figures(study: str) -> None:
    figures = load_document(study)
    page = (FOLDER / f"{study}.md").read_text("utf-8")
    assert render_page(figures) == page
    words = extract_prose(page)
    assert figures["study"] == study
    for reported in ("command", "seeds", "commit", "date"):
        assert figures["run"][reported] in words
    for library in ("Python", "numpy", "scipy", "numba"):
        assert f"{library} " in figures["run"]["versions"]
    assert "local changes" not in figures["run"]["commit"]


@pytest.mark.parametrize("name", benchmarks.BENCHMARKS)
def test_benchmark_finds_its_subject(name: str) -> None:
    assert import_module(f"benchmarks.{name}").__doc__


def test_benchmarks_page_matches_figures() -> None:
    figures = json.loads(benchmarks.FIGURES.read_text("utf-8"))
    assert list(figures) == list(benchmarks.BENCHMARKS)
    assert benchmarks.page(figures) == (ROOT / "docs" / "benchmarks.md").read_text("utf-8")


def _remove_least_squares_bias(figures: Figures) -> None:
    """Figures in which raw least squares is right and the product's other choices are not."""
    names = figures["methods"]
    for case in figures["cases"]:
        for k in range(len(figures["filters"])):
            first, second = names.index("zero_forcing_1"), names.index("central")
            case["rms"][k][first] = [2 * error for error in case["rms"][k][second]]
            case["bias"][k][first] = [0.0] * 6
        case["rejected"] = [[[1.0] * 6] * len(names)] * len(figures["filters"])


def _let_moments_win(figures: Figures) -> None:
    for part in figures["noises"]:
        part["methods"]["partial moments"]["rms"] = [1e-9] * 6


def _blind_history(figures: Figures) -> None:
    figures["steps"] = [[[], 0, False] for _ in figures["steps"]]
    figures["due"] = [[False, False, None] for _ in figures["due"]]


def _accept_some(figures: Figures) -> None:
    (first, *_) = figures.values()
    for fault in first.values():
        fault |= {"accepted": 0, "harmful": 0, "silent": 0, "wrong": []}
    first["backlash"] |= {"accepted": 3, "silent": 3, "right": 0, "wrong": [24, 54, 84]}


def _falsify_intervals(figures: Figures) -> None:
    figures["intervals"][0]["share"][3] = 0.02
    figures["verdicts"]["good"] |= {"refused": 77}


@pytest.mark.parametrize(
    ("study", "other", "gone", "told"),
    [
        (
            "comparison",
            _remove_least_squares_bias,
            "",
            ("with 40 Hz in none of 9 cases (otherwise central in 9)", "With 150 Hz: unbiased", "100 / 100 with 40 Hz"),
        ),
        ("estimators", _let_moments_win, "Smallest error: maximum likelihood", ("partial moments of R, L, K,",)),
        (
            "drift",
            _blind_history,
            "95 % interval holds",
            ("nothing: 100 of 100", "not within 5: 100", "in 0 of 100", "told in 0 of 60 histories."),
        ),
        (
            "verdicts",
            _accept_some,
            "backlash (100%)",
            (" 3 accepted, 3 of them without a warning, 0 to harm (", "backlash (0%)", "backlash 24, 54, 84"),
        ),
        ("slow_sensor", _falsify_intervals, "", ("that of Jt holds the truth least often: 2 %", " 77 windows refused")),
    ],
)
def test_conclusions_follow_figures(
    study: str, other: Callable[[Figures], None], gone: str, told: tuple[str, ...]
) -> None:
    figures = load_document(study)
    before = extract_prose(render_page(figures))
    other(changed := copy.deepcopy(figures["figures"]))
    after = extract_prose(render_page({**figures, "figures": changed}))
    for words in told:
        assert words not in before
        assert words in after
    assert not gone or gone not in after


def test_every_study_page_has_figures_file() -> None:
    pages = {path.stem for path in FOLDER.glob("*.md")}
    assert pages >= set(STUDIES)
    assert pages == {path.stem for path in FOLDER.glob("*.json")}


@pytest.mark.usefixtures("processes")
def test_figures_round_trip_through_file() -> None:
    assert convert_to_json({"a": (float("nan"), 1.23456789), "n": 3, "s": "R"}) == {
        "a": [None, 1.23457],
        "n": 3,
        "s": "R",
    }
    assert describe_provenance("python -m studies.x")["versions"].startswith("Python 3.")
