"""At the machine: the effect of an offer, and that only the operator's answer applies it."""

from __future__ import annotations

import fcntl
import json
import os
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.errors import OutputError, StoreError
from fdhil.fleet import offered
from fdhil.fleet.offer import Offer, OfferRefused
from fdhil.fleet.offered import Judged, accept, judge, kept_file, present, reject
from fdhil.store.atomic import write_file
from fdhil.store.offers import (
    ANSWERS_FILE,
    LARGEST_ANSWERS,
    Answer,
    add_answer,
    file_name,
    newest_accepted,
    read_answers,
)
from tests.fleet.offers import NOW, TOLD, Works, machine_of


@pytest.fixture
def works(tmp_path: Path) -> Works:
    return Works(tmp_path)


@pytest.fixture
def file(works: Works, tmp_path: Path) -> Path:
    return machine_of(works, tmp_path / "mill")


def judged(works: Works, file: Path, now_s: float | None = None, **changes: Any) -> Judged:
    return judge(works.carried(**changes), present(file, now_s))


def changes_of(found: Judged) -> dict[str, tuple[Any, Any]]:
    assert found.wrong == ""
    return {each.path: (each.old, each.new) for each in found.changes}


def test_an_offer_shows_what_it_changes_here(works: Works, file: Path) -> None:
    values = {"axis.X.nominal.ft": 0.061, "axis.X.nominal.R": 0.5, "maintenance.ft": 0.8, "nc.smoothing_s": (0.05,)}
    found = judged(works, file, values=values)
    assert changes_of(found) == {
        "axis.X.nominal.ft": (0.05, 0.061),
        "maintenance.ft": (1.0, 0.8),
        "nc.smoothing_s": ((0.06, 0.03), (0.05,)),
    }
    assert found.loosens == []
    assert "ft = 0.061  # by the data sheet" in found.text
    assert "# what follows is the operator's" in found.text


def test_a_model_for_a_kind_of_axis_reaches_those_axes_alone(works: Works, file: Path) -> None:
    values = {"axis.*.nominal.ft": 0.07, "axis.*.nominal.Cd": 4.0}
    found = judged(works, file, values=values, axis_labels={"screw": "B"})
    assert changes_of(found) == {"axis.Y.nominal.ft": (0.05, 0.07), "axis.Y.nominal.Cd": (5.0, 4.0)}
    none = judged(works, file, values=values, axis_labels={"screw": "C"})
    assert "no axis of this machine" in none.wrong


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"expires_s": NOW - 1}, "it expired on"),
        ({"made_s": NOW + 100_000}, "set the clock"),
        ({"machines": ("mill-2", "mill-3")}, "its stage 1 is not for mill-1"),
        ({"labels": {"type": "V-900"}}, "label type = 'V-900'"),
        ({"labels": {"type": "V-800", "site": "Ulm"}}, "label site"),
        ({"values": {"axis.Z.nominal.ft": 0.06}}, "this machine has no [axis.Z.nominal]"),
        ({"values": {"axis.X.feedforward.max_torque_nm": 1.0}}, "which can only be enabled at the machine"),
        ({"values": {"axis.X.correction.max_speed_mm_s": 1e-6}}, "would make the configuration invalid"),
        ({"values": {"axis.X.regulators.position_ki_per_s2": 5.0}}, "set structure = 'double_pi'"),
    ],
)
def test_an_offer_that_does_not_fit_changes_nothing(
    changes: dict[str, Any], words: str, works: Works, file: Path
) -> None:
    before = file.read_bytes()
    assert words in judged(works, file, **changes).wrong
    with pytest.raises(OfferRefused, match="is not accepted"):
        accept(works.carried(**changes), file, "Bert", may_loosen=True)
    assert file.read_bytes() == before
    assert read_answers(present(file).config.store.directory) == []


def test_without_uplink_a_machine_has_its_own_name_and_no_labels(works: Works, file: Path) -> None:
    text = file.read_text()
    start = text.index("[uplink")
    file.write_text(text[:start] + text[text.index("# what follows") :])
    assert "label type" in judged(works, file).wrong
    assert changes_of(judged(works, file, labels={})) == {"axis.X.nominal.ft": (0.05, 0.061)}


def test_what_is_accepted_stands_in_the_file_and_the_old_one_beside_it(works: Works, file: Path) -> None:
    before = file.read_bytes()
    file.chmod(0o640)
    done = accept(works.carried(), file, "Bert", may_loosen=False)
    assert done.offer is not None
    assert kept_file(file, done.offer).read_bytes() == before
    assert {path.stat().st_mode & 0o777 for path in (file, kept_file(file, done.offer))} == {0o640}
    config = machine_config.load_config(file)
    assert config.axis["X"].nominal.ft == 0.061
    (answer,) = read_answers(config.store.directory)
    assert (answer.answer, answer.by, answer.version, answer.config_digest) == ("accepted", "Bert", 3, config.digest)
    once_more = accept(works.carried(), file, "Bert", may_loosen=False)
    assert once_more.changes == []
    assert len(read_answers(config.store.directory)) == 1
    assert not list(file.parent.glob(".*"))


