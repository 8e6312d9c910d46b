"""Files outside the store: damage or hostile content causes a declared error, never wrong values."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import pytest

from fdhil.arming.checked_program import CheckedProgram
from fdhil.arming.code_digest import compute_code_digest
from fdhil.arming.operator_token import TOKEN_NAME, ensure_token, read_token
from fdhil.arming.program_check import HEADER, SCHEMA, store_checked
from fdhil.config import Nc
from fdhil.errors import ConfigError, FdhilError, ProgramError
from fdhil.guard.guard_settings import encode_settings, load_settings
from fdhil.prediction.axis_models import load_model_file
from fdhil.program import Budget, interpret
from fdhil.sim import fault_script
from tests.guard.simulated_bus import settings

HOSTILE = {
    "deep": "[" * 200_000,
    "deep objects": '{"a":' * 100_000,
    "digits": '{"X": {"R": ' + "9" * 5000 + "}}",
    "large": '{"X": {"R": 1e999}}',
    "endless text": '{"' + "x" * 3_000_000 + '": 1}',
    "surrogate": '{"\\ud800": "\\udfff"}',
    "nothing": "",
    "no object": "3",
}


def flip_bits(whole: bytes, most: int, seed: int) -> Iterator[bytes]:
    """Return the content with single flipped bits at positions all over it."""
    rng = random.Random(seed)
    for byte in range(0, len(whole), max(1, len(whole) // most)):
        flipped = bytearray(whole)
        flipped[byte] ^= 1 << rng.randrange(8)
        yield bytes(flipped)


@pytest.mark.usefixtures("real_time")
def test_guard_settings_with_flipped_bit_are_refused(tmp_path: Path) -> None:
    path, true = tmp_path / "guard.json", settings()
    path.write_text(encode_settings(true))
    assert load_settings(path) == true
    for flipped in flip_bits(path.read_bytes(), 300, 1):
        path.write_bytes(flipped)
        with pytest.raises(ConfigError, match=r"run fdhil-guard|let fdhil-guard write it"):
            load_settings(path)


@pytest.mark.parametrize("read", [load_settings, load_model_file])
@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_hostile_document_is_a_config_error(text: str, read: Callable[[Path], object], tmp_path: Path) -> None:
    """The guard's settings and a model file: any content gives one sentence of bounded length."""
    path = tmp_path / "document.json"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read(path)
    assert len(str(caught.value)) < 2000


def test_model_file_with_flipped_bit_is_valid_or_config_error(tmp_path: Path) -> None:
    """It is written by hand and has no digest; its values are checked all the same."""
    path = tmp_path / "model.json"
    values = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}
    refused = 0
    for flipped in flip_bits(json.dumps({"X": values, "Y": values}).encode(), 1000, 2):
        path.write_bytes(flipped)
        try:
            models = load_model_file(path).parameters
        except ConfigError:
            refused += 1
            continue
        assert all(1e-12 <= value <= 1e12 for model in models.values() for value in model.as_dict().values())
    assert refused > 50


def test_token_with_flipped_bit_is_refused_without_traceback(tmp_path: Path) -> None:
    true = ensure_token(tmp_path)
    path = tmp_path / TOKEN_NAME
    for flipped in flip_bits(path.read_bytes(), 64, 3):
        path.write_bytes(flipped)
        assert read_token(tmp_path) != true
    path.write_bytes(b"\xff" * 100_000)
    assert len(read_token(tmp_path)) <= 256


@pytest.mark.usefixtures("long_computation")
def test_program_check_with_flipped_bit_is_repeated(tmp_path: Path) -> None:
    """The guard's rows and their attestation."""
    rows = bytes(range(256)) * 16
    errors = {"before": {"rms_um": 1.0, "max_um": 2.0}, "after": {"rms_um": 0.1, "max_um": 0.2}}
    blocks = [[512, hashlib.sha256(rows).hexdigest()]]
    header = {"schema": SCHEMA, "axes": ["X"], "code": compute_code_digest(), "blocks": blocks, "files": {},
              "rows": 512, "largest_um": 3.0, "refused": [], **errors}  # fmt: skip

    def write_check(body: BinaryIO) -> dict[str, object]:
        body.write(rows)
        return header

    store_checked(tmp_path, "key", write_check)
    found = CheckedProgram.find_checked(tmp_path, "key", tmp_path)
    assert found is not None
    assert (found.row_count, found.errors) == (512, errors)
    for file, most in ((f"key{HEADER}", 400), ("key.rows", 40)):
        path = tmp_path / file
        whole = path.read_bytes()
        for flipped in flip_bits(whole, most, 4):
            path.write_bytes(flipped)
            assert CheckedProgram.find_checked(tmp_path, "key", tmp_path) is None
        path.write_bytes(whole)


@pytest.mark.parametrize(
    "line",
    ["G1 X" + "9" * 5000, "G" + "9" * 5000, "#" + "9" * 5000 + "=1", "G1 X[" + "9" * 5000 + "]",
     "N" + "9" * 5000 + " G0",
     "M98 P" + "9" * 5000, "O" + "9" * 5000 + " sub", "G10 L2 P" + "9" * 200, "G4 P1e308", "#1=" + "[" * 5000,
     "G1 X#" + "#" * 3000 + "1"],
    ids=lambda line: line[:10],
)  # fmt: skip
def test_huge_number_in_program_is_a_program_error(line: str) -> None:
    try:
        list(interpret([line, "M2"], Budget.create_from_config(Nc())))
    except ProgramError as error:
        reported = str(error)
    else:
        reported = ""  # a line number of any length means nothing
        assert line[0] == "N"
    assert len(reported) < 300


@pytest.mark.parametrize("text", ["a = " + "[" * 100_000, "a = " + "9" * 5000, "a = 0x" + "f" * 5000])
def test_hostile_fault_script_is_a_config_error(text: str, tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(text)
    with pytest.raises(FdhilError):
        fault_script.load_script(path, ("X",))
