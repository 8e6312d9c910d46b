"""Fault scripts of the simulated machine: entries, or a ConfigError that names the fault."""

from __future__ import annotations

import tempfile
from pathlib import Path

from fdhil.errors import ConfigError
from fdhil.sim import fault_script
from fdhil.sim.fault_kinds import FAULTS
from tests.fuzz.input_assessment import Target

_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)


def taste(data: bytes) -> None:
    path = Path(_FOLDER.name) / "faults.toml"
    path.write_bytes(data)
    try:
        fault_script.load_script(path, ("X", "Y"))
    except ConfigError as error:
        assert error.faults
        assert len(str(error)) < 100_000


def target() -> Target:
    seeds = [
        '[[fault]]\nat_s = 2.5\naxis = "X"\nfault = "load_torque"\nvalue = 5.0\nduration_s = 0.3\n',
        '[[fault]]\nat_sync = 100\nfault = "frame"\ncan_id = 0x301\ndata = "11 22"\n'
        '[[fault]]\nat_row = 1\naxis = "Y"\nfault = "object"\nindex = 0x6065\nsub = 0\nvalue = 1\n',
        '# nothing\nfault = [{ fault = "stuck", at_s = 1.0, axis = "X" }]\n',
    ]
    words = [
        name.encode() for name in FAULTS
    ] + b"nan inf true 1979-05-27 {} [[fault]] [fault] at_s at_sync duration_s".split()
    return Target("fault_script", list(map(str.encode, seeds)), taste, words, 800)
