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
from fdhil.fleet import offer_review
from fdhil.fleet.offer_review import (
    ReviewedOffer,
    accept_offer,
    build_backup_path,
    load_current_machine,
    reject_offer,
    review_offer,
)
from fdhil.fleet.signed_offer import Offer, OfferRefused
from fdhil.store.atomic_file import write_file
from fdhil.store.change_offers import (
    ANSWERS_FILE,
    LARGEST_ANSWERS,
    OfferDecision,
    add_decision,
    find_newest_accepted,
    make_file_name,
    read_decisions,
)
from tests.fleet.offer_signing import NOW, TOLD, OfferSigner, create_machine


@pytest.fixture
def offer_signer(tmp_path: Path) -> OfferSigner:
    return OfferSigner(tmp_path)


@pytest.fixture
def config_file(offer_signer: OfferSigner, tmp_path: Path) -> Path:
    return create_machine(offer_signer, tmp_path / "mill")


def review(works: OfferSigner, file: Path, now_s: float | None = None, **changes: Any) -> ReviewedOffer:
    return review_offer(works.write_document(**changes), load_current_machine(file, now_s))


def list_changes(found: ReviewedOffer) -> dict[str, tuple[Any, Any]]:
    assert found.wrong == ""
    return {each.path: (each.old, each.new) for each in found.changes}


def test_offer_lists_changes_on_this_machine(offer_signer: OfferSigner, config_file: Path) -> None:
    values = {"axis.X.nominal.ft": 0.061, "axis.X.nominal.R": 0.5, "maintenance.ft": 0.8, "nc.smoothing_s": (0.05,)}
    found = review(offer_signer, config_file, values=values)
    assert list_changes(found) == {
        "axis.X.nominal.ft": (0.05, 0.061),
        "maintenance.ft": (1.0, 0.8),
        "nc.smoothing_s": ((0.06, 0.03), (0.05,)),
    }
    assert found.loosened_values == []
    assert "ft = 0.061  # by the data sheet" in found.text
    assert "# what follows is the operator's" in found.text


def test_values_for_axis_labels_change_only_those_axes(offer_signer: OfferSigner, config_file: Path) -> None:
    values = {"axis.*.nominal.ft": 0.07, "axis.*.nominal.Cd": 4.0}
    found = review(offer_signer, config_file, values=values, axis_labels={"screw": "B"})
    assert list_changes(found) == {"axis.Y.nominal.ft": (0.05, 0.07), "axis.Y.nominal.Cd": (5.0, 4.0)}
    none = review(offer_signer, config_file, values=values, axis_labels={"screw": "C"})
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
def test_unsuitable_offer_changes_nothing(
    changes: dict[str, Any], words: str, offer_signer: OfferSigner, config_file: Path
) -> None:
    before = config_file.read_bytes()
    assert words in review(offer_signer, config_file, **changes).wrong
    with pytest.raises(OfferRefused, match="is not accepted"):
        accept_offer(offer_signer.write_document(**changes), config_file, "Bert", may_loosen=True)
    assert config_file.read_bytes() == before
    assert read_decisions(load_current_machine(config_file).config.store.directory) == []


def test_machine_without_uplink_has_own_name_and_no_labels(offer_signer: OfferSigner, config_file: Path) -> None:
    text = config_file.read_text()
    start = text.index("[uplink")
    config_file.write_text(text[:start] + text[text.index("# what follows") :])
    assert "label type" in review(offer_signer, config_file).wrong
    assert list_changes(review(offer_signer, config_file, labels={})) == {"axis.X.nominal.ft": (0.05, 0.061)}


def test_accepted_values_are_written_and_old_file_is_kept(offer_signer: OfferSigner, config_file: Path) -> None:
    before = config_file.read_bytes()
    config_file.chmod(0o640)
    done = accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    assert done.offer is not None
    assert build_backup_path(config_file, done.offer).read_bytes() == before
    assert {path.stat().st_mode & 0o777 for path in (config_file, build_backup_path(config_file, done.offer))} == {
        0o640
    }
    config = machine_config.load_config(config_file)
    assert config.axis["X"].nominal.ft == 0.061
    (answer,) = read_decisions(config.store.directory)
    assert (answer.answer, answer.by, answer.version, answer.config_digest) == ("accepted", "Bert", 3, config.digest)
    once_more = accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    assert once_more.changes == []
    assert len(read_decisions(config.store.directory)) == 1
    assert not list(config_file.parent.glob(".*"))


