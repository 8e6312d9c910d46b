"""Values of an NC become its state by the rules of a profile: packaged ones, a user's own, and wrong values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil import tables
from fdhil.drivers.nc.nc_blocks import IsoBlocks, KlartextBlocks
from fdhil.drivers.nc.nc_profile import Condition, StateTranslator
from fdhil.drivers.nc.nc_profile_file import build_nc_profile, read_nc_profile
from fdhil.errors import ConfigError, ProtocolError
from fdhil.records import MoveKind, NcState

RAPID: dict[str, dict[str, Any]] = {  # what each packaged profile is shown during a rapid
    "mtconnect": {"execution": "ACTIVE", "block": "N20 G0 X10"},
    "opc40502": {"status": 1, "g_functions": (90, 0, 54), "feed_override": 100.0},
    "siemens": {"status": 3, "g_group_1": "G00", "feed_override": 100.0, "rapid_override": 50.0, "line": 7},
    "heidenhain": {"state": 0, "block": "5 L X+10 FMAX", "feed_override": 100.0},
    "beckhoff": {"state": 4, "g_function": 0, "line": 3, "feed_mm_min": 1e6 / 6},
}
OWN: dict[str, Any] = {
    "title": "own",
    "interface": "opcua",
    "signals": {
        "word": {"at": "ns=2;s=Word", "bit": 3},
        "speed": {"at": "ns=2;s=Speed", "item": 1},
        "feed_override": {"at": "ns=2;s=Override", "scale": 0.01, "optional": True},
    },
    "motion": [
        {"kind": "hold", "when": {"word": [True]}},
        {"kind": "rapid", "when": {"word": [False], "speed": {"at_least": 100.0}}},
        {"kind": "rest", "when": {"speed": {"at_most": 0.0}}},
    ],
}


def translate_values(profile: str, shown: dict[str, Any]) -> NcState:
    found = read_nc_profile(profile, "mtconnect" if profile == "mtconnect" else "opcua")
    return StateTranslator(found, "NC").translate_state(shown, 10, 5)


@pytest.mark.parametrize("name", tables.NC_PROFILES)
def test_packaged_profiles_recognise_rapid_hold_and_rest(name: str) -> None:
    profile = read_nc_profile(name, "mtconnect" if name == "mtconnect" else "opcua")
    assert {rule.kind for rule in profile.rules} == {
        MoveKind.HOLD, MoveKind.REST, MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC,
    }  # fmt: skip
    assert profile.rules[0].kind is MoveKind.HOLD  # a hold is told before anything else
    state = translate_values(name, RAPID[name])
    assert (state.motion, state.stamp_ns, state.error_ns) == (MoveKind.RAPID, 10, 5)
    assert profile.notes, "it says what was never tried"


@pytest.mark.parametrize("name", tables.NC_PROFILES)
def test_missing_deciding_signal_never_gives_a_rapid(name: str) -> None:
    profile = read_nc_profile(name, "mtconnect" if name == "mtconnect" else "opcua")
    for decides in {signal for rule in profile.rules for signal in rule.when}:
        assert translate_values(name, {**RAPID[name], decides: None}).motion is MoveKind.UNKNOWN


def test_numbers_are_converted_to_the_records_units() -> None:
    state = translate_values("siemens", RAPID["siemens"])
    assert (state.feed_override, state.rapid_override, state.line, state.tool) == (1.0, 0.5, 7, None)
    assert translate_values("beckhoff", RAPID["beckhoff"]).feed_mm_min == pytest.approx(1e4)
    assert translate_values("siemens", {**RAPID["siemens"], "line": -1}).line is None
    assert translate_values("opc40502", {**RAPID["opc40502"], "line": "N0120"}).line == 120


@pytest.mark.parametrize(
    ("signal", "value"),
    [("feed_override", 1e6), ("feed_override", -1.0), ("rapid_override", math.nan), ("line", 1.5), ("program", 3)],
)
def test_impossible_value_names_its_signal(signal: str, value: object) -> None:
    with pytest.raises(ProtocolError, match=signal):
        translate_values("siemens", {**RAPID["siemens"], signal: value})


def test_bits_items_and_bounds_select_the_motion() -> None:
    translator = StateTranslator(build_nc_profile(OWN, "own"), "NC")

    def kind(word: Any, *speeds: float) -> MoveKind:
        return translator.translate_state({"word": word, "speed": speeds}, 0, 1).motion

    assert kind(0b0111, 0.0, 100.0) is MoveKind.RAPID
    assert kind(0b1000, 0.0, 100.0) is MoveKind.HOLD
    assert kind(0b0000, 0.0, 50.0) is MoveKind.UNKNOWN
    assert kind(0b0000, 0.0, 0.0) is MoveKind.REST
    assert kind(0b0000, 0.0) is MoveKind.UNKNOWN  # the array is too short
    assert kind("text", 0.0, 100.0) is MoveKind.UNKNOWN


shown = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12) | st.tuples(st.integers())


@given(st.sampled_from(sorted(tables.NC_PROFILES)), st.data())
def test_any_values_give_a_state_or_a_device_error(name: str, data: st.DataObject) -> None:
    profile = read_nc_profile(name, "mtconnect" if name == "mtconnect" else "opcua")
    values = {signal: data.draw(shown) for signal in profile.signals}
    try:
        state = StateTranslator(profile, "NC").translate_state(values, 0, 1)
    except ProtocolError:
        return
    rapid = next(rule for rule in profile.rules if rule.kind is MoveKind.RAPID)
    plain = {key: value for key, value in values.items() if profile.signals[key].reads == "value"}
    if state.motion is MoveKind.RAPID:
        assert all(plain[key] is not None and rapid.when[key].is_met(plain[key]) for key in rapid.when if key in plain)


def change_document(**changes: Any) -> dict[str, Any]:
    return {**OWN, **changes}


@pytest.mark.parametrize(
    ("document", "path"),
    [
        (change_document(interface="profinet"), "interface"),
        (change_document(colour="red"), "colour"),
        (change_document(signals={}), "signals"),
        (change_document(signals={"word": {"at": "ns=2;s=W", "byte": 3}}), "signals.word.byte"),
        (change_document(signals={"word": {"at": "ns=2;s=W", "scale": 0.0}}), "signals.word.scale"),
        (change_document(motion=[]), "motion"),
        (change_document(motion=[{"kind": "fast", "when": {"word": [True]}}]), "motion.0.kind"),
        (change_document(motion=[{"kind": "rapid", "when": {}}]), "motion.0.when"),
        (change_document(motion=[{"kind": "rapid", "when": {"mode": [1]}}]), "motion.1.when.mode"),
        (change_document(motion=[{"kind": "rapid", "when": {"feed_override": [1]}}]), "optional"),
    ],
)
def test_invalid_profile_names_the_key(tmp_path: Path, document: dict[str, Any], path: str) -> None:
    with pytest.raises(ConfigError, match=path) as caught:
        build_nc_profile(document, "own.toml")
    assert "siemens" in str(caught.value)


def test_profile_for_another_interface_is_refused() -> None:
    with pytest.raises(ConfigError, match="is for mtconnect, but is used for opcua"):
        read_nc_profile("mtconnect", "opcua")


@pytest.mark.parametrize(
    ("content", "text"),
    [(None, "cannot be read"), (b"\xff", "not valid TOML"), (b"#" * 300_000, "larger"), (b"a = [", "TOML")],
)
def test_unusable_profile_file_is_reported(tmp_path: Path, content: bytes | None, text: str) -> None:
    path = tmp_path / "own.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=text):
        read_nc_profile(str(path), "opcua")


BLOCKS = [
    ("N10 G0 X1", 10, MoveKind.RAPID),
    ("X2 Y3", 11, MoveKind.RAPID),
    ("G54", 12, MoveKind.RAPID),
    ("g01 x3 f100", 13, MoveKind.FEED),
    ("(G0 in a comment) X4", 14, MoveKind.FEED),
    ("X5", 16, None),  # line 15 was not shown
    ("X6", 17, None),
    ("G03 X1 I1", 18, MoveKind.ARC),
    ("G81 Z-5 R1", 19, None),  # a canned cycle has rapids and feeds
    ("Z1", 20, None),
    ("G00X5", 21, MoveKind.RAPID),
    ("G0.1 X1", 40, None),
    ("G0 X1 G1", 41, None),
]


def test_modal_word_holds_until_a_block_is_skipped() -> None:
    reader = IsoBlocks()
    assert [reader.classify_block(text, line) for text, line, _ in BLOCKS] == [kind for *_, kind in BLOCKS]


THREADING = [  # a lathe's program: what is cut is no rapid
    ("N10 G0 X20 Z5", 10, MoveKind.RAPID),
    ("N11 G33 Z-20 K1.5", 11, None),
    ("N12 Z-25", 12, None),
    ("N13 G1 X30 F200", 13, MoveKind.FEED),
    ("N14 G0 Z5", 14, MoveKind.RAPID),
    ("N15 G32 Z-20 F1.5", 15, None),
    ("N16 G0 X40", 16, MoveKind.RAPID),
]


def test_thread_cutting_ends_a_modal_g0() -> None:
    reader = IsoBlocks()
    assert [reader.classify_block(text, line) for text, line, _ in THREADING] == [kind for *_, kind in THREADING]


@pytest.mark.parametrize(
    "text",
    [
        "G33.1 Z-5 K1", "G34 Z-5 F1 K0.1", "G38.2 Z-5 F100", "G5 X1 Y1 I1 J1 P1 Q1", "G5.1 X1 Y1 I1 J1", "G5.2 X1 Y1",
        "G2.3 X1 Y1", "G6.2 P4 X1", "G12 I5 F100", "G76 P010060", "G76 P1.5 Z-20 I-1 J0.2 K1", "G70 P10",
        "G[#1] X1",
        "G78 X20 Z-10 F1", "G92 X19 Z-20 F1.5", "G90 X18 Z-30 F0.2", "G94 X10 Z-5", "G65 P9000 X1", "G66 P9000",
        "G73 Z-5 R1 Q1 F1", "G80", "G84.2 Z-5 R1 F1", "G187 X1", "G331 Z-5 K1", "CIP X1 Y1 I1=2 J1=3", "CYCLE83(10)",
        "M98 P100", "G0 G33 Z-5", "G45 X1", "G63 Z-5", "G60 X1",
    ],
)  # fmt: skip
def test_any_other_motion_word_ends_a_modal_g0(text: str) -> None:
    reader = IsoBlocks()
    assert reader.classify_block("G0 X1", 1) is MoveKind.RAPID
    assert [reader.classify_block(text, 2), reader.classify_block("X3", 3)] == [None, None]


@pytest.mark.parametrize(
    "text",
    [
        "G17 G21 G40 G49 G54", "G90", "G91 X5", "G90 G0 X5", "G94 F200", "G54.1 P3", "G43 H1",
        "G43.4 H1", "G53 G0 Z0", "G92.1", "G95 S100 M3", "G96 S200", "G4 P1", "G10 L2 P1 X0", "G64 P0.01",
        "G500", "T1 M6",
        "N100", "G61.1", "G99",
    ],
)  # fmt: skip
def test_word_without_motion_keeps_a_modal_g0(text: str) -> None:
    reader = IsoBlocks()
    reader.classify_block("G0 X1", 1)
    reader.classify_block(text, 2)
    assert reader.classify_block("X3", 3) is MoveKind.RAPID


def test_homing_move_is_not_a_rapid_and_keeps_the_modal_g0() -> None:
    reader = IsoBlocks()
    kinds = [
        reader.classify_block(*each)
        for each in (("G0 X1", 1), ("G28 Z0", 2), ("X3", 3), ("G31 Z-5 F100", 4), ("X1", 5))
    ]
    assert kinds == [MoveKind.RAPID, None, MoveKind.RAPID, None, MoveKind.RAPID]


def test_line_number_can_arrive_before_its_block() -> None:
    line_first = [("G0 X1", 5), ("G0 X1", 6), ("X2", 6), ("X2", 8), ("X3", 8), ("G1 X4", 9), ("G1 X4", 11), ("X5", 11)]
    reader = IsoBlocks()
    kinds = [reader.classify_block(text, line) for text, line in line_first]
    assert kinds[:3] == [MoveKind.RAPID] * 3
    assert kinds[3:5] == [None, None]  # the block of line 7 was not shown
    assert kinds[-1] is None
    reader = IsoBlocks()
    assert [reader.classify_block(*each) for each in (("G0 X1", 5), ("X2", 5), ("X2", 8))] == [MoveKind.RAPID] * 2 + [
        None
    ]


def test_without_line_numbers_only_explicit_words_count() -> None:
    reader = IsoBlocks()
    assert [reader.classify_block(text, None) for text in ("G0 X1", "X2", "G1 X3")] == [
        MoveKind.RAPID,
        None,
        MoveKind.FEED,
    ]


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("12 L X+10 Y-5 R0 FMAX M3", MoveKind.RAPID),
        ("L X+10 F500", MoveKind.FEED),
        ("L Z+2 ; not FMAX", MoveKind.FEED),
        ("C X+10 Y+5 DR+", MoveKind.ARC),
        ("CR X+10 Y+5 R+5 DR-", MoveKind.ARC),
        ("CC X+0 Y+0", None),
        ("CYCL DEF 200 DRILLING", None),
        ("CALL LBL 1", None),
        ("TOOL CALL 3 Z S2000", None),
        ("LBL 1", None),
    ],
)
def test_klartext_blocks_are_classified(text: str, kind: MoveKind | None) -> None:
    assert KlartextBlocks().classify_block(text, None) is kind


@given(st.lists(st.tuples(st.text(max_size=20), st.none() | st.integers(0, 5))))
def test_any_block_text_is_classified_without_error(blocks: list[tuple[str, int | None]]) -> None:
    for reader in (IsoBlocks(), KlartextBlocks()):
        for text, line in blocks:
            assert reader.classify_block(text, line) in (None, MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC)


def test_conditions_accept_numbers_and_arrays() -> None:
    assert Condition((0,)).is_met((5, 0))
    assert not Condition((0,)).is_met((5, 10))
    assert Condition(at_least=3.0).is_met("3.5")
    assert not Condition(at_least=3.0).is_met("three")
