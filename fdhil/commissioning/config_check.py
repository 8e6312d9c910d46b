"""Compare the machine on the bus with its configuration: drives, mapping, scales, cycle, rapid signal and sensors.

If an NC runs the bus nothing is sent: its traffic is compared, everything else is reported as not compared.
"""

import asyncio
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from fdhil.commissioning.cob_id_conflicts import compare_cob_ids
from fdhil.commissioning.commissioning_record import CommissioningRecord, load_record
from fdhil.commissioning.drive_survey import DriveSurvey, survey_drive
from fdhil.commissioning.finding import Finding, read_optional
from fdhil.commissioning.master import Master
from fdhil.commissioning.offset_writers import compare_traffic_writers
from fdhil.commissioning.record_comparison import RECORD_POINT, compare_record
from fdhil.commissioning.sync_timing import assess_sync_jitter
from fdhil.commissioning.traffic_listener import LISTEN_S, BusListener, BusTraffic
from fdhil.config import MachineConfig
from fdhil.drivers import DriveProfile, ListeningBus, PdoSpec, Sensor, create_sensors, load_event_source, load_profile
from fdhil.errors import DeviceError, ForeignMaster, StoreError
from fdhil.identification import compare_with_configuration, is_better_than_configured
from fdhil.store import History

RATE_TOLERANCE = 0.1
PERIOD_TOLERANCE = 0.02
SDO_POINTS = ("identity", "cycle", "scale", "rated current", "communication lost", "stop by a ramp", "following error")
NC_OFF = "switch the NC off and check again"
FIND = "find the drive's node-ID and check again"

Place = tuple[str, Finding]
"""Where a finding applies (``bus can0``, ``axis X``), and the finding."""


def check_machine(config: MachineConfig, say: Callable[[str], None] = lambda _text: None) -> list[Place]:
    """Compare everything; an unreachable device is a finding. ConnectError only for a bus that cannot be opened.

    ForeignMaster if an NC starts while the drives are read.
    """
    found: list[Place] = []
    for bus in dict.fromkeys(axis.drive.bus for axis in config.axis.values()):
        say(f"listening on bus {bus}")
        with BusListener(ListeningBus(bus, config.bus[bus])) as listener:
            listener.listen_for(LISTEN_S)
            listener.require_readable()
            traffic = listener.traffic
        found += [(f"bus {bus}", finding) for finding in compare_bus(traffic, config)]
        for axis in (name for name, settings in config.axis.items() if settings.drive.bus == bus):
            say(f"comparing axis {axis}")
            compared = (
                compare_by_sdo(config, axis, traffic.cob_ids)
                if traffic.master is None
                else compare_by_traffic(traffic, config, axis)
            )
            found += [(f"axis {axis}", finding) for finding in (*compared, *compare_loops(config, axis))]
            found += [(f"axis {axis}", finding) for finding in asyncio.run(compare_sensors(config, axis))]
    return found


def compare_bus(traffic: BusTraffic, config: MachineConfig) -> Iterator[Finding]:
    """Report who runs the bus and at which SYNC period."""
    wanted = config.machine.sync_period_s
    expected, period_s = f"{wanted * 1e3:g} ms", traffic.sync_period_s
    if traffic.master is None:
        yield Finding("NC", "off or on", "off: the drives are read by SDO")
        return
    yield Finding("NC", "off or on", f"on ({traffic.master} received): nothing is sent")
    if period_s is None:
        yield Finding("SYNC", expected, "none received", None, "the NC sends no SYNC yet", "let it enable the drives")
    elif config.guard.clock == "sync":
        yield Finding("SYNC", "counted, not timed", f"{period_s * 1e3:.3f} ms")
    else:
        same = abs(period_s - wanted) <= PERIOD_TOLERANCE * wanted
        found = f"{period_s * 1e3:.3f} ms"
        cause = f"the SYNC period is {found}, but the configuration has {expected}"
        yield Finding("SYNC", expected, found, same, cause, "correct machine.sync_period_s or the NC's cycle")
    if period_s is not None:
        yield assess_sync_jitter((np.diff(traffic.sync_ns) * 1e-9).tolist(), period_s, config.guard.clock == "sync")


def compare_by_sdo(config: MachineConfig, axis: str, received: Sequence[int] = ()) -> list[Finding]:
    """Compare a drive by SDO, while no NC runs the bus; ``received`` are COB-IDs already received there."""
    node = f"node-ID {config.get_node_id(axis)}"
    with Master(config, axis) as master:
        master.feedback.ids.update(received)
        try:
            found = survey_drive(master)
            seen = f"{node}, serial number {found.identity.serial}"
            if not found.is_drive:
                return [
                    Finding("drive", node, seen),
                    *found.findings,
                    *_list_uncompared_points(SDO_POINTS, "it is not a drive", FIND),
                ]
            return [
                Finding("drive", node, seen),
                *found.findings,
                _check_heartbeat(found.options.get("1017")),
                *_check_rapid_signal(
                    config, master.profile, lambda: read_optional(master, *master.profile.digital_inputs)
                ),
                *_check_voltage_object(config, axis, master.profile, master),
                *_compare_signed_off_record(config, axis, found),
            ]
        except ForeignMaster:
            raise
        except DeviceError as error:
            return [_report_unreachable("drive", node, error)]


