"""``fdhil paper``: rule of the verdicts, coverage, and known figures."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.cli import paper as command
from fdhil.cli.paper import claim_drawings, claims_page, correction_claims, path_predictions, simulated_drive
from fdhil.cli.paper.claims import Claim, Trial, Verdict
from fdhil.cli.paper.scenarios import PATHS, SCENARIOS, load_machine
from fdhil.model.feed_drive import simulate_plant
from fdhil.program import load_trajectory
from tests.daemon.machine_rig import fdhil

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "configs" / "paper.toml"


def make_claim(trials: Sequence[Trial]) -> Claim:
    return Claim("figure-0", "a figure", "figure", "Figure 0", "It is so.", "1 mm", "at most 1", trials)


@pytest.fixture(scope="module")
def paper_document(tmp_path_factory: pytest.TempPathFactory, long_computation: None) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("paper")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["fdhil", "paper", "--out", str(out), "--runs", "2"])
        command.paper.main(["--out", str(out), "--runs", "2"], standalone_mode=False)
    document: dict[str, Any] = json.loads((out / "paper.json").read_text("utf-8"))
    return document, out


@given(st.lists(st.tuples(st.sampled_from("abc"), st.booleans()), min_size=1))
def test_verdict_depends_only_on_trials(rows: list[tuple[str, bool]]) -> None:
    found = make_claim([Trial(scenario, "x", 1.0 if shown else 3.0, "mm", most=2.0) for scenario, shown in rows])
    shown = {name: all(held for other, held in rows if other == name) for name, _ in rows}
    if all(shown.values()):
        assert found.verdict is Verdict.HOLDS
    elif any(shown.values()):
        assert found.verdict is Verdict.CONDITION
    else:
        assert found.verdict is Verdict.NOT
    assert bool(found.condition) == (found.verdict is Verdict.CONDITION)
    assert claims_page.count_verdicts([found])[found.verdict.value] == 1


def test_nan_value_fails_trial_and_is_null_in_json() -> None:
    lost = Trial("a", "x", math.nan, "mm", least=0.0)
    assert make_claim([lost]).verdict is Verdict.NOT
    assert make_claim([]).verdict is Verdict.NOT
    document = claims_page.build_claims_document([make_claim([lost])], 2, "0", {"figure-0": []})
    assert json.loads(json.dumps(document, allow_nan=False))["claims"][0]["trials"][0]["value"] is None


def test_document_verdicts_match_their_trials(paper_document: tuple[dict[str, Any], Path]) -> None:
    for stated in paper_document[0]["claims"]:
        assert stated["trials"], stated["key"]
        again = [
            Trial(t["scenario"], t["what"], t["value"], t["unit"],
                  -math.inf if t["least"] is None else t["least"], math.inf if t["most"] is None else t["most"])
            for t in stated["trials"]
        ]  # fmt: skip
        assert [trial.holds for trial in again] == [t["holds"] for t in stated["trials"]]
        assert make_claim(again).verdict.value == stated["verdict"], stated["key"]
        assert {trial.scenario for trial in again} <= set(paper_document[0]["scenarios"])
        assert stated["says"]
        assert stated["rule"]
        assert stated["paper"]
    assert sum(paper_document[0]["counts"].values()) == len(paper_document[0]["claims"])


def test_every_equation_and_figure_has_a_claim(paper_document: tuple[dict[str, Any], Path]) -> None:
    sources = " ".join(stated["source"] for stated in paper_document[0]["claims"])
    assert [k for k in range(1, 12) if f"[{k}]" not in sources and k != 7] == []
    assert [
        k for k in (1, 2, *range(4, 21)) if f"Figure {k}," not in f"{sources}," and f"Figure {k} " not in sources
    ] == []
    keys = [stated["key"] for stated in paper_document[0]["claims"]]
    assert len(keys) == len(set(keys)) >= 40
    assert {
        scenario for stated in paper_document[0]["claims"] for scenario in (t["scenario"] for t in stated["trials"])
    } == set(SCENARIOS)


def test_every_data_figure_is_drawn(paper_document: tuple[dict[str, Any], Path]) -> None:
    document, out = paper_document
    drawn = {stated["key"]: stated["pictures"] for stated in document["claims"]}
    assert [k for k in range(4, 21) if not drawn[f"figure-{k}"]] == []
    html = (out / "paper.html").read_text("utf-8")
    for pictures in drawn.values():
        for picture in pictures:
            tree = ElementTree.parse(out / picture["file"])
            assert tree.getroot().tag.endswith("svg")
            assert picture["caption"].endswith(".")
    assert html.count("<svg") == sum(map(len, drawn.values()))
    assert "http://" not in html.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    )


def test_shipped_config_equals_used_machine() -> None:
    packaged = ROOT / "fdhil" / "cli" / "paper" / "paper.toml"
    assert SHIPPED.read_text("utf-8") == packaged.read_text("utf-8")
    cold, warm = (
        simulated_drive.compute_parameters(),
        simulated_drive.compute_parameters(celsius=simulated_drive.WARM_C),
    )
    assert (cold.ft, cold.Cd) == pytest.approx((1.2e-3, 2.4), rel=1e-4)
    assert (warm.ft, warm.Cd) == pytest.approx((0.8e-3, 1.9), rel=1e-4)
    axis = load_machine().axis["X"]
    assert axis.rapid_speed_rad_s == pytest.approx(60.0, abs=1e-4)
    assert axis.regulators.speed_feedforward == 0.0
    assert load_machine().nc.smoothing_s == ()


@pytest.mark.parametrize(
    ("scenario", "place", "before", "after"),
    [("full", "A", 94, 13), ("half", "A", 434, 227), ("lag", "A", 588, 970),
     ("full", "D", 10, 3), ("half", "D", 85, 67), ("lag", "D", 110, 233)],
)  # fmt: skip
def test_mirror_has_known_effects(scenario: str, place: str, before: float, after: float) -> None:
    found = [
        path_predictions.find_largest_um(scenario, answer, place)
        for answer in (
            path_predictions.predict_path(scenario),
            path_predictions.predict_paper_correction(scenario, "mirror"),
        )
    ]
    assert found == pytest.approx([before, after], abs=1.0)


def test_no_loop_shows_all_claims_and_feed_doubles_error_at_a(paper_document: tuple[dict[str, Any], Path]) -> None:
    stated = {one["key"]: one for one in paper_document[0]["claims"]}
    assert stated["all-at-once"]["verdict"] == "not reproduced"
    assert stated["figure-11"]["verdict"] == "not reproduced"
    ratios = {t["scenario"]: t["value"] for t in stated["figure-11"]["trials"]}
    assert ratios["full"] == pytest.approx(2.0, abs=0.1)
    assert set(ratios) == set(PATHS)


def test_smoothed_demand_misses_corner() -> None:
    assert path_predictions.measure_corner_distance_mm("full") == pytest.approx(1.9, abs=0.05)
    assert path_predictions.measure_corner_distance_mm("sharp-lag") == 0.0
    assert path_predictions.find_largest_um("full-programmed", path_predictions.predict_path("full"), "A") > 1000


def test_offsets_are_unlimited() -> None:
    assert max(np.abs(offset).max() for offset in path_predictions.compute_offset_um("lag", "mirror").values()) > 3000.0


def test_path_equals_demo_programs() -> None:
    shipped = load_trajectory(ROOT / "configs" / "programs" / "bench_10m.ngc", load_machine("full"))
    assert np.array_equal(shipped.path_mm, path_predictions.load_reference("full").path_mm)


def test_simulated_drive_obeys_equations() -> None:
    """The model responds to the recorded voltage like the machine."""
    plant = simulated_drive.compute_parameters()
    recording = simulated_drive.record_rapids(plant)
    assert recording.voltage_v is not None
    current, speed = simulate_plant(plant, recording.voltage_v, recording.dt_s, "interval_mean")
    assert np.abs(speed - recording.speed_rad_s).max() < 0.02
    assert np.abs(current - recording.current_a).max() < 0.2


def test_load_turns_shaft_within_its_torque() -> None:
    config = load_machine("full")
    still = np.zeros(400)
    held = simulated_drive.simulate_drive(
        config.axis["X"], 1e-3, simulated_drive.compute_parameters(), still, np.full(400, 2.0)
    )
    moved = simulated_drive.simulate_drive(
        config.axis["X"], 1e-3, simulated_drive.compute_parameters(), still, np.full(400, 4.0)
    )
    assert np.abs(held.table_mm).max() == 0.0
    assert 0.0 < np.abs(moved.table_mm).max() < 0.1


def test_sign_changes_are_counted_beyond_band() -> None:
    wave = np.array([0.0, 9.0, 3.0, -9.0, -2.0, -9.0, 9.0, 0.0])
    assert correction_claims.count_sign_changes(wave, 5.0) == 2
    assert correction_claims.count_sign_changes(wave, 10.0) == 0


def test_view_contains_points_near_level() -> None:
    view = claim_drawings.View((0.0, 10.0), 5.0, 2.0)
    assert view.select_rows(np.array([[5.0, 5.0], [12.0, 5.0], [5.0, 8.0]])).tolist() == [True, False, False]
    assert view.scale_y(np.array([5.001])).tolist() == [5.001]
    assert claim_drawings.View((0.0, 1.0), 5.0, 2.0, fine=True).scale_y(np.array([5.001])) == pytest.approx([1.0])


def test_paper_prints_document_and_refuses_invalid_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = make_claim([Trial("full", "x", 1.0, "mm", most=2.0)])
    monkeypatch.setattr(command, "gather_claims", lambda runs, say: [quick])
    code, out, _ = fdhil("paper", "--out", tmp_path / "new" / "folder", "--json", capsys=capsys)
    assert code == 0
    assert json.loads(out)["counts"] == {"holds": 1, "holds with a condition": 0, "not reproduced": 0}
    code, out, _ = fdhil("paper", "--out", tmp_path / "new" / "folder", capsys=capsys)
    assert code == 0
    assert "1 holds" in out
    (tmp_path / "file").write_text("", "utf-8")
    code, _, err = fdhil("paper", "--out", tmp_path / "file" / "folder", capsys=capsys)
    assert code == 3
    assert "choose another --out" in err
