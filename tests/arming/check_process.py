"""Runs the check of a program as a child process: its request, its answer, its imports, and a substitute."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

import pytest

import fdhil
from fdhil.arming.background_check import FOLDER
from fdhil.arming.code_digest import MAKER, find_code_files
from fdhil.config import MachineConfig
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import compute_program_digest


def make_request(program: Path, config: MachineConfig, folder: Path) -> bytes:
    request = {
        "program": str(program),
        "program_digest": compute_program_digest(program),
        "config": config.model_dump(mode="json"),
        "models": {axis: model.as_dict() for axis, model in build_nominal_models(config).items()},
        "folder": str(folder / FOLDER),
        "key": "key",
    }
    return json.dumps(request).encode() + b"\n"


def run_check_process(request: bytes, errors: Path) -> bytes:
    command = [sys.executable, "-X", "importtime", "-m", MAKER]
    with errors.open("wb") as stderr, subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=stderr) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(request)
        process.stdin.flush()
        answer = process.stdout.read()
        assert process.wait() == 0
    message = errors.read_text().splitlines()
    assert [line for line in message if not line.startswith("import time:")] == []
    _assert_covered_by_digest({line.rsplit("|", 1)[1].strip() for line in message})
    return answer


def _assert_covered_by_digest(imported: set[str]) -> None:
    """The digest covers the imports as written; every module that is really imported must be among them."""
    files = find_code_files(Path(fdhil.__file__).parent)
    covered = {name.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for name in files}
    modules = {name.removeprefix("fdhil.") for name in imported if name.startswith("fdhil.")}
    assert modules - covered == set()
    assert len(modules) > 50


def replace_output(monkeypatch: pytest.MonkeyPatch, folder: Path, script: str) -> None:
    python = folder / "python"
    python.write_text(f"#!/bin/sh\n{script}")
    python.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(python))
