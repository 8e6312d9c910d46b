"""Commissioning of the on-line feed-forward: its RPDO is exchanged only by a drive that was set up for it."""

from __future__ import annotations

from fdhil.cia402 import Object
from fdhil.drivers.commissioning_master import Master
from fdhil.errors import DriveFault

INVALID_COB_ID = 0x80000000


def feedforward_object(number: int) -> str:
    """Return the key under which a commissioning record keeps the RPDO's COB-ID: its parameter's index."""
    return f"{Object.RPDO_PARAMETER + number - 1:04X}"


def open_feedforward(master: Master) -> dict[str, int]:
    """Set both offsets to 0 and make their RPDO valid, the axis disabled; {} without [axis.X.feedforward].

    Returns what goes into the record: the COB-ID that was read back. DriveFault when the drive does not map them.
    """
    if master.config.axis[master.axis].feedforward is None:
        return {}
    found = master.profile.find_rpdo(master.profile.speed_offset)
    if found is None or found[0].entry(master.profile.torque_offset) is None:
        text = "its profile has no RPDO with 60B1 and 60B2; leave [axis.X.feedforward] out"
        raise DriveFault(master.device, text)
    spec = found[0]
    for key in (master.profile.speed_offset, master.profile.torque_offset):
        entry = spec.entry(key)
        assert entry is not None
        master.sdo.write_int(*key, 0, entry.bits // 8)
    parameter = Object.RPDO_PARAMETER + spec.number - 1
    wanted = master.sdo.read_int(parameter, 1) & ~INVALID_COB_ID
    master.sdo.write_int(parameter, 1, wanted, 4)
    cob_id = master.sdo.read_int(parameter, 1)
    if cob_id != wanted:
        text = f"the RPDO of 60B1 and 60B2 stays at {cob_id:08X}; write 0x{parameter:04X}:01 with its own tool"
        raise DriveFault(master.device, text)
    return {feedforward_object(spec.number): cob_id}