def _list_uncompared_points(points: Sequence[str], cause: str, advice: str) -> list[Finding]:
    return [Finding(point, "as configured", "not read", None, cause, advice) for point in points]


def _load_record_if_readable(config: MachineConfig, axis: str) -> CommissioningRecord | None:
    try:
        return load_record(config.store.directory, axis, config.store.commissioning_key, may_lack_key=True)
    except StoreError:
        return None


def _compare_signed_off_record(config: MachineConfig, axis: str, found: DriveSurvey) -> Iterator[Finding]:
    try:
        record = load_record(config.store.directory, axis, config.store.commissioning_key, may_lack_key=True)
    except StoreError as error:
        cause, _, advice = str(error).partition("; ")
        yield Finding(RECORD_POINT, "as signed off", "cannot be read", False, cause, advice)
        return
    if record is not None:
        yield compare_record(record, found)


def compare_loops(config: MachineConfig, axis: str) -> Iterator[Finding]:
    """Compare the configured control loops with those identified last; nothing before the first identification."""
    try:
        with History.open_read_only(config.store.directory) as history:
            identified = history.read_loops(axis, 1)
    except StoreError:  # there is no history yet, or the daemon reports its fault
        return
    for _, loops in identified:
        settings = config.axis[axis]
        apart = [d for d in compare_with_configuration(settings, loops) if d.is_significant]
        found = ", ".join(f"{d.key} {d.found:.4g}" for d in apart) or "the same"
        reasons = (*loops.verdict.reasons, *loops.verdict.warnings)
        same = loops.verdict.accepted and not is_better_than_configured(loops)
        cause, advice = (reasons[0].text, reasons[0].advice) if reasons else ("", "")
        shown = "as configured" if same else f"{loops.structure}: {found}"
        yield Finding("loops", f"{settings.regulators.structure} as configured", shown, same, cause, advice)


def _report_unreachable(point: str, expected: str, error: DeviceError) -> Finding:
    cause, _, advice = str(error).removeprefix(f"{error.device}: ").partition("; ")
    return Finding(point, expected, "no answer", False, cause, advice or "check its supply and its wiring")


def _check_heartbeat(period_ms: int | None) -> Finding:
    cause = "it sends no heartbeat (0x1017), so only its PDOs show that it is alive"
    shown = f"{period_ms} ms" if period_ms else "none"
    return Finding("heartbeat", "any", shown, bool(period_ms), cause, "set 0x1017 to 100 with the drive's tool")


def _check_rapid_signal(
    config: MachineConfig, profile: DriveProfile, read: Callable[[], int | None]
) -> Iterator[Finding]:
    if not load_event_source(config.g0.source).needs_input:
        yield Finding("rapid signal", config.g0.source, f"{config.g0.source} needs no input")
        return
    bit = config.g0.input_bit
    expected = f"bit {bit} of 0x60FD in a TPDO"
    mapped = profile.find_tpdo(profile.digital_inputs)
    advice = "map 0x60FD, or set g0.source = 'inferred'"
    if mapped is None or mapped[1].bits <= bit:
        cause = f"profile {profile.name} maps no bit {bit} of 0x60FD"
        yield Finding("rapid signal", expected, "not mapped", False, cause, advice)
        return
    value = read()
    if value is None:
        yield Finding("rapid signal", expected, "no 0x60FD", False, "it has no digital inputs (0x60FD)", advice)
        return
    yield Finding("rapid signal", expected, f"{'on' if value >> bit & 1 else 'off'} now")


def _check_voltage_object(config: MachineConfig, axis: str, profile: DriveProfile, master: Master) -> Iterator[Finding]:
    if config.axis[axis].voltage.is_separate:
        return
    if profile.voltage is None or not profile.voltage_objects:
        cause = f"profile {profile.name} has no object of the terminal voltage"
        yield Finding("voltage", "from the drive", "none", False, cause, "set voltage.source = 'modbus'")
        return
    scale = profile.compute_voltage_scale(config.axis[axis])
    if not scale:
        cause = f"profile {profile.name} reports a PWM duty, and the DC-link voltage is unknown"
        yield Finding("voltage", "from the drive", "a duty", False, cause, "set drive.dc_link_v, or use a sensor")
        return
    index, sub = profile.voltage
    raw = read_optional(master, index, sub, signed=not profile.voltage_magnitude)
    cause = f"it has no terminal voltage (0x{index:04X}:{sub:02X})"
    shown = "none" if raw is None else f"{raw * abs(scale):.2f} V"
    yield Finding("voltage", "from the drive", shown, raw is not None, cause, "choose another profile or sensor")


