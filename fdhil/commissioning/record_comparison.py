"""Compare drives with their commissioning records by reading them again by SDO, while no NC runs the bus.

Each axis gives one finding; it is ok if the fingerprint is unchanged and the drive matches the configuration.
"""

from collections.abc import Callable

from fdhil.commissioning.cob_id_conflicts import require_unique_guard_ids
from fdhil.commissioning.commissioning_record import (
    CommissioningRecord,
    compute_fingerprint,
    is_rpdo_option,
    load_record,
)
from fdhil.commissioning.drive_survey import DriveSurvey, survey_drive
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.master import Master
from fdhil.commissioning.offset_writers import compare_traffic_writers
from fdhil.commissioning.traffic_listener import BusListener, BusTraffic
from fdhil.commissioning.void_mark import clear_void_mark, mark_record_void, read_void_mark
from fdhil.config import MachineConfig
from fdhil.drivers import ListeningBus
from fdhil.errors import DeviceError, ForeignMaster, StoreError

RECORD_POINT = "commissioning record"
LISTEN_S, NODES_S = 1.0, 0.3
TURN_S = 0.1


def compute_survey_fingerprint(found: DriveSurvey) -> str:
    """Return the fingerprint of a drive as just read."""
    identity = found.identity
    who = (identity.vendor_id, identity.product_code, identity.revision, identity.serial)
    return compute_fingerprint(who, found.fingerprint, found.options)


def compare_record(record: CommissioningRecord, found: DriveSurvey) -> Finding:
    """Compare a drive as just read with its record."""
    wrong = next((each for each in found.findings if each.ok is False), None)
    cause = f"{wrong.cause}; {wrong.advice}" if wrong else ""
    seen = compute_survey_fingerprint(found)
    if not cause and seen != record.fingerprint:
        cause = f"it has changed since it was commissioned: {_describe_difference(record, found)}"
    advice = f"correct it with the drive's own tool, or run fdhil commission --axis {record.axis}"
    return Finding(RECORD_POINT, record.fingerprint, seen, not cause, cause, advice)


def _describe_difference(record: CommissioningRecord, found: DriveSurvey) -> str:
    if record.serial != found.identity.serial:
        return f"its serial number is {found.identity.serial}, not {record.serial}"
    if record.mapping_fingerprint != found.fingerprint:
        return "its PDO mapping is different"
    for key in sorted({*record.options, *found.options}):
        was, now = record.options.get(key), found.options.get(key)
        if was != now and not is_rpdo_option(key):
            return f"0x{key} is {'missing' if now is None else now}, and was {'missing' if was is None else was}"
    return "its vendor, product or revision is different"


def compare_drive(config: MachineConfig, record: CommissioningRecord) -> Finding:
    """Read the drive by SDO and compare it; one that does not answer differs. ForeignMaster if an NC runs the bus."""
    try:
        with Master(config, record.axis) as master:
            return compare_record(record, survey_drive(master))
    except ForeignMaster:
        raise
    except DeviceError as error:
        cause, _, advice = str(error).partition("; ")
        return Finding(RECORD_POINT, record.fingerprint, "no answer", False, cause, advice or "check its supply")


def verify_commissioned_drives(config: MachineConfig, bus: str, say: Callable[[str], None]) -> None:
    """Compare every commissioned drive before a guard starts; a drive that differs voids its record.

    With an NC on the bus nothing is sent, and a record stays valid unless the traffic contradicts it: a frame that
    carries the drive's offset and is none of its RPDOs does. ``say`` gets one sentence per voided record.

    ConfigError if a COB-ID of the guard is used by a node on the bus; ConnectError if the bus cannot be opened;
    StoreError.
    """
    records = _load_bus_records(config, bus)
    if not records:
        return
    traffic = _listen_to_bus(config, bus)
    require_unique_guard_ids(config, bus, traffic.cob_ids)
    for record in records:
        mark = read_void_mark(config.store.directory, record.axis)
        try:
            if traffic.master is not None:
                compared = compare_traffic_writers(config, record.axis, record, traffic)
            else:
                compared = compare_drive(config, record)
                if compared.ok:
                    clear_void_mark(config.store.directory, record.axis, mark)
        except ForeignMaster:  # an NC started meanwhile
            return
        if not compared.ok:
            mark_record_void(config.store.directory, record.axis, compared.cause)
            text = f"RecordVoid: axis {record.axis}: {compared.cause}; the axis cannot be armed or adopted"
            say(f"{text}; {compared.advice}")


def _load_bus_records(config: MachineConfig, bus: str) -> list[CommissioningRecord]:
    records = []
    for name, axis in config.axis.items():
        if axis.correction is not None and axis.drive.bus == bus:
            try:
                record = load_record(config.store.directory, name, config.store.commissioning_key)
            except StoreError:
                continue  # arming reports an unreadable record
            records += [record] if record is not None else []
    return records


def _listen_to_bus(config: MachineConfig, bus: str) -> BusTraffic:
    """With an NC on the bus a shorter time is enough: its nodes show themselves at once."""
    with BusListener(ListeningBus(bus, config.bus[bus])) as listener:
        for turn in range(round(LISTEN_S / TURN_S)):
            listener.listen_for(TURN_S)
            if listener.traffic.master is not None and turn * TURN_S >= NODES_S:
                break
        return listener.traffic
