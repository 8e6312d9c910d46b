"""A long program is checked as a whole before it is armed: only checked rows are sent, refusals are named."""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fdhil
from fdhil import correction
from fdhil.arming.arm_plan import ArmRequest, prepare_program, prepare_request
from fdhil.arming.background_check import FOLDER, BackgroundCheck
from fdhil.arming.checked_program import CheckedProgram, RowStream, TablePiece
from fdhil.arming.code_digest import compute_code_digest
from fdhil.arming.program_check import KEPT, SCHEMA, answer_request, check_program, encode_rows, store_checked
from fdhil.config import MachineConfig
from fdhil.errors import ProgramError, StoreError
from fdhil.prediction.axis_models import apply_loops, build_nominal_models
from fdhil.program import compute_program_digest, load_trajectory
from fdhil.records import Reason
from tests.arming.check_process import make_request, replace_output, run_check_process
from tests.arming.test_arm_plan import make_model_states, save_records
from tests.daemon.simulated_machine import config_of

SQUARE = "G1 X40 F6000\nG1 Y30\nG1 X0\nG1 Y0\n"
HEAD = "G21 G90 G94\nG4 P0.5\n"
LONG = HEAD + SQUARE * 10 + "G4 P0.3\nM2\n"
HARD_LINES = (15, 24)  # in the third square and in the fifth


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    return config_of(tmp_path, ("X", "Y"))


def write_program(folder: Path, text: str) -> Path:
    path = folder / "program.ngc"
    path.write_text(text)
    return path


def run_check(program: Path, config: MachineConfig) -> tuple[dict[str, Any], bytes, list[Any]]:
    body, reported = io.BytesIO(), list[Any]()
    header = check_program(
        program, compute_program_digest(program), build_nominal_models(config), config, body, reported.append
    )
    return header, body.getvalue(), reported


@pytest.mark.usefixtures("long_computation")
def test_checked_rows_equal_whole_plan(config: MachineConfig, tmp_path: Path) -> None:
    program = write_program(tmp_path, LONG)
    header, body, reported = run_check(program, config)
    planned = correction.plan_correction(
        load_trajectory(program, config), build_nominal_models(config), config, "inverse"
    )
    assert body == encode_rows(planned.before.reference.position_mm, planned.offset_um, config)
    rows = np.frombuffer(body, "<i4").reshape(-1, 4)
    assert header["refused"] == []
    assert header["rows"] == len(rows)
    assert header["before"]["rms_um"] == pytest.approx(np.sqrt(np.mean(planned.before.contour_um**2)))
    assert header["after"]["max_um"] == pytest.approx(planned.after.contour_um.max(), abs=1e-6)
    progress = next(one["progress"] for one in reported if "progress" in one)
    assert progress.keys() == {"checked_s", "line", "times_real_time", "refused"}
    blocks = [one for one in reported if "block" in one]
    assert [one["block"] for one in blocks] == header["blocks"]
    assert [one["last"] for one in blocks] == [False] * (len(blocks) - 1) + [True]
    assert blocks[-1]["errors"] == {"before": header["before"], "after": header["after"]}
    first = 0
    for end, sha256 in header["blocks"]:
        assert hashlib.sha256(rows[first:end].tobytes()).hexdigest() == sha256
        first = end
    assert first == header["rows"]


def test_block_is_written_before_it_is_reported(config: MachineConfig, tmp_path: Path) -> None:
    file, program, seen = tmp_path / "rows", write_program(tmp_path, LONG), 0

    def look(told: Mapping[str, Any]) -> None:
        nonlocal seen
        if "block" in told:
            end, sha256 = told["block"]
            content = file.read_bytes()
            assert len(content) == 16 * end
            assert hashlib.sha256(content[16 * seen :]).hexdigest() == sha256
            seen = end

    with file.open("wb") as body:
        check_program(program, compute_program_digest(program), build_nominal_models(config), config, body, look)
    assert seen > 15_000


def write_hard_program() -> str:
    lines = LONG.splitlines()
    for number in HARD_LINES:
        lines[number - 1] = lines[number - 1].split(" F")[0] + " F30000"
        lines[number] += " F6000"
    return "\n".join(lines) + "\n"


@pytest.mark.usefixtures("long_computation")
def test_every_refusal_names_line_axis_figure_and_advice(config: MachineConfig, tmp_path: Path) -> None:
    sharp = config.model_copy(update={"nc": config.nc.model_copy(update={"smoothing_s": (0.02, 0.01)})})
    header, body, at_once = run_check(write_program(tmp_path, write_hard_program()), sharp)
    assert [one["refused"] for one in at_once if "refused" in one] == header["refused"]
    assert len(body) == 16 * header["blocks"][-1][0] < 16 * header["rows"]  # no row from the first place on
    demand = [told for told in header["refused"] if told["code"] == "DemandTooHigh"]
    reported = " | ".join(reason["text"] for reason in demand)
    for number in HARD_LINES:
        assert f"line {number}," in reported or f"line {number + 1}," in reported, reported
    assert all(re.search(r"axis [XY] is at", one["text"]) for one in demand)
    assert all(" ms: no offset can help" in one["text"] and one["advice"] for one in demand)


