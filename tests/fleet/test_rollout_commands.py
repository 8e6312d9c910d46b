"""The roll-out commands, as called by an operator and at the fleet server."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.commissioning.commissioning_record import compute_axis_digest, save_record
from fdhil.config import MachineConfig
from fdhil.daemon.offer_watch import OfferWatch
from fdhil.store import audit_file
from fdhil.store.change_offers import ANSWERS_FILE
from tests.commissioning.test_record import RECORD
from tests.daemon.machine_rig import fdhil
from tests.fleet.offer_signing import NOW, OfferSigner, create_machine

CHANGE = """
name = "friction"
version = 3
text = "Friction, from twelve machines"
[axis_labels]
screw = "A"
[set.axis."*".nominal]
ft = 0.061
[set.maintenance]
ft = 0.8
"""


@pytest.fixture
def offer_signer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OfferSigner:
    monkeypatch.chdir(tmp_path)
    return OfferSigner(tmp_path)


@pytest.fixture
def config_file(offer_signer: OfferSigner, tmp_path: Path) -> Path:
    return create_machine(offer_signer, tmp_path / "mill")


def place_offer(works: OfferSigner, file: Path, **changes: Any) -> MachineConfig:
    """Place an offer where the uplink would."""
    config = machine_config.load_config(file)
    config.offers_directory.mkdir(parents=True, exist_ok=True)
    version = changes.get("version", 3)
    (config.offers_directory / f"friction-{version}.offer").write_bytes(works.sign_document(**changes))
    return config


def test_offer_is_carried_to_machine_by_hand(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    Path("change.toml").write_text(CHANGE)
    _, message, _ = fdhil("fleet", "key", "works.key", capsys=capsys)
    assert message.splitlines() == ["works.key exists already; its public key, for [offers] trust of each machine:",
                                 offer_signer.public]  # fmt: skip
    signed = ["fleet", "sign", "change.toml", "--key", "works.key", "--by", "Anna", "--machine", "mill-1"]
    assert fdhil(*signed, "--out", "stick.offer", capsys=capsys)[0] == 0
    before = config_file.read_bytes()
    code, message, _ = fdhil("offers", "list", config_file, "stick.offer", capsys=capsys)
    assert (code, config_file.read_bytes()) == (0, before)
    assert message.splitlines()[:3] == [
        "friction version 3, stage 1, by Anna: Friction, from twelve machines",
        "  axis.X.nominal.ft 0.05 -> 0.061",
        "  maintenance.ft 1 -> 0.8",
    ]
    code, message, _ = fdhil("offers", "accept", config_file, "stick.offer", "--by", "Bert", capsys=capsys)
    assert code == 0
    assert "machine.toml.before-friction-3" in message
    assert message.splitlines()[-1].endswith(
        "still uses the old configuration: systemctl restart fdhil; nothing is armed"
    )
    code, message, _ = fdhil("offers", "list", config_file, "stick.offer", "--json", capsys=capsys)
    (reported,) = json.loads(message)["offers"]
    assert (reported["changes"], reported["answers"][0]["by"]) == ([], "Bert")


def test_acceptance_is_in_audit_log(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    store, before = place_offer(offer_signer, config_file).store.directory, config_file.read_bytes()
    assert fdhil("offers", "accept", config_file, "friction", "--by", "Bert", capsys=capsys)[0] == 0
    config_file.write_bytes(before)
    assert (
        fdhil("offers", "reject", config_file, "friction", "--by", "Bert\x1b[2J", "--reason", "no", capsys=capsys)[0]
        == 0
    )
    reported = [{key: entry.get(key) for key in ("by", "asked", "answered", "offer", "result")} for entry, _ in
            audit_file.read_entries(store)]  # fmt: skip
    assert reported == [
        {"by": "Bert", "asked": "accept an offer", "answered": None, "offer": "friction", "result": None},
        {"by": "Bert", "asked": None, "answered": "accept an offer", "offer": "friction", "result": "done"},
        {"by": "Bert\\x1b[2J", "asked": "reject an offer", "answered": None, "offer": "friction", "result": None},
        {"by": "Bert\\x1b[2J", "asked": None, "answered": "reject an offer", "offer": "friction", "result": "done"},
    ]
    assert (
        "accept an offer friction: done, axis.X.nominal.ft 0.05 -> 0.061"
        in fdhil("audit", config_file, capsys=capsys)[1]
    )


def test_offer_is_not_accepted_when_audit_log_fails(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    store = place_offer(offer_signer, config_file).store.directory
    (store / audit_file.AUDIT_FILE_NAME).mkdir(parents=True)
    before = config_file.read_bytes()
    assert fdhil("offers", "accept", config_file, "friction", "--by", "Bert", capsys=capsys)[0] == 3
    assert config_file.read_bytes() == before
    assert not (store / ANSWERS_FILE).exists()


def test_refused_offer_exits_1_with_reason(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    place_offer(offer_signer, config_file, expires_s=NOW - 5)
    code, _, message = fdhil("offers", "accept", config_file, "friction", "--by", "Bert", capsys=capsys)
    assert code == 1
    assert "it expired on" in message
    assert "cannot be accepted: it expired on" in fdhil("offers", "list", config_file, capsys=capsys)[1]
    place = offer_signer.write_document()
    place.write_bytes(b"junk")
    assert fdhil("offers", "list", config_file, place, capsys=capsys)[0] == 1
    assert fdhil("offers", "list", config_file, "absent.offer", capsys=capsys)[0] == 3
    code, _, message = fdhil("offers", "accept", config_file, "wear", "--by", "Bert", capsys=capsys)
    assert (code, "choose one of: friction" in message) == (2, True)
    for by in ("", " ", "x" * 65):
        assert fdhil("offers", "accept", config_file, "friction", "--by", by, capsys=capsys)[0] == 2


def test_name_selects_newest_version(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    place_offer(offer_signer, config_file)
    place_offer(offer_signer, config_file, version=10, values={"axis.X.nominal.ft": 0.07})
    assert fdhil("offers", "accept", config_file, "friction", "--by", "Bert", capsys=capsys)[0] == 0
    assert machine_config.load_config(config_file).axis["X"].nominal.ft == 0.07


def test_loosened_limit_has_own_line(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    place_offer(offer_signer, config_file, values={"maintenance.ft": 2.0})
    line = "  LOOSENS maintenance.ft 1 -> 2: more is permitted than before; accepting needs --loosens"
    assert line in fdhil("offers", "list", config_file, capsys=capsys)[1].splitlines()
    assert fdhil("offers", "accept", config_file, "friction", "--by", "Bert", capsys=capsys)[0] == 1
    assert fdhil("offers", "accept", config_file, "friction", "--by", "Bert", "--loosens", capsys=capsys)[0] == 0


def test_invalidated_records_are_listed(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    config = place_offer(
        offer_signer, config_file, values={"axis.X.correction.max_offset_um": 5.0, "axis.Y.nominal.ft": 0.06}
    )
    for axis in "XY":
        save_record(replace(RECORD, axis=axis, config_digest=compute_axis_digest(config, axis)), config.store.directory)
    message = fdhil("offers", "list", config_file, capsys=capsys)[1]
    assert "the commissioning record of axis X becomes invalid" in message
    assert "record of axis Y" not in message
    assert "arming is refused until the axes are identified again" in message


def test_machine_without_trusted_keys_refuses_offer(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    place_offer(offer_signer, config_file)
    config_file.write_text(config_file.read_text().partition("# what follows")[0])
    assert "which is not listed in [offers] trust" in fdhil("offers", "list", config_file, capsys=capsys)[1]
    assert OfferWatch(machine_config.load_config(config_file)).find_new_offers() == []


def test_daemon_notifies_offer_once_until_answered(offer_signer: OfferSigner, config_file: Path, capsys: Any) -> None:
    config = place_offer(offer_signer, config_file)
    (config.offers_directory / "notes.txt").write_text("none of ours")
    watch = OfferWatch(config)
    (notice,) = watch.find_new_offers()
    assert (notice.code, notice.severity) == ("OfferWaits", "minor")
    assert notice.text == "a configuration change is proposed: friction version 3"
    assert watch.find_new_offers() == []
    place_offer(offer_signer, config_file, version=4)
    assert [each.text for each in watch.find_new_offers()] == ["a configuration change is proposed: friction version 4"]
    fdhil("offers", "reject", config_file, "friction", "--by", "Bert", "--reason", "another oil", capsys=capsys)
    assert [each.text[-1] for each in OfferWatch(config).find_new_offers()] == ["3"]
    (config.store.directory / ANSWERS_FILE).write_text("{")
    assert "is damaged" in OfferWatch(config).find_new_offers()[0].text


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "friction"', 'name = "Friction!"', "name"),
        ("ft = 0.061", "friction = 1.0", "not a key"),
        ("[set.maintenance]", "[set.guard]", "configured at the machine only"),
        ("[set.maintenance]", "[sets]", "sets"),
        ("version = 3", "", "version"),
    ],
)
def test_invalid_change_exits_2(old: str, new: str, words: str, offer_signer: OfferSigner, capsys: Any) -> None:
    Path("change.toml").write_text(CHANGE.replace(old, new))
    signed = ["fleet", "sign", "change.toml", "--key", "works.key", "--by", "Anna", "--machine", "mill-1"]
    code, _, message = fdhil(*signed, "--out", "stick.offer", capsys=capsys)
    assert (code, words in message, Path("stick.offer").exists()) == (2, True, False), message


def test_daemon_tracks_only_present_offers(offer_signer: OfferSigner, config_file: Path) -> None:
    config = place_offer(offer_signer, config_file)
    watch = OfferWatch(config)
    watch.find_new_offers()
    for number in range(1, 60):
        for old in config.offers_directory.glob("*.offer"):
            old.unlink()
        (config.offers_directory / f"other-{number}.offer").touch()
        assert [each.text for each in watch.find_new_offers()] == [
            f"a configuration change is proposed: other version {number}"
        ]
    assert len(watch._reported) == 1