def test_linked_configuration_stays_a_link(offer_signer: OfferSigner, config_file: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.toml"
    link.symlink_to(config_file)
    (tmp_path / "fdhil-data").mkdir()
    accept_offer(offer_signer.write_document(), link, "Bert", may_loosen=False)
    assert link.is_symlink()
    assert tomllib.loads(config_file.read_text())["axis"]["X"]["nominal"]["ft"] == 0.061


def test_older_version_is_refused_after_newer_one(offer_signer: OfferSigner, config_file: Path) -> None:
    accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    assert "version 3 was already accepted" in review(offer_signer, config_file, version=2).wrong
    assert review(offer_signer, config_file, version=2, name="other").wrong == ""
    assert review(offer_signer, config_file, version=4, values={"axis.X.nominal.ft": 0.05}).wrong == ""
    lie = load_current_machine(config_file).config.offers_directory
    lie.mkdir(parents=True)
    (lie / make_file_name("friction", 5)).write_bytes(offer_signer.sign_document(version=5))
    (lie / make_file_name("friction", 6)).write_bytes(b"no offer, whatever its name says")
    os.mkfifo(lie / make_file_name("friction", 7))
    assert "version 5 of the fleet server replaces it" in review(offer_signer, config_file, version=4).wrong
    assert (
        review_offer(lie / make_file_name("friction", 7), load_current_machine(config_file)).wrong
        == "it is not a regular file; export it again"
    )
    assert review_offer(lie, load_current_machine(config_file)).wrong == "it is not a regular file; export it again"


def test_accepted_version_with_other_values_is_refused(offer_signer: OfferSigner, config_file: Path) -> None:
    accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    before = config_file.read_bytes()
    for other in ({"values": {"axis.X.nominal.ft": 0.09}}, {"values": {"axis.X.nominal.ft": 0.09}, "stage": 2}):
        with pytest.raises(OfferRefused, match="was accepted with other values by Bert"):
            accept_offer(offer_signer.write_document(**other), config_file, "Bert", may_loosen=True)
    assert config_file.read_bytes() == before
    assert review(offer_signer, config_file, stage=2).wrong == ""  # a later stage of the same change
    build_backup_path(config_file, Offer(**TOLD)).replace(config_file)
    accept_offer(
        offer_signer.write_document(), config_file, "Bert", may_loosen=False
    )  # the same document, after the old values were put back
    assert config_file.read_bytes() == before


def test_loosened_limit_needs_confirmation(offer_signer: OfferSigner, config_file: Path) -> None:
    loose: dict[str, Any] = {"values": {"axis.X.correction.max_offset_um": 240.0, "maintenance.ft": 2.0}}
    tight = review(offer_signer, config_file, **loose)
    assert [each.path for each in tight.loosened_values] == ["maintenance.ft"]
    config_file.write_text(config_file.read_text().replace("max_offset_um = 250.0", "max_offset_um = 5.0"))
    found = review(offer_signer, config_file, **loose)
    keys = ["axis.X.correction.max_offset_um", "maintenance.ft", "the guard: axis X, the offset's offset"]
    assert [each.path for each in found.loosened_values] == keys
    with pytest.raises(OfferRefused, match=r"it loosens axis.X.correction.max_offset_um; .*--loosens"):
        accept_offer(offer_signer.write_document(**loose), config_file, "Bert", may_loosen=False)
    assert accept_offer(offer_signer.write_document(**loose), config_file, "Bert", may_loosen=True).wrong == ""


@pytest.mark.parametrize(
    ("values", "limit"),
    [
        ({"axis.X.nominal.K": 0.7}, "the feed-forward's torque"),
        ({"axis.X.nominal.Jt": 0.05}, "the highest plausible change of speed"),
        ({"axis.X.regulators.current_limit_a": 250.0}, "the highest plausible change of speed"),
        ({"axis.X.max_acceleration_mm_s2": 5000.0}, "the highest plausible acceleration"),
    ],
)
def test_indirectly_loosened_guard_limit_is_found(
    values: dict[str, Any], limit: str, offer_signer: OfferSigner, config_file: Path
) -> None:
    """An offer without any guard key can still loosen a limit of the guard."""
    config_file.write_text(
        config_file.read_text().replace("[axis.X.regulators]", "[axis.X.feedforward]\n\n[axis.X.regulators]")
    )
    found = review(offer_signer, config_file, values=values)
    assert f"the guard: axis X, {limit}" in [each.path for each in found.loosened_values]
    with pytest.raises(OfferRefused, match="--loosens"):
        accept_offer(offer_signer.write_document(values=values), config_file, "Bert", may_loosen=False)


def test_rejected_offer_changes_nothing_and_can_be_accepted_later(offer_signer: OfferSigner, config_file: Path) -> None:
    before = config_file.read_bytes()
    reject_offer(offer_signer.write_document(expires_s=NOW - 1), config_file, "Bert", "the screw was changed last week")
    assert config_file.read_bytes() == before
    store = load_current_machine(config_file).config.store.directory
    (answer,) = read_decisions(store)
    assert (answer.answer, answer.reason) == ("rejected", "the screw was changed last week")
    assert find_newest_accepted([answer], "friction") == 0
    accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    assert [each.answer for each in read_decisions(store)] == ["rejected", "accepted"]


def test_offer_in_force_cannot_be_rejected(offer_signer: OfferSigner, config_file: Path) -> None:
    """Also after its expiry; once the old values are restored it may be rejected."""
    before = config_file.read_bytes()
    done = accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    for expires_s in (NOW + 3600, NOW - 1):
        with pytest.raises(
            OfferRefused, match=r"accepted by Bert and .* in force: it is not rejected; restore the previous"
        ):
            reject_offer(offer_signer.write_document(expires_s=expires_s), config_file, "Anna", "no")
    assert done.offer is not None
    config_file.write_bytes(build_backup_path(config_file, done.offer).read_bytes())
    assert config_file.read_bytes() == before
    reject_offer(offer_signer.write_document(), config_file, "Anna", "it was worse")
    answers = read_decisions(load_current_machine(config_file).config.store.directory)
    assert [each.answer for each in answers] == ["accepted", "rejected"]


def test_untrusted_offer_is_not_answered(offer_signer: OfferSigner, config_file: Path) -> None:
    place = offer_signer.write_document()
    place.write_bytes(place.read_bytes().replace(b"0.061", b"0.062"))
    with pytest.raises(OfferRefused, match="changed after it was signed"):
        reject_offer(place, config_file, "Bert", "no")
    assert not (load_current_machine(config_file).config.store.directory / ANSWERS_FILE).exists()


ANSWERS = b'{"schema": "fdhil-offers-1", "answers": [{"name": 1}]}'


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"schema": "x", "answers": []}', ANSWERS, b"[" * 9000])
def test_offer_is_not_accepted_when_answers_are_unreadable(
    damage: bytes, offer_signer: OfferSigner, config_file: Path
) -> None:
    store = load_current_machine(config_file).config.store.directory
    store.mkdir(exist_ok=True)
    (store / ANSWERS_FILE).write_bytes(damage)
    before = config_file.read_bytes()
    with pytest.raises(StoreError, match="older offers cannot be recognised"):
        accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    assert config_file.read_bytes() == before