def compare_by_traffic(traffic: BusTraffic, config: MachineConfig, axis: str) -> Iterator[Finding]:
    """Compare one drive as far as the traffic of a running NC shows it; nothing is sent."""
    profile, node_id = load_profile(config.axis[axis].drive), config.get_node_id(axis)
    nmt = traffic.decode_nmt_state(node_id)
    cause = f"no frame of node-ID {node_id} was received"
    shown = f"{cause}" if node_id not in traffic.sending_nodes else f"node-ID {node_id}, {nmt or 'no heartbeat'}"
    advice = "check the drive's supply and drive.node_id"
    yield Finding("drive", f"node-ID {node_id}", shown, node_id in traffic.sending_nodes, cause, advice)
    period_s = traffic.measure_heartbeat_s(node_id)
    yield _check_heartbeat(None if period_s is None else round(period_s * 1e3))
    for spec in profile.tpdos:
        yield _compare_pdo_traffic(traffic, spec, node_id)
    target = profile.find_rpdo(profile.target)
    if target is not None:
        yield _compare_pdo_traffic(traffic, target[0], node_id)
    table = config.axis[axis].table
    if table is not None and table.cob_id is not None:
        yield _compare_table_encoder_traffic(traffic, table.cob_id)
    yield compare_cob_ids(config, axis, traffic.cob_ids)
    if profile.find_tpdo(profile.offset) is not None:
        yield compare_traffic_writers(config, axis, _load_record_if_readable(config, axis), traffic)
    yield from _check_rapid_signal(config, profile, lambda: _extract_digital_inputs(traffic, profile, node_id))
    yield from _list_uncompared_points(("device", *SDO_POINTS), "only the NC may use SDO while it runs", NC_OFF)


def _compare_pdo_traffic(traffic: BusTraffic, spec: PdoSpec, node_id: int) -> Finding:
    """Compare a PDO's rate and length with the profile; without SYNC none is due."""
    cob_id, syncs = spec.cob_base + node_id, len(traffic.sync_ns)
    count, length = traffic.count.get(cob_id, 0), traffic.length.get(cob_id, 0)
    due = syncs / spec.every_sync if spec.valid else 0.0
    expected = f"{cob_id:03X}: {spec.length} bytes, {f'every {spec.every_sync} SYNC' if spec.valid else 'never'}"
    advice = "compare its mapping with the profile, or choose another profile"
    if syncs == 0:
        return Finding(spec.name, expected, "no SYNC", None, "the NC sends no SYNC yet", "let it enable the drives")
    shown = f"{count} in {syncs} SYNC" + (f", {length} bytes" if count else "")
    if count and length != spec.length:
        cause = f"{spec.name} ({cob_id:03X}) has {length} bytes, but the profile has {spec.length}"
    else:
        cause = f"{spec.name} ({cob_id:03X}) was received {count} times in {syncs} SYNC, {due:.0f} are due"
    ok = length in (0, spec.length) and abs(count - due) <= max(2.0, RATE_TOLERANCE * due)
    return Finding(spec.name, expected, shown, ok, cause, advice)


def _compare_table_encoder_traffic(traffic: BusTraffic, cob_id: int) -> Finding:
    count, syncs = traffic.count.get(cob_id, 0), len(traffic.sync_ns)
    cause = f"the table encoder's TPDO {cob_id:03X} was received {count} times in {syncs} SYNC"
    advice = "start its node, make that TPDO synchronous (type 1), or correct cob_id of the table"
    ok = abs(count - syncs) <= max(2.0, RATE_TOLERANCE * syncs) if syncs else None
    return Finding("table encoder", f"{cob_id:03X} every SYNC", f"{count} in {syncs} SYNC", ok, cause, advice)


def _extract_digital_inputs(traffic: BusTraffic, profile: DriveProfile, node_id: int) -> int | None:
    mapped = profile.find_tpdo(profile.digital_inputs)
    if mapped is None:
        return None
    spec, entry = mapped
    data = traffic.data.get(spec.cob_base + node_id)
    return None if data is None else data >> entry.bit_offset & (1 << entry.bits) - 1


async def compare_sensors(config: MachineConfig, axis: str) -> list[Finding]:
    """Connect to and read the sensors of one axis; reading alone does not disturb a running daemon."""
    return [await _probe_sensor(point, sensor) for point, sensor in create_sensors(axis, config).items()]


async def _probe_sensor(point: str, sensor: Sensor) -> Finding:
    try:
        await sensor.link.connect()
        return Finding(point, sensor.link.place, await sensor.format_reading())
    except DeviceError as error:
        return _report_unreachable(point, sensor.link.place, error)
    finally:
        sensor.link.close()