def test_program_without_error_is_refused(config: MachineConfig, tmp_path: Path) -> None:
    header, _, _ = run_check(write_program(tmp_path, "G4 P12\nM2\n"), config)
    assert [told["code"] for told in header["refused"]] == ["NoGain"]


@pytest.mark.usefixtures("processes")
def test_checked_program_is_armed_and_streamed(config: MachineConfig, tmp_path: Path) -> None:
    program = write_program(tmp_path, LONG)
    save_records(config)
    found = prepare_request(program, None, config, make_model_states(config))
    assert isinstance(found, ArmRequest)
    assert found.ahead
    first, again = asyncio.run(_check_twice(config, found))
    assert isinstance(first, CheckedProgram)
    assert isinstance(again, CheckedProgram)
    armament = prepare_program(found, first, config, make_model_states(config))
    assert all(armament.facts.values()), armament.facts
    assert armament.stream.program_digest == compute_program_digest(program)
    stream, pieces = armament.stream, [armament.first_piece]
    assert len(pieces[0].demand["X"]) == 10_000
    assert first.is_complete
    assert stream.has_too_few_rows({"rows": [0, 10_000], "row": 1})
    assert not stream.has_too_few_rows({"rows": [0, 10_000], "row": 0})
    while stream.has_block:
        pieces.append(stream.take_rows())
    assert [piece.final for piece in pieces] == [False] * (len(pieces) - 1) + [True]
    assert [piece.first for piece in pieces[1:]] == [block.end for block in first.blocks[4:-1]]
    (file,) = (config.store.directory / FOLDER).glob("*.rows")
    body = np.frombuffer(file.read_bytes(), "<i4").reshape(-1, 4)
    assert np.array_equal(np.concatenate([piece.offset["Y"] for piece in pieces]), body[:, 3])
    assert not stream.has_too_few_rows({"rows": [0, 10_000], "row": 9_999})


def read_all_rows(_checked: CheckedProgram) -> bool:
    return False


async def _check_twice(config: MachineConfig, found: ArmRequest) -> list[CheckedProgram | tuple[Reason, ...]]:
    check, received = BackgroundCheck(config), list[Mapping[str, Any]]()

    async def count_messages() -> None:
        while True:
            if check.progress is not None:
                received.append(check.progress)
            await asyncio.sleep(0.01)

    listening = asyncio.create_task(count_messages())
    first = await check.check_until(found.program, found.program_digest, found.models, read_all_rows)
    before = len(received)
    again = await check.check_until(found.program, found.program_digest, found.models, read_all_rows)
    listening.cancel()
    assert received[-1]["program"] == str(found.program)
    assert len(received) == before
    return [first, again]


@pytest.mark.usefixtures("processes")
async def test_abandoned_check_is_reported_and_leaves_no_files(config: MachineConfig, tmp_path: Path) -> None:
    program = write_program(tmp_path, HEAD + SQUARE * 2000 + "M2\n")
    check = BackgroundCheck(config)
    running = asyncio.create_task(
        check.check_until(program, compute_program_digest(program), build_nominal_models(config), read_all_rows)
    )
    async with asyncio.timeout(500):
        while not (check.progress or {}).get("checked_s"):  # noqa: ASYNC110 - what another process says has no event
            await asyncio.sleep(0.05)
    assert check.abandon()
    refused = await running
    assert isinstance(refused, tuple)
    assert refused[0].code == "Abandoned"
    assert check.progress is None
    assert not check.abandon()
    assert not list((config.store.directory / FOLDER).glob("*.json"))


CALLS = HEAD + "O<square> CALL\n" * 3 + "G4 P0.3\nM2\n"
BESIDE = "O<square> SUB\n" + SQUARE + "O<square> ENDSUB\n"


