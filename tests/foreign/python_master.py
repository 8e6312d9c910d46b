"""A CANopen master made with the canopen library: a process of its own without any code of fdhil."""

from __future__ import annotations

import json
import struct
import sys
import threading
from typing import Any

import canopen

TOWARD = ((0x4F, 0x40, 0x06), (0x6F, 0x21, 0x07), (0x6F, 0x23, 0x0F), (0x6F, 0x27, 0x0F))  # CiA 402-2, 6.3


def print_event(event: str, **more: Any) -> None:
    """Write one event."""
    print(json.dumps({"event": event, **more}), flush=True)  # noqa: T201


def main() -> None:
    """Run until standard input ends."""
    settings = json.loads(sys.argv[1])
    node, period_s = settings["node"], settings["period_ms"] / 1e3
    network: Any = canopen.Network()
    network.connect(**settings["bus"])
    dictionary: Any = canopen.ObjectDictionary
    drive: Any = canopen.RemoteNode(node, dictionary())
    network.add_node(drive)
    drive.sdo.RESPONSE_TIMEOUT = 60.0
    device_type = int.from_bytes(drive.sdo.upload(0x1000, 0), "little")
    print_event("identity", device_type=device_type, name=drive.sdo.upload(0x1008, 0).decode())
    drive.sdo.download(0x6060, 0, bytes([8]))
    position = int.from_bytes(drive.sdo.upload(0x6064, 0), "little", signed=True)
    words = {"status": 0, "control": 0}
    answered = threading.Event()

    def status(_can_id: int, data: bytearray, _stamp: float) -> None:
        words["status"] = int.from_bytes(data[:2], "little")
        answered.set()

    network.subscribe(0x280 + node, status)
    drive.nmt.send_command(1)
    ended, reported = threading.Event(), False

    def until_input_ends() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=until_input_ends, daemon=True).start()
    while not ended.wait(period_s):
        answered.clear()
        network.sync.transmit()
        for mask, value, word in TOWARD:
            if words["status"] & mask == value:
                words["control"] = word
        network.send_message(0x200 + node, struct.pack("<Hi", words["control"], position))
        if not reported and words["status"] & 0x6F == 0x27:
            reported = True
            print_event("enabled", statusword=words["status"], position=position)
        while not (answered.wait(period_s) or ended.is_set()):
            pass
    network.disconnect()


if __name__ == "__main__":
    main()
