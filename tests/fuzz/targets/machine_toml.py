"""A machine's configuration: read, or a ConfigError with all faults, each with its key."""

from __future__ import annotations

import json

from fdhil import config
from fdhil.errors import ConfigError
from tests.bench import bench_toml
from tests.fuzz.input_assessment import Target

MORE = """[bus.can0]
interface = "socketcand"
port = 29536
[nc]
profile = "fir"
smoothing_s = [0.06, 0.03]
[g0]
source = "inferred"
[web]
port = 8080
[access]
operate = ["root"]
"""


def taste(data: bytes) -> None:
    try:
        read = config.parse_config(config.parse_toml(data, "machine.toml"), "machine.toml")
        config.find_unlikely_values(read)
    except ConfigError as error:
        assert error.faults
        assert len(str(error)) < 100_000
        return
    json.dumps(read.model_dump(mode="json"))


def target() -> Target:
    one = bench_toml("X").encode()
    words = [f'"{name}"'.encode() for name in config.MachineConfig.model_fields]
    words += b"[axis.X.drive] [store] [publish.mqtt] [nc_source] [sim] nan inf -0.0 1e400 true {} [[ ]] '''".split()
    return Target("machine_toml", [one, one + MORE.encode(), MORE.encode()], taste, words, 2500)