@pytest.mark.usefixtures("processes")
async def test_subroutine_in_program_folder_is_part_of_check(config: MachineConfig, tmp_path: Path) -> None:
    adjacent = tmp_path / "square.ngc"
    adjacent.write_text(BESIDE)
    program = write_program(tmp_path, CALLS)
    digest, models = compute_program_digest(program), build_nominal_models(config)
    folder, key = config.store.directory / FOLDER, BackgroundCheck(config)._make_key(digest, models, config)
    header = store_checked(
        folder, key, lambda body: check_program(program, digest, models, config, body, lambda _told: None)
    )
    assert header["files"] == {"square.ngc": compute_program_digest(adjacent)}
    first = await BackgroundCheck(config).check_until(program, digest, models, read_all_rows)
    assert isinstance(first, CheckedProgram)
    assert [list(block[:2]) for block in first.blocks] == header["blocks"]  # it is known
    (file,) = folder.glob("*.rows")
    assert CheckedProgram.find_checked(file.parent, file.stem, tmp_path) is not None
    adjacent.write_text(BESIDE.replace("X40", "X41"))
    assert CheckedProgram.find_checked(file.parent, file.stem, tmp_path) is None
    again = await BackgroundCheck(config).check_until(program, digest, models, read_all_rows)
    assert isinstance(again, CheckedProgram)
    assert again.blocks != first.blocks
    assert again.header is not None
    assert again.header["files"] == {"square.ngc": compute_program_digest(adjacent)}
    adjacent.unlink()
    assert CheckedProgram.find_checked(file.parent, file.stem, tmp_path) is None


@pytest.mark.parametrize("which", ["program.ngc", "square.ngc"])
def test_file_changed_during_check_is_refused(which: str, config: MachineConfig, tmp_path: Path) -> None:
    """Its rows would otherwise be stored under the digest of the old content."""
    (tmp_path / "square.ngc").write_text(BESIDE)
    program = write_program(tmp_path, CALLS)

    def change(_told: Mapping[str, Any]) -> None:
        with (tmp_path / which).open("a") as file:
            file.write("(another)\n")

    with pytest.raises(ProgramError, match=f"{which} was modified while it was checked"):
        check_program(
            program, compute_program_digest(program), build_nominal_models(config), config, io.BytesIO(), change
        )


@pytest.mark.usefixtures("processes")
async def test_process_death_within_a_line_is_reported(
    config: MachineConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = write_program(tmp_path, LONG)
    replace_output(monkeypatch, tmp_path, 'read line\nprintf \'{"header": {"ref\'\nexit 9\n')
    refused = await BackgroundCheck(config).check_until(
        program, compute_program_digest(program), build_nominal_models(config), read_all_rows
    )
    assert isinstance(refused, tuple)
    assert (refused[0].code, "exit code 9" in refused[0].text) == ("InternalError", True)


@pytest.mark.usefixtures("processes")
async def test_process_that_cannot_start_is_reported(
    config: MachineConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, check = write_program(tmp_path, LONG), BackgroundCheck(config)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "absent"))
    refused = await check.check_until(
        program, compute_program_digest(program), build_nominal_models(config), read_all_rows
    )
    assert isinstance(refused, tuple)
    assert refused[0].text == "the check cannot be started (No such file or directory)"
    await check.raise_failure()  # it is no fault of the daemon


