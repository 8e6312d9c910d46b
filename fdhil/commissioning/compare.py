"""Compares drives with their records: read again by SDO, with no NC on the bus.

The answer is one finding per axis; it is ok only where the fingerprint is the record's and nothing differs from the
configuration either.
"""

from collections.abc import Callable

from fdhil.commissioning.bus_listener import BusListener, Traffic
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.identifiers import require_own_identifiers
from fdhil.commissioning.master import Master
from fdhil.commissioning.offset_writers import compare_heard_writers
from fdhil.commissioning.record import CommissioningRecord, fingerprint, is_rpdo, load_record
from fdhil.commissioning.survey import Survey, survey
from fdhil.commissioning.void import confirm_record, void_mark, void_record
from fdhil.config import MachineConfig
from fdhil.drivers.can.bus import CanBus
from fdhil.errors import DeviceError, ForeignMaster, StoreError

POINT = "commissioning record"
LISTEN_S, NODES_S = 1.0, 0.3
TURN_S = 0.1


def found_fingerprint(found: Survey) -> str:
    """Return the fingerprint of a drive as it was just read."""
    identity = found.identity
    who = (identity.vendor_id, identity.product_code, identity.revision, identity.serial)
    return fingerprint(who, found.fingerprint, found.options)


def compare_record(record: CommissioningRecord, found: Survey) -> Finding:
    """Compare a drive as it was just read with its record."""
    wrong = next((each for each in found.findings if each.ok is False), None)
    cause = f"{wrong.cause}; {wrong.advice}" if wrong else ""
    seen = found_fingerprint(found)
    if not cause and seen != record.fingerprint:
        cause = f"it is not as it was commissioned: {_difference(record, found)}"
    advice = f"put it right with the drive's own tool, or run fdhil commission --axis {record.axis}"
    return Finding(POINT, record.fingerprint, seen, not cause, cause, advice)


def _difference(record: CommissioningRecord, found: Survey) -> str:
    if record.serial != found.identity.serial:
        return f"its serial number is {found.identity.serial}, not {record.serial}"
    if record.mapping_fingerprint != found.fingerprint:
        return "its PDOs are set up otherwise"
    for key in sorted({*record.options, *found.options}):
        was, now = record.options.get(key), found.options.get(key)
        if was != now and not is_rpdo(key):
            return f"0x{key} is {'missing' if now is None else now}, and was {'missing' if was is None else was}"
    return "vendor, product or revision are others"


def compare_drive(config: MachineConfig, record: CommissioningRecord) -> Finding:
    """Read the drive by SDO and compare it; one that does not answer differs. ForeignMaster beside an NC."""
    try:
        with Master(config, record.axis) as master:
            return compare_record(record, survey(master))
    except ForeignMaster:
        raise
    except DeviceError as error:
        cause, _, advice = str(error).partition("; ")
        return Finding(POINT, record.fingerprint, "no answer", False, cause, advice or "check its supply")


def compare_again(config: MachineConfig, bus: str, say: Callable[[str], None]) -> None:
    """Before a guard starts: with no NC on the bus compare every commissioned drive; what differs voids its record.

    Beside an NC nothing is sent, and the records hold as long as nothing against them is seen: a frame that carries
    the offset of a drive and is none of its RPDOs is. ``say`` gets one sentence per record that is void now.
    ConfigError where a COB-ID of the guard's is that of a node that is heard; ConnectError when the bus cannot be
    opened; StoreError.
    """
    records = _records(config, bus)
    if not records:
        return
    traffic = _listen(config, bus)
    require_own_identifiers(config, bus, traffic.ids)
    for record in records:
        mark = void_mark(config.store.directory, record.axis)
        try:
            if traffic.master is not None:
                compared = compare_heard_writers(config, record.axis, record, traffic)
            else:
                compared = compare_drive(config, record)
                if compared.ok:
                    confirm_record(config.store.directory, record.axis, mark)
        except ForeignMaster:  # it came meanwhile
            return
        if not compared.ok:
            void_record(config.store.directory, record.axis, compared.cause)
            text = f"RecordVoid: axis {record.axis}: {compared.cause}; nothing can be armed or adopted there"
            say(f"{text}; {compared.advice}")


def _records(config: MachineConfig, bus: str) -> list[CommissioningRecord]:
    records = []
    for name, axis in config.axis.items():
        if axis.correction is not None and axis.drive.bus == bus:
            try:
                record = load_record(config.store.directory, name, config.store.commissioning_key)
            except StoreError:
                continue  # one that cannot be read is none, and is told when something is armed
            records += [record] if record is not None else []
    return records


def _listen(config: MachineConfig, bus: str) -> Traffic:
    """Listen for a while, for less where an NC runs: then the nodes of the bus soon show themselves."""
    with BusListener(CanBus(bus, config.bus[bus])) as listener:
        for turn in range(round(LISTEN_S / TURN_S)):
            listener.listen(TURN_S)
            if listener.traffic.master is not None and turn * TURN_S >= NODES_S:
                break
        return listener.traffic
