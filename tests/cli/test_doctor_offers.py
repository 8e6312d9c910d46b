"""``fdhil doctor`` reports pending and unreadable configuration changes."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.cli.doctor.offers_check import examine_offers
from fdhil.config import MachineConfig
from fdhil.store.change_offers import ANSWERS_FILE, OfferDecision, add_decision, make_file_name
from tests.fleet.offer_signing import OfferSigner, create_machine


@pytest.fixture
def machine(tmp_path: Path) -> MachineConfig:
    works = OfferSigner(tmp_path)
    config = machine_config.load_config(create_machine(works, tmp_path / "mill"))
    config.offers_directory.mkdir(parents=True)
    (config.offers_directory / make_file_name("friction", 3)).write_bytes(works.sign_document())
    return config


def list_trouble_codes(machine: MachineConfig) -> list[tuple[str, bool]]:
    found = list(examine_offers(machine))
    assert all(each.what and each.means and each.mend for each in found)
    return [(each.code, each.grave) for each in found]


def test_offer_is_reported_until_answered(machine: MachineConfig) -> None:
    assert list_trouble_codes(machine) == [("OfferWaits", False)]
    answer = OfferDecision("friction", 3, 1, "0" * 64, "rejected", "Anna", "not now", time.time(), "")
    add_decision(machine.store.directory, answer)
    assert list_trouble_codes(machine) == []


def test_unreadable_answers_are_reported(machine: MachineConfig) -> None:
    machine.store.directory.mkdir(parents=True, exist_ok=True)
    (machine.store.directory / ANSWERS_FILE).write_text("{")
    assert list_trouble_codes(machine) == [("OffersUnread", True)]


@pytest.mark.parametrize("what", ["the folder", "an offer"])
def test_offers_without_read_permission_are_reported(
    what: str, machine: MachineConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = machine.offers_directory
    shut = folder if what == "the folder" else folder / make_file_name("friction", 3)
    monkeypatch.setattr(os, "access", lambda path, _: path != shut)  # root can read everything
    assert ("OffersUnread", True) in list_trouble_codes(machine)


def test_offers_are_ignored_without_trusted_key(machine: MachineConfig) -> None:
    alone = machine.model_copy(update={"offers": machine.offers.model_copy(update={"trust": ()})})
    assert list_trouble_codes(alone) == []


def test_no_offers_are_no_problem(tmp_path: Path) -> None:
    assert (
        list_trouble_codes(machine_config.load_config(create_machine(OfferSigner(tmp_path), tmp_path / "mill"))) == []
    )
