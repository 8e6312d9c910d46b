"""Commission the online feed-forward: its RPDO is enabled only on a drive that applies it as intended.

Every refusal is a DriveFault that begins with ``FeedforwardOff``, the class under which arming would be refused.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from fdhil.cia402 import Object
from fdhil.commissioning.drive_survey import read_pdos
from fdhil.commissioning.master import Master
from fdhil.drivers import PdoSpec
from fdhil.errors import DeviceError, DriveFault, ProtocolError, SdoAbort

INVALID_COB_ID = 0x80000000
PROBE = (0x0102, 3)  # increments/s and 0.1 %: negligible, with bytes that reveal a misplaced entry
ARRIVED_CYCLES = 20


def format_rpdo_key(number: int) -> str:
    """Return the key of the RPDO's COB-ID in a commissioning record: the index of its communication parameter."""
    return f"{Object.RPDO_PARAMETER + number - 1:04X}"


@contextmanager
def enable_feedforward_rpdo(master: Master) -> Iterator[dict[str, int]]:
    """Set both offsets to 0 and enable their RPDO while the axis is disabled; restore it if the following steps fail.

    Yields the COB-ID read back, for the record; {} without [axis.X.feedforward]. DriveFault if the drive maps the
    offsets differently or refuses.
    """
    if master.config.axis[master.axis].feedforward is None:
        yield {}
        return
    spec = _find_feedforward_rpdo(master)
    parameter = Object.RPDO_PARAMETER + spec.number - 1
    try:
        before = master.sdo.read_int(parameter, 1)
        cob_id = _make_rpdo_valid(master, spec, before)
    except SdoAbort as abort:
        raise _build_refusal(master, f"it refuses the RPDO of 60B1 and 60B2 ({abort})") from None
    try:
        yield {format_rpdo_key(spec.number): cob_id}
    except BaseException as error:  # Ctrl-C, too: without a sign-off the RPDO is disabled again
        try:
            master.sdo.write_int(parameter, 1, before, 4)
            _write_zeros(master, spec)
        except DeviceError as left:
            cause = str(error).removeprefix(f"{master.device}: ") or "it was interrupted"
            text = f"{cause}; 60B1, 60B2 or their RPDO stay as they are ({left}); power the drive off and on again"
            raise ProtocolError(master.device, text) from error
        raise


def _find_feedforward_rpdo(master: Master) -> PdoSpec:
    """The drive's mapping must match the profile before anything is written."""
    found = master.profile.find_rpdo(master.profile.speed_offset)
    if found is None or found[0].find_entry(master.profile.torque_offset) is None:
        raise _build_refusal(master, "its profile has no RPDO with 60B1 and 60B2")
    spec = found[0]
    mapped = next(pdo.mapped for one, pdo in read_pdos(master) if one is spec)
    if mapped != tuple(entry.mapping for entry in spec.entries):
        shown = ", ".join(f"{value:08X}" for value in mapped) or "nothing"
        raise _build_refusal(master, f"its {spec.name} maps {shown} instead of 60B1 and 60B2")
    return spec


def _make_rpdo_valid(master: Master, spec: PdoSpec, before: int) -> int:
    _write_zeros(master, spec)
    parameter, wanted = Object.RPDO_PARAMETER + spec.number - 1, before & ~INVALID_COB_ID
    master.sdo.write_int(parameter, 1, wanted, 4)
    cob_id = master.sdo.read_int(parameter, 1)
    if cob_id != wanted:
        raise _build_refusal(master, f"the RPDO of 60B1 and 60B2 stays at {cob_id:08X}")
    return cob_id


def _write_zeros(master: Master, spec: PdoSpec) -> None:
    for entry in spec.entries:
        master.sdo.write_int(entry.index, entry.sub, 0, entry.bits // 8)


def _build_refusal(master: Master, cause: str) -> DriveFault:
    advice = f"set up the RPDO with the drive's own tool, or remove [axis.{master.axis}.feedforward]"
    return DriveFault(master.device, f"FeedforwardOff: {cause}; {advice}")


def prove_feedforward(master: Master) -> None:
    """Send both offsets while the axis is disabled and read them back by SDO, then the same with zeros.

    Their effect is not tested: the drive's control loops are off. DriveFault if another value arrives.
    """
    if master.config.axis[master.axis].feedforward is None:
        return
    keys = (master.profile.speed_offset, master.profile.torque_offset)
    try:
        for pair in (PROBE, (0, 0)):
            master.feedforward_offsets = pair
            master.wait_cycles(ARRIVED_CYCLES)
            speed, torque = (master.sdo.read_int(*key, signed=True) for key in keys)
            if (speed, torque) != pair:
                raise _build_refusal(
                    master, f"it was sent {pair} as speed and torque offset and holds ({speed}, {torque})"
                )
    finally:
        master.feedforward_offsets = (0, 0)
        master.wait_cycles(ARRIVED_CYCLES)
        master.feedforward_offsets = None
