"""The on-line feed-forward is enabled only for drives commissioned for it, with validated parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fdhil.arming.arm_plan import MODEL_AGE_S, FeedforwardPlan, Refusal, collect_feedforward_facts, prepare_feedforward
from fdhil.commissioning.commissioning_record import compute_axis_digest, save_record
from fdhil.config import FeedforwardLimits, MachineConfig
from fdhil.guard.interlocks import FEEDFORWARD_FACTS
from fdhil.guard.request_parsing import parse_law
from tests.arming.test_arm_plan import make_model_states, make_record
from tests.daemon.simulated_machine import config_of


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    made = config_of(tmp_path, ("X", "Y"))
    axes = {name: axis.model_copy(update={"feedforward": FeedforwardLimits()}) for name, axis in made.axis.items()}
    return made.model_copy(update={"axis": axes})


def save_records(config: MachineConfig, **changes: Any) -> None:
    for axis in "XY":
        options = {"6007": 1, "1402": 0x400 + config.get_node_id(axis)}
        values: dict[str, Any] = {"axis": axis, "config_digest": compute_axis_digest(config, axis), "options": options}
        save_record(make_record(config, **(values | (changes if axis == "X" else {}))), config.store.directory)


def test_all_facts_hold_for_a_good_machine(config: MachineConfig) -> None:
    save_records(config)
    feeding = prepare_feedforward(config, make_model_states(config))
    assert isinstance(feeding, FeedforwardPlan)
    assert feeding.facts == dict.fromkeys(FEEDFORWARD_FACTS.keys() - {"journal_writable"}, True)
    save_records(config, options={"6007": 1, "1402": 0x40000401})  # bit 30 says nothing of an RPDO
    assert prepare_feedforward(config, make_model_states(config)) == feeding
    assert all(parse_law(dict(law)) is not None for law in feeding.laws.values())
    assert feeding.summarise()["axes"] == ["X", "Y"]


@pytest.mark.parametrize(
    ("changes", "withheld"),
    [
        ({"options": {"6007": 1}}, "feedforward_commissioned"),
        ({"options": {"1402": 0x80000401}}, "feedforward_commissioned"),
        ({"watchdog": "not proven"}, "watchdog_proven"),
        ({"config_digest": "another"}, "commissioned"),
    ],
)
def test_fact_missing_in_record_is_withheld(config: MachineConfig, changes: dict[str, Any], withheld: str) -> None:
    save_records(config, **changes)
    feeding = prepare_feedforward(config, make_model_states(config))
    assert isinstance(feeding, FeedforwardPlan)
    assert [fact for fact, good in feeding.facts.items() if not good] == [withheld]


def test_no_law_without_section_or_parameters(config: MachineConfig) -> None:
    refused = prepare_feedforward(config, make_model_states(config, published=None))
    assert isinstance(refused, Refusal)
    assert refused.reasons[0].code == "ModelNotValidated"
    axes = {"X": config.axis["X"].model_copy(update={"feedforward": None}), "Y": config.axis["Y"]}
    refused = prepare_feedforward(config.model_copy(update={"axis": axes}), make_model_states(config))
    assert isinstance(refused, Refusal)
    assert refused.reasons[0].code == "FeedforwardOff"
    assert "[axis.X.feedforward]" in refused.reasons[0].text


def test_fact_of_an_old_model_is_withdrawn(config: MachineConfig) -> None:
    assert collect_feedforward_facts("XY", config, make_model_states(config)) == {"model_fresh": True}
    assert collect_feedforward_facts("XY", config, make_model_states(config, age_s=MODEL_AGE_S + 1)) == {
        "model_fresh": False
    }