@pytest.mark.usefixtures("processes")
async def test_faulty_program_is_refused_with_its_line(
    config: MachineConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = write_program(tmp_path, HEAD + SQUARE * 10 + "G1 X[1/0]\nM2\n")
    answer = run_check_process(make_request(program, config, tmp_path), tmp_path / "stderr")
    assert json.loads(answer.splitlines()[-1])["error"]["code"] == "ProgramError"
    (tmp_path / "answer").write_bytes(answer)
    replace_output(monkeypatch, tmp_path, f"read line\nexec cat '{tmp_path / 'answer'}'\n")
    refused = await BackgroundCheck(config).check_until(
        program, compute_program_digest(program), build_nominal_models(config), read_all_rows
    )
    assert isinstance(refused, tuple)
    assert refused[0].code == "ProgramError"
    assert "43" in refused[0].text


@pytest.mark.usefixtures("processes")
def test_check_process_ends_with_daemon(config: MachineConfig, tmp_path: Path) -> None:
    program = write_program(tmp_path, HEAD + SQUARE * 5000 + "M2\n")
    command = [sys.executable, "-m", "fdhil.arming.program_check"]
    done = subprocess.run(command, input=make_request(program, config, tmp_path), capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (1, b"")
    assert b"header" not in done.stdout


def make_checked(folder: Path, key: str) -> Path:
    code = compute_code_digest()

    def write_rows(body: Any) -> dict[str, Any]:
        content = np.arange(32, dtype="<i4").tobytes()
        body.write(content)
        blocks = [[end, hashlib.sha256(content[16 * (end - 4) : 16 * end]).hexdigest()] for end in (4, 8)]
        errors = {which: {"rms_um": rms, "max_um": 3.0} for which, rms in (("before", 2.0), ("after", 0.5))}
        of = {"schema": SCHEMA, "code": code, "files": {}, "axes": ["X", "Y"], "rows": 8, "blocks": blocks}
        return {**of, **errors, "refused": [], "largest_um": 1.0}

    store_checked(folder, key, write_rows)
    return folder / f"{key}.rows"


def test_damaged_check_result_is_not_used(tmp_path: Path) -> None:
    file = make_checked(tmp_path, "a")
    found = CheckedProgram.find_checked(tmp_path, "a", tmp_path)
    assert found is not None
    assert (found.is_complete, found.row_count, found.gain_um) == (True, 8, 1.5)
    assert CheckedProgram.find_checked(tmp_path, "b", tmp_path) is None
    stream = RowStream(found, "digest", 0.001)
    content = bytearray(file.read_bytes())
    content[70] ^= 1
    file.write_bytes(content)
    assert CheckedProgram.find_checked(tmp_path, "a", tmp_path) is None
    assert stream.take_rows() == TablePiece(
        0, {"X": [0, 4, 8, 12], "Y": [1, 5, 9, 13]}, {"X": [2, 6, 10, 14], "Y": [3, 7, 11, 15]}, False
    )
    with pytest.raises(StoreError, match="damaged"):
        stream.take_rows()
    file.write_bytes(content[:40])
    with pytest.raises(StoreError, match="damaged"):
        RowStream(found, "digest", 0.001).take_rows()
    assert CheckedProgram.find_checked(tmp_path, "a", tmp_path) is None
    file.unlink()
    assert CheckedProgram.find_checked(tmp_path, "a", tmp_path) is None


def test_armed_rows_survive_removal_of_file(tmp_path: Path) -> None:
    file = make_checked(tmp_path, "a")
    found = CheckedProgram.find_checked(tmp_path, "a", tmp_path)
    assert found is not None
    file.unlink()
    assert RowStream(found, "digest", 0.001).take_rows(1.0).final


def test_result_of_other_code_is_checked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_checked(tmp_path, "a")
    home = tmp_path / "fdhil"
    shutil.copytree(Path(fdhil.__file__).parent, home, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(fdhil, "__file__", str(home / "__init__.py"))
    assert CheckedProgram.find_checked(tmp_path, "a", tmp_path) is not None
    (home / "guard" / "guard_step.py").write_text("")  # makes no row
    assert CheckedProgram.find_checked(tmp_path, "a", tmp_path) is not None
    with (home / "program" / "planner" / "smoothing.py").open("a") as file:
        file.write("# otherwise\n")
    assert CheckedProgram.find_checked(tmp_path, "a", tmp_path) is None


def test_refused_program_is_not_stored_and_old_ones_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".left.part").write_bytes(b"half")
    refused: dict[str, Any] = {"refused": [{"code": "NoGain", "text": "", "advice": ""}]}
    assert store_checked(tmp_path, "no", lambda body: refused if body.write(b"rows") else {}) == refused
    assert list(tmp_path.iterdir()) == []
    for number in range(KEPT + 2):
        file = make_checked(tmp_path, f"k{number}")
        for path in (file, file.with_suffix(".json")):
            os.utime(path, (number, number))
    make_checked(tmp_path, "newest")
    names = {path.stem for path in tmp_path.glob("*.json")}
    assert names == {"newest", *(f"k{n}" for n in range(3, KEPT + 2))}
    assert {path.stem for path in tmp_path.glob("*.rows")} == names
    assert all(json.loads(path.read_bytes())["rows"] == 8 for path in tmp_path.glob("*.json"))


def test_store_error_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StoreError):
        make_checked(tmp_path / "file" / "folder", "a")


def test_other_terms_or_loops_need_another_check(config: MachineConfig, tmp_path: Path) -> None:
    program = write_program(tmp_path, HEAD + SQUARE + "G4 P0.3\nM2\n")
    digest, six = compute_program_digest(program), build_nominal_models(config)
    rich = {axis: model.replace_values(stribeck=2.0, stribeck_speed=10.0) for axis, model in six.items()}
    filtered = apply_loops(config, {axis: {"speed_filter_s": 5e-4} for axis in config.axis}, "test")
    background, bodies = BackgroundCheck(config), dict[str, bytes]()
    for models, machine in ((six, config), (rich, config), (six, filtered)):
        key = background._make_key(digest, models, machine)
        request = json.dumps(background._make_request(program, digest, models, key, machine))
        answer_request(json.loads(request), lambda _told: None)
        found = CheckedProgram.find_checked(config.store.directory / FOLDER, key, tmp_path)
        assert found is not None
        bodies[key] = b"".join(found.read_block(k) for k in range(len(found.blocks)))
    assert len(set(bodies.values())) == len(bodies) == 3
