#!/usr/bin/env bash
# The asyncua server never reports a slow drift to a client with a deadband, nor a sensor that fails.
#
# Library:  asyncua 2.1.0, Server; the client is asyncua's own, with Subscription.deadband_monitor.
# Expected: OPC UA part 4 (1.05, 7.22.2 DataChangeFilter): an absolute deadband compares the value with the last one
#           that was put into the queue, that is the last one reported. It is ignored when the status changes.
# Seen:     the server compares with the previous sample, reported or not. A temperature that rises from 20 to 30 in
#           steps of 0.25 is never reported with a deadband of 0.5. A change of status inside the deadband is not
#           reported either. A Bad status arrives without a value, the comparison fails inside the server, and the
#           client receives nothing.
# Effect:   a client that watches for drift keeps 20 with status Good, while the value is 30 and its sensor failed.
# Output seen:
#   no deadband:  41 values from 20 to 30, then Uncertain, then BadSensorFailure
#   deadband 0.5: 1 value, 20 with status Good; nothing else
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check asyncua==2.1.0
cd "$folder"

venv/bin/python -I - <<'PYTHON'
import asyncio
import logging
import socket
import sys

from asyncua import Client, Server, ua

logging.disable()
STEPS = [20.25 + 0.25 * step for step in range(40)]


class Recorder:
    """Record value and status of every notification."""

    def __init__(self):
        self.received = []
        self.complete = asyncio.Event()

    def datachange_notification(self, node, value, data):
        self.received.append((value, data.monitored_item.Value.StatusCode.name))
        if self.received[-1][1] == "BadSensorFailure":
            self.complete.set()


def find_free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


async def drift_and_fail(temperature):
    for value in STEPS:
        await temperature.write_value(value)
    for status in (ua.StatusCodes.Uncertain, ua.StatusCodes.BadSensorFailure):
        await temperature.write_value(ua.DataValue(ua.Variant(30.0, ua.VariantType.Double), ua.StatusCode(status)))


async def record(url, temperature):
    async with Client(url) as client:
        node = client.get_node(temperature.nodeid)
        everything, deadband = Recorder(), Recorder()
        await (await client.create_subscription(20, everything)).subscribe_data_change(node, queuesize=100)
        await (await client.create_subscription(20, deadband)).deadband_monitor(node, 0.5, queuesize=100)
        await drift_and_fail(temperature)
        await asyncio.wait_for(everything.complete.wait(), 30)
        await asyncio.sleep(1)
        return everything.received, deadband.received


async def main():
    url = f"opc.tcp://127.0.0.1:{find_free_port()}/"
    server = Server()
    await server.init()
    server.set_endpoint(url)
    temperature = await server.nodes.objects.add_variable(2, "temperature", 20.0)
    async with server:
        return await record(url, temperature)


everything, deadband = asyncio.run(main())
good = [value for value, status in everything if status == "Good"]
others = ", then ".join(status for _, status in everything[len(good) :])
print(f"no deadband:  {len(good)} values from {good[0]:.0f} to {good[-1]:.0f}, then {others}")
print(f"deadband 0.5: {len(deadband)} value, {deadband[0][0]:.0f} with status {deadband[0][1]}; nothing else")
if good != [20.0, *STEPS] or others != "Uncertain, then BadSensorFailure":
    sys.exit("Changed: the server no longer reports every change to a client without a deadband.")
if deadband != [(20.0, "Good")]:
    sys.exit("Changed: the server now reports the drift or the status to a client with a deadband.")
PYTHON
