"""Implements a CANopen node (CiA 301), sans-I/O: NMT, boot-up, SDO, RPDOs, heartbeats, guarding, EMCY, LSS.

Subclasses define the reaction to a SYNC, to received data and to an error.
"""

from abc import ABC, abstractmethod

from fdhil.sim.drive import lss
from fdhil.sim.drive.drive_sensors import DriveFaults
from fdhil.sim.drive.emergency_and_heartbeat import (
    HEARTBEAT_LOST,
    PDO_TOO_SHORT,
    RPDO_TIMEOUT,
    SYNC_LENGTH,
    EmergencyProducer,
    HeartbeatConsumer,
    HeartbeatProducer,
    NodeGuarding,
)
from fdhil.sim.drive.object_dictionary import ObjectDictionary
from fdhil.sim.drive.object_write_rules import StoredParameters
from fdhil.sim.drive.pdo_engine import PdoEngine
from fdhil.sim.drive.sdo_server import SdoServer
from fdhil.sim.drive.service_objects import KEEP_STATE
from fdhil.sim.frame_types import Frame

OFF, INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = -1, 0x00, 0x04, 0x05, 0x7F
_AFTER_ERROR = {0: PRE_OPERATIONAL, 2: STOPPED}  # 0x1029: the NMT state after a communication error; 1: unchanged

_SDO_PATIENCE_S = 1.0  # a client silent for longer within a block has left: the next request is another client's


