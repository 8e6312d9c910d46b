#!/usr/bin/env bash
# A host of mqtt-spb-wrapper ignores the data of other Sparkplug nodes, and that a value became null.
#
# Library:  mqtt-spb-wrapper 2.1.2, the receiving side; the messages are those of pysparkplug 0.3.2 and of its own
#           protobuf classes.
# Expected: Sparkplug 3.0, 6.4: names and data types are given in the birth certificate; a data message SHOULD NOT contain
#           the data type, and may contain an alias in the place of the name. A metric with is_null has no value.
# Seen:     a metric without a data type is skipped, by name as well as by alias: all values stay as they were at birth.
#           A null is skipped too, and the value before stays. There is no message about either.
# Effect:   an axis reports 1.5 mm for ever while it moves, and a sensor that failed reports its last value as valid.
#           Nodes of the library itself repeat the data type in each message and are not affected.
# Output seen:
#   birth:                 position 1.5, temperature 20.0
#   data by alias:         position 1.5
#   data by name:          temperature 20.0
#   the same, with a type: temperature 21.0
#   null:                  temperature 21.0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check mqtt-spb-wrapper==2.1.2 pysparkplug==0.3.2
cd "$folder"

venv/bin/python -I -W ignore - <<'PYTHON'
import sys

import pysparkplug
from mqtt_spb_wrapper.spb_base import SpbEntity
from mqtt_spb_wrapper.spb_protobuf.sparkplug_b_pb2 import Payload

DOUBLE = pysparkplug.DataType.DOUBLE


def metric(name, value, alias=None):
    return pysparkplug.Metric(timestamp=1, name=name, datatype=DOUBLE, value=value, alias=alias)


def data(*metrics):
    return pysparkplug.DData(timestamp=2, seq=2, metrics=metrics).encode()


def typed(**fields):
    payload = Payload(timestamp=3, seq=3)
    payload.metrics.add(name="temperature", timestamp=3, datatype=DOUBLE.value, **fields)
    return payload.SerializeToString()


host = SpbEntity("works", "mill", "X")
births = (metric("DATA/position", 1.5, alias=7), metric("DATA/temperature", 20.0))
host.deserialize_payload_birth(pysparkplug.DBirth(timestamp=1, seq=1, metrics=births).encode())
seen = [host.data.get_value("position"), host.data.get_value("temperature")]
print(f"birth:                 position {seen[0]}, temperature {seen[1]}")
cases = [
    ("data by alias:", data(metric(None, 2.5, alias=7)), "position"),
    ("data by name:", data(metric("temperature", 21.0)), "temperature"),
    ("the same, with a type:", typed(double_value=21.0), "temperature"),
    ("null:", typed(is_null=True), "temperature"),
]
for case, message, name in cases:
    host.deserialize_payload_data(message)
    seen.append(host.data.get_value(name))
    print(f"{case:22} {name} {seen[-1]}")
if seen != [1.5, 20.0, 1.5, 20.0, 21.0, 21.0]:
    sys.exit("Changed: the host now takes data without a data type, or a null.")
PYTHON