def test_a_configuration_that_is_a_link_stays_one(works: Works, file: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.toml"
    link.symlink_to(file)
    (tmp_path / "fdhil-data").mkdir()
    accept(works.carried(), link, "Bert", may_loosen=False)
    assert link.is_symlink()
    assert tomllib.loads(file.read_text())["axis"]["X"]["nominal"]["ft"] == 0.061


def test_an_older_version_never_follows_a_newer_one(works: Works, file: Path) -> None:
    accept(works.carried(), file, "Bert", may_loosen=False)
    assert "version 3 was already accepted" in judged(works, file, version=2).wrong
    assert judged(works, file, version=2, name="other").wrong == ""
    assert judged(works, file, version=4, values={"axis.X.nominal.ft": 0.05}).wrong == ""
    lie = present(file).config.offers_directory
    lie.mkdir(parents=True)
    (lie / file_name("friction", 5)).write_bytes(works.document(version=5))
    (lie / file_name("friction", 6)).write_bytes(b"no offer, whatever its name says")
    os.mkfifo(lie / file_name("friction", 7))
    assert "version 5 of the fleet server replaces it" in judged(works, file, version=4).wrong
    assert judge(lie / file_name("friction", 7), present(file)).wrong == "it is not a regular file; export it again"
    assert judge(lie, present(file)).wrong == "it is not a regular file; export it again"


def test_a_version_that_was_accepted_is_not_accepted_with_other_values(works: Works, file: Path) -> None:
    accept(works.carried(), file, "Bert", may_loosen=False)
    before = file.read_bytes()
    for other in ({"values": {"axis.X.nominal.ft": 0.09}}, {"values": {"axis.X.nominal.ft": 0.09}, "stage": 2}):
        with pytest.raises(OfferRefused, match="was accepted with other values by Bert"):
            accept(works.carried(**other), file, "Bert", may_loosen=True)
    assert file.read_bytes() == before
    assert judged(works, file, stage=2).wrong == ""  # a later stage of the same change
    kept_file(file, Offer(**TOLD)).replace(file)
    accept(works.carried(), file, "Bert", may_loosen=False)  # the same document, after the old values were put back
    assert file.read_bytes() == before


def test_a_loosened_limit_is_named_and_asked_for(works: Works, file: Path) -> None:
    loose: dict[str, Any] = {"values": {"axis.X.correction.max_offset_um": 240.0, "maintenance.ft": 2.0}}
    tight = judged(works, file, **loose)
    assert [each.path for each in tight.loosens] == ["maintenance.ft"]
    file.write_text(file.read_text().replace("max_offset_um = 250.0", "max_offset_um = 5.0"))
    found = judged(works, file, **loose)
    keys = ["axis.X.correction.max_offset_um", "maintenance.ft", "the guard: axis X, the offset's offset"]
    assert [each.path for each in found.loosens] == keys
    with pytest.raises(OfferRefused, match=r"it loosens axis.X.correction.max_offset_um; .*--loosens"):
        accept(works.carried(**loose), file, "Bert", may_loosen=False)
    assert accept(works.carried(**loose), file, "Bert", may_loosen=True).wrong == ""


@pytest.mark.parametrize(
    ("values", "limit"),
    [
        ({"axis.X.nominal.K": 0.7}, "the feed-forward's torque"),
        ({"axis.X.nominal.Jt": 0.05}, "the highest plausible change of speed"),
        ({"axis.X.regulators.current_limit_a": 250.0}, "the highest plausible change of speed"),
        ({"axis.X.max_acceleration_mm_s2": 5000.0}, "the highest plausible acceleration"),
    ],
)
def test_what_loosens_the_guard_by_another_way_is_found(
    values: dict[str, Any], limit: str, works: Works, file: Path
) -> None:
    """An offer without any guard key can still loosen a limit of the guard."""
    file.write_text(file.read_text().replace("[axis.X.regulators]", "[axis.X.feedforward]\n\n[axis.X.regulators]"))
    found = judged(works, file, values=values)
    assert f"the guard: axis X, {limit}" in [each.path for each in found.loosens]
    with pytest.raises(OfferRefused, match="--loosens"):
        accept(works.carried(values=values), file, "Bert", may_loosen=False)


def test_a_rejected_offer_changes_nothing_and_may_be_accepted_later(works: Works, file: Path) -> None:
    before = file.read_bytes()
    reject(works.carried(expires_s=NOW - 1), file, "Bert", "the screw was changed last week")
    assert file.read_bytes() == before
    store = present(file).config.store.directory
    (answer,) = read_answers(store)
    assert (answer.answer, answer.reason) == ("rejected", "the screw was changed last week")
    assert newest_accepted([answer], "friction") == 0
    accept(works.carried(), file, "Bert", may_loosen=False)
    assert [each.answer for each in read_answers(store)] == ["rejected", "accepted"]


def test_what_was_accepted_and_is_in_force_is_not_rejected(works: Works, file: Path) -> None:
    """Also after its expiry; once the old values are restored it may be rejected."""
    before = file.read_bytes()
    done = accept(works.carried(), file, "Bert", may_loosen=False)
    for expires_s in (NOW + 3600, NOW - 1):
        with pytest.raises(
            OfferRefused, match=r"accepted by Bert and .* in force: it is not rejected; restore the previous"
        ):
            reject(works.carried(expires_s=expires_s), file, "Anna", "no")
    assert done.offer is not None
    file.write_bytes(kept_file(file, done.offer).read_bytes())
    assert file.read_bytes() == before
    reject(works.carried(), file, "Anna", "it was worse")
    answers = read_answers(present(file).config.store.directory)
    assert [each.answer for each in answers] == ["accepted", "rejected"]


def test_who_is_not_trusted_is_not_answered(works: Works, file: Path) -> None:
    place = works.carried()
    place.write_bytes(place.read_bytes().replace(b"0.061", b"0.062"))
    with pytest.raises(OfferRefused, match="changed after it was signed"):
        reject(place, file, "Bert", "no")
    assert not (present(file).config.store.directory / ANSWERS_FILE).exists()


ANSWERS = b'{"schema": "fdhil-offers-1", "answers": [{"name": 1}]}'


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"schema": "x", "answers": []}', ANSWERS, b"[" * 9000])
def test_where_the_answers_cannot_be_read_nothing_is_accepted(damage: bytes, works: Works, file: Path) -> None:
    store = present(file).config.store.directory
    store.mkdir(exist_ok=True)
    (store / ANSWERS_FILE).write_bytes(damage)
    before = file.read_bytes()
    with pytest.raises(StoreError, match="older offers cannot be recognised"):
        accept(works.carried(), file, "Bert", may_loosen=False)
    assert file.read_bytes() == before