class CanopenNode(ABC):
    """One node on top of its object dictionary; ``boot_s`` is the time from a reset to the boot-up message.

    ``nmt`` is the NMT state as in a heartbeat, -1 while the device has no supply.
    """

    def __init__(self, dictionary: ObjectDictionary, node_id: int, faults: DriveFaults, boot_s: float) -> None:
        self.dictionary = dictionary
        self.node_id = node_id
        self.faults = faults
        self.nmt = OFF
        self._boot_s = boot_s
        self._boot_due_s: float | None = None
        self._has_booted = False
        self._sync_id = 0x80
        self._sync_refused = False
        self._after_error: int | None = None
        self._now_s = self._sdo_s = 0.0
        self.pdo = PdoEngine(dictionary, self._is_pre_operational, faults.drop_tpdo)
        self._sdo = SdoServer(dictionary)
        self._emergencies = EmergencyProducer(dictionary)
        self._consumer = HeartbeatConsumer(dictionary)
        self._producer = HeartbeatProducer(dictionary, node_id)
        self._guarding = NodeGuarding(dictionary)
        self._lss = lss.LssSlave(node_id, self._read_identity)
        self._stored = StoredParameters(dictionary)

    @abstractmethod
    def power_on(self) -> list[Frame]:
        """Boot or reboot; return the boot-up message if it is sent at once."""

    @abstractmethod
    def _run_sync_cycle(self, counter: int | None) -> list[Frame]:
        """Run the cycle of a SYNC and return the TPDOs."""

    @abstractmethod
    def _coast_through_sync(self) -> None:
        """Run the cycle of a SYNC that the device does not receive: it has no supply or is booting."""

    @abstractmethod
    def _apply_received_objects(self) -> None:
        """Apply objects that an event-driven RPDO has changed."""

    @abstractmethod
    def _react_to_lost_connection(self, code: int) -> None:
        """React to a lost connection with this error code."""

    @abstractmethod
    def _abort_connection(self) -> None:
        """React to the master's release of the connection."""

    @property
    @abstractmethod
    def _in_fault(self) -> bool:
        """Whether a fault waits for its reset."""

    @property
    def _is_mute(self) -> bool:
        return self.nmt in (OFF, INITIALISING)

    def _is_pre_operational(self) -> bool:
        return self.nmt == PRE_OPERATIONAL

    def _read_identity(self) -> tuple[int, int, int, int]:
        vendor, product, revision, serial = (self.dictionary.numbers.get(0x101800 | sub, 0) for sub in (1, 2, 3, 4))
        return vendor, product, revision, serial

    def power_off(self) -> None:
        """Cut the supply: no frame is sent or answered until :meth:`power_on`."""
        self.nmt = OFF
        self._boot_due_s = None
        self.pdo.stop_pdos()
        self._lss.restore_node_id()

    def _begin_boot(self) -> list[Frame]:
        self.nmt = INITIALISING
        self.pdo.stop_pdos()
        self._sdo.reset_transfer()
        self._emergencies.drop_frames()
        self._consumer.restart_monitoring()
        self._producer.restart_timer()
        self._guarding.reset_toggle()
        self._lss.reset_selection()
        self._update_sync_id()
        if self.node_id == lss.UNCONFIGURED:
            return []
        if self._boot_s and self._has_booted:
            self._boot_due_s = self._now_s + self._boot_s
            return []
        return self._finish_boot()

    def _finish_boot(self) -> list[Frame]:
        self.nmt = PRE_OPERATIONAL
        self._boot_due_s, self._has_booted = None, True
        return [(0x700 + self.node_id, b"\0")]

    def _take_node_id(self) -> None:
        new, old = self._lss.pending, self.node_id
        if new == old:
            return
        self.dictionary.shift_node_id(new - old)
        self.node_id = self._lss.node_id = new
        self._producer = HeartbeatProducer(self.dictionary, new)

    def _update_sync_id(self) -> None:
        self._sync_id = self.dictionary.get_number(0x1005) & 0x7FF

    def _watch_connections(self) -> None:
        if not self.faults.no_heartbeat_consumer:
            for node in self._consumer.find_expired(self._now_s):
                self._report_lost_connection(HEARTBEAT_LOST, bytes([node]))
        if self._guarding.has_expired(self._now_s):
            self._report_lost_connection(HEARTBEAT_LOST, b"")
        for number in self.pdo.find_overdue(self._now_s):
            self._report_lost_connection(RPDO_TIMEOUT, bytes([number]))

    def _run_due_timers(self) -> list[Frame]:
        """Return the due frames: boot-up, heartbeat, errors, event-driven TPDOs."""
        boot_due = self._boot_due_s is not None and self._now_s >= self._boot_due_s
        frames = self._finish_boot() if boot_due else []
        if self._is_mute:
            return []
        frames += self._producer.produce_heartbeat(self._now_s, self.nmt)
        self._watch_connections()
        frames += self._take_outgoing()
        if self._after_error is not None:  # the error is sent before the device falls silent
            self._leave_operational(self._after_error)
            self._after_error = None
        return frames + self.pdo.collect_event_tpdos(self._now_s)

    def receive_frame(self, can_id: int, data: bytes) -> list[Frame]:
        """Process one frame from the bus and return the answers; a frame without data is a remote frame."""
        if can_id == self._sync_id:
            return self._receive_sync(data)
        if can_id == lss.REQUEST and self.nmt not in (OFF, OPERATIONAL):
            answer = self._lss.receive_request(data)
            return [] if answer is None else [(lss.RESPONSE, answer)]
        if self._is_mute:
            return []
        if can_id == 0x600 + self.node_id:
            return self._answer_sdo(data)
        if can_id == 0x000:
            return self._execute_nmt(data)
        if can_id == 0x700 + self.node_id:
            return [] if data else [(can_id, self._guarding.answer_guarding(self.nmt, self._now_s))]
        if can_id > 0x700:
            if len(data) == 1 and self._consumer.receive_heartbeat(can_id - 0x700, self._now_s):
                self._emergencies.clear_errors(in_fault=self._in_fault)
            return self._take_outgoing()
        if self.nmt != OPERATIONAL:
            return []
        return self._receive_rpdo(can_id, data) if data else self.pdo.answer_remote_frame(can_id)

    def _answer_sdo(self, data: bytes) -> list[Frame]:
        if self.nmt == STOPPED:
            return []
        if self._sdo.is_receiving_block and self._now_s - self._sdo_s > _SDO_PATIENCE_S:
            self._sdo.reset_transfer()
        self._sdo_s = self._now_s
        answers: list[Frame] = [(0x580 + self.node_id, answer) for answer in self._sdo.answer_request(data)]
        return answers + self._take_outgoing()

    def _execute_nmt(self, data: bytes) -> list[Frame]:
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return []
        match data[0]:
            case 0x01 if self.nmt != OPERATIONAL:
                self.nmt = OPERATIONAL
                self.pdo.configure_pdos()
            case 0x02:
                self._leave_operational(STOPPED)
                self._abort_connection()
            case 0x80:
                self._leave_operational(PRE_OPERATIONAL)
            case 0x81:
                return self.power_on()
            case 0x82:
                self._abort_connection()
                self._take_node_id()
                self._stored.restore_entries(lambda entry: entry.index < 0x2000)
                return self._begin_boot()
        return self._take_outgoing()

    def _leave_operational(self, state: int) -> None:
        self.pdo.stop_pdos()
        self.nmt = state

    def _receive_rpdo(self, can_id: int, data: bytes) -> list[Frame]:
        if not self.pdo.has_rpdo(can_id):
            return []
        try:
            at_once = self.pdo.receive_rpdo(can_id, data, self._now_s)
        except ValueError:
            self._emergencies.report_error(PDO_TOO_SHORT)
            return self._take_outgoing()
        if at_once is not None:
            self.pdo.apply_rpdo(at_once)
            self._apply_received_objects()
        return self._take_outgoing()

    def _take_outgoing(self) -> list[Frame]:
        """Return the EMCY frames to send now; in NMT state Stopped there are none."""
        if self.nmt == STOPPED or self._is_mute:
            self._emergencies.drop_frames()
        return self._emergencies.take_frames(self._now_s) if self._emergencies.waiting else []

    def _receive_sync(self, data: bytes) -> list[Frame]:
        if self._is_mute:
            self._coast_through_sync()
            return []
        counter = data[0] if data else None
        if counter is None and self.dictionary.numbers[0x101900]:
            reported, self._sync_refused = self._sync_refused, True
            if not reported:
                self._emergencies.report_error(SYNC_LENGTH)
            return self._take_outgoing()
        self._sync_refused = False
        return self._run_sync_cycle(counter)

    def _report_lost_connection(self, code: int, detail: bytes) -> None:
        self._emergencies.report_error(code, detail)
        if self.nmt == OPERATIONAL:
            self._after_error = _AFTER_ERROR.get(self.dictionary.numbers.get(0x102901, KEEP_STATE))
        self._react_to_lost_connection(code)