def test_answers_of_wrong_types_are_damage(tmp_path: Path) -> None:
    right = OfferDecision("a", 1, 1, "d", "accepted", "b", "", 1.5, "c")
    for wrong in (replace(right, version="1"), replace(right, at_s=1), replace(right, answer="maybe")):  # type: ignore[arg-type]
        write_file(tmp_path / ANSWERS_FILE, b"")
        (tmp_path / ANSWERS_FILE).unlink()
        add_decision(tmp_path, right)
        reported = json.loads((tmp_path / ANSWERS_FILE).read_text())
        reported["answers"].append({name: getattr(wrong, name) for name in OfferDecision.__slots__})
        (tmp_path / ANSWERS_FILE).write_text(json.dumps(reported))
        with pytest.raises(StoreError):
            read_decisions(tmp_path)


def test_answer_on_full_disk_is_refused_and_earlier_ones_kept(tmp_path: Path) -> None:
    first = OfferDecision("a", 1, 1, "d", "accepted", "b", "", 1.5, "c")
    add_decision(tmp_path, first)
    with pytest.raises(StoreError, match="no room for another decision"):
        add_decision(tmp_path, replace(first, reason="x" * LARGEST_ANSWERS))
    assert read_decisions(tmp_path) == [first]


def test_full_disk_leaves_configuration_unchanged(
    offer_signer: OfferSigner, config_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = config_file.read_bytes()

    def fail_write(path: Path, content: bytes, like: os.stat_result | None = None) -> None:
        if path == config_file:
            raise StoreError(f"{path} could not be written: the disk is full", "DiskFull")
        write_file(path, content, like)

    monkeypatch.setattr(offer_review, "write_file", fail_write)
    with pytest.raises(OutputError, match="the disk is full; free some space; the configuration is unchanged"):
        accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    assert config_file.read_bytes() == before
    assert read_decisions(load_current_machine(config_file).config.store.directory) == []
    monkeypatch.undo()
    accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)


def test_concurrent_answers_are_refused(offer_signer: OfferSigner, config_file: Path) -> None:
    held = os.open(config_file.parent, os.O_RDONLY | os.O_DIRECTORY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(OutputError, match="another command is answering"):
        accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)
    os.close(held)
    accept_offer(offer_signer.write_document(), config_file, "Bert", may_loosen=False)


def test_machine_description_is_independent_of_trusted_keys(offer_signer: OfferSigner, config_file: Path) -> None:
    trusting = machine_config.load_config(config_file)
    text = config_file.read_text()
    config_file.write_text(text[: text.index("# what follows")])
    assert machine_config.load_config(config_file).digest == trusting.digest
    assert TOLD["machines"] == (trusting.plant_name,)
