"""Set up a drive's PDOs according to its profile by SDO, while no NC runs the bus; nothing moves.

The order follows CiA 301, 7.5.2.36 and 7.5.2.38: the PDO is made invalid, its mapping is cleared, written and counted,
then it is made valid again. On failure the old PDOs are restored.
"""

from dataclasses import dataclass

from fdhil.cia402 import NmtCommand, Object, PowerState, decode_power_state
from fdhil.commissioning.drive_survey import (
    INVALID_COB_ID,
    PdoParameters,
    compare_pdo,
    listen_for_master,
    read_mapping,
    read_pdos,
)
from fdhil.commissioning.finding import read_optional
from fdhil.commissioning.master import Master
from fdhil.drivers import PdoSpec
from fdhil.errors import DeviceError, DriveFault, ProtocolError, SdoAbort

NO_REMOTE_REQUEST = 1 << 30
STORE = 0x1010
SAVE = 0x65766173  # "save", CiA 301 7.5.2.13
UNMAPPABLE = 0x06040041
TOO_LONG = 0x06040042


@dataclass(frozen=True, slots=True)
class PdoSetup:
    """The PDOs that were written (none: all were right), and whether the drive has stored them permanently."""

    written: tuple[str, ...]
    saved: bool | None


def set_up_pdos(master: Master) -> PdoSetup:
    """Write all PDOs that differ from the profile and store them; on DriveFault all PDOs are unchanged.

    ``saved`` None: nothing was written, False: the drive has no 0x1010 or refuses it.
    """
    listen_for_master(master)
    _require_disabled(master)
    pdos = read_pdos(master)
    wrong = [(spec, found) for spec, found in pdos if compare_pdo(spec, found, master.node_id).ok is False]
    if not wrong:
        return PdoSetup((), None)
    master.send_nmt(NmtCommand.ENTER_PRE_OPERATIONAL)
    begun: list[tuple[PdoSpec, PdoParameters]] = []
    try:
        for spec, found in wrong:
            begun.append((spec, found))
            _write_pdo_spec(master, spec, found)
        _verify_written_pdos(master)
    except BaseException as error:  # Ctrl-C, too: a partial mapping is worse than the old one
        _restore_pdos(master, begun, error)
        raise
    return PdoSetup(tuple(spec.name for spec, _ in wrong), _save_to_drive(master))


def _require_disabled(master: Master) -> None:
    word = read_optional(master, Object.STATUSWORD)
    if word is not None and decode_power_state(word) is PowerState.OPERATION_ENABLED:
        raise DriveFault(master.device, "it is in Operation enabled, so nothing was written; switch it off first")


def _write_pdo_spec(master: Master, spec: PdoSpec, found: PdoParameters) -> None:
    cob_id = spec.cob_base + master.node_id | found.cob_id & NO_REMOTE_REQUEST
    wanted = cob_id if spec.valid else cob_id | INVALID_COB_ID
    try:
        _write_pdo(master, found, wanted, spec.every_sync, tuple(entry.mapping for entry in spec.entries))
    except SdoAbort as abort:
        why = {
            UNMAPPABLE: "one of these objects cannot be mapped into it",
            TOO_LONG: "these are too many objects or bytes",
        }.get(abort.code, str(abort).removeprefix(f"{master.device}: "))
        listed = ", ".join(f"{entry.index:04X}:{entry.sub:02X}" for entry in spec.entries)
        advice = "its PDOs are unchanged; write your own profile based on this one, with objects that the drive can map"
        raise DriveFault(master.device, f"it refuses {spec.name} with {listed}: {why}; {advice}") from None


def _write_pdo(master: Master, found: PdoParameters, cob_id: int, kind: int, words: tuple[int, ...]) -> None:
    """Write one PDO; a correct mapping is not written, since it may be read-only."""
    write = master.sdo.write_int
    write(found.parameter, 1, found.cob_id | INVALID_COB_ID, 4)
    if read_mapping(master, found.mapping) != words:
        write(found.mapping, 0, 0, 1)
        for sub, word in enumerate(words, 1):
            write(found.mapping, sub, word, 4)
        write(found.mapping, 0, len(words), 1)
    write(found.parameter, 2, kind, 1)
    write(found.parameter, 1, cob_id, 4)


def _verify_written_pdos(master: Master) -> None:
    for spec, found in read_pdos(master):
        finding = compare_pdo(spec, found, master.node_id)
        if finding.ok is False:
            raise DriveFault(
                master.device, f"it did not keep the written PDOs ({finding.cause}); use the drive's own tool"
            )


def _restore_pdos(master: Master, begun: list[tuple[PdoSpec, PdoParameters]], error: BaseException) -> None:
    for spec, found in reversed(begun):
        try:
            _write_pdo(master, found, found.cob_id, found.kind, found.mapped)
        except DeviceError as left:
            cause = str(error).removeprefix(f"{master.device}: ") or "it was interrupted"
            text = f"{cause}; {spec.name} could not be restored ({left}); power the drive off and on again"
            raise ProtocolError(master.device, text) from error


def _save_to_drive(master: Master) -> bool:
    try:
        master.sdo.write_int(STORE, 1, SAVE, 4)
    except SdoAbort:
        return False
    return True