def test_answers_of_wrong_kinds_are_damage(tmp_path: Path) -> None:
    right = Answer("a", 1, 1, "d", "accepted", "b", "", 1.5, "c")
    for wrong in (replace(right, version="1"), replace(right, at_s=1), replace(right, answer="maybe")):  # type: ignore[arg-type]
        write_file(tmp_path / ANSWERS_FILE, b"")
        (tmp_path / ANSWERS_FILE).unlink()
        add_answer(tmp_path, right)
        told = json.loads((tmp_path / ANSWERS_FILE).read_text())
        told["answers"].append({name: getattr(wrong, name) for name in Answer.__slots__})
        (tmp_path / ANSWERS_FILE).write_text(json.dumps(told))
        with pytest.raises(StoreError):
            read_answers(tmp_path)


def test_an_answer_for_which_there_is_no_room_is_refused_and_those_before_it_stay(tmp_path: Path) -> None:
    first = Answer("a", 1, 1, "d", "accepted", "b", "", 1.5, "c")
    add_answer(tmp_path, first)
    with pytest.raises(StoreError, match="no room for another decision"):
        add_answer(tmp_path, replace(first, reason="x" * LARGEST_ANSWERS))
    assert read_answers(tmp_path) == [first]


def test_a_full_disk_leaves_the_configuration_as_it_was(
    works: Works, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = file.read_bytes()

    def full(path: Path, content: bytes, like: os.stat_result | None = None) -> None:
        if path == file:
            raise StoreError(f"{path} could not be written: the disk is full", "DiskFull")
        write_file(path, content, like)

    monkeypatch.setattr(offered, "write_file", full)
    with pytest.raises(OutputError, match="the disk is full; free some space; the configuration is unchanged"):
        accept(works.carried(), file, "Bert", may_loosen=False)
    assert file.read_bytes() == before
    assert read_answers(present(file).config.store.directory) == []
    monkeypatch.undo()
    accept(works.carried(), file, "Bert", may_loosen=False)


def test_two_do_not_answer_at_once(works: Works, file: Path) -> None:
    held = os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(OutputError, match="another command is answering"):
        accept(works.carried(), file, "Bert", may_loosen=False)
    os.close(held)
    accept(works.carried(), file, "Bert", may_loosen=False)


def test_what_a_machine_says_of_itself_does_not_depend_on_whom_it_trusts(works: Works, file: Path) -> None:
    trusting = machine_config.load_config(file)
    text = file.read_text()
    file.write_text(text[: text.index("# what follows")])
    assert machine_config.load_config(file).digest == trusting.digest
    assert TOLD["machines"] == (trusting.plant_name,)
