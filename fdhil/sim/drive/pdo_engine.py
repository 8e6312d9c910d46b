"""Runs the PDOs of a device (CiA 301, 7.2.2): RPDOs buffered until the SYNC, TPDOs sampled at it, mapping rules.

Communication and mapping parameters can be changed in pre-operational only, a mapping only while its PDO is invalid and
its sub-index 0 is 0.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from fdhil.sim.drive.drive_objects import INVALID, NO_RTR
from fdhil.sim.drive.object_dictionary import (
    I8,
    I16,
    I32,
    U8,
    U16,
    U32,
    AbortCode,
    DataType,
    Entry,
    ObjectDictionary,
    TransferAbort,
)
from fdhil.sim.frame_types import Frame

_CODE = {
    I8: "b", I16: "h", I32: "i", U8: "B", U16: "H", U32: "I", DataType.BOOLEAN: "B", DataType.REAL32: "I",
    DataType.REAL64: "Q", DataType.INTEGER64: "q", DataType.UNSIGNED64: "Q",
}  # fmt: skip
# dummy entries that an RPDO may map to skip bytes (CiA 301, 7.4.7.1)
_DUMMIES = {int(kind): (_CODE[kind], 8 * struct.calcsize(_CODE[kind])) for kind in (I8, I16, I32, U8, U16, U32)}
_RECEIVED, _SENT = frozenset({"rw", "rww", "wo"}), frozenset({"ro", "rw", "rww", "rwr", "const"})
# indices of the two parameters of the first PDO
_PLACES = {"rpdo": (0x1400, 0x1600), "tpdo": (0x1800, 0x1A00)}
_MOST_PDOS = 512  # in a direction
_POSITION_OFFSET = 0x60B000
_ID_BITS = 0x1FFFFFFF
_EXTENDED = 1 << 29
_RESTRICTED = (
    (0x000, 0x07F), (0x080, 0x080), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x7FF),
)  # fmt: skip


@dataclass(slots=True)
class Pdo:
    """A valid PDO at run time; ``keys`` are the storage keys of its values, None for a dummy entry.

    ``entries`` is None where values travel in the units in which they are stored.
    """

    number: int
    cob_id: int
    kind: int
    codec: struct.Struct
    keys: tuple[int | None, ...]
    inhibit_s: float = 0.0
    event_s: float = 0.0
    start_value: int = 0
    on_request: bool = False  # TPDO: answers remote frames
    pending: bytes | None = None  # RPDO: data waiting for the SYNC
    sent: bytes | None = None  # TPDO: content sent last
    count: int = 0
    last_s: float | None = None
    checked: tuple[Entry, ...] = field(default=())
    entries: tuple[Entry | None, ...] | None = None

    @property
    def is_synchronous(self) -> bool:
        """Whether its transmission type is 0 to 240."""
        return self.kind <= 240


class PdoEngine:
    """All PDOs of one device. ``drop`` maps TPDO numbers to the number of frames still to be dropped, -1 for all.

    ``heard`` has the numbers of the RPDOs received since the last SYNC, ``previous_received_numbers`` those of the
    cycle before;
    ``sent`` and ``previous_sent_numbers`` also include those lost on the way by a bus fault. ``offset_rpdos`` are those
    that carry the position offset.
    """

    def __init__(self, dictionary: ObjectDictionary, changeable: Callable[[], bool], drop: dict[int, int]) -> None:
        self._dictionary = dictionary
        self._changeable = changeable
        self._drop = drop
        self._rpdos: dict[int, Pdo] = {}
        self._tpdos: list[Pdo] = []
        self.received_numbers: set[int] = set()
        self.previous_received_numbers: set[int] = set()
        self.sent_numbers: set[int] = set()
        self.previous_sent_numbers: set[int] = set()
        self.offset_rpdos: frozenset[int] = frozenset()
        self._register_checks()

    def configure_pdos(self) -> None:
        """Start all PDOs from the object dictionary, on entering OPERATIONAL or after a mapping change."""
        self._rpdos = {pdo.cob_id: pdo for pdo in self.list_configured("rpdo")}
        self._tpdos = list(self.list_configured("tpdo"))
        self.offset_rpdos = frozenset(p.number for p in self._rpdos.values() if _POSITION_OFFSET in p.keys)
        self.received_numbers, self.previous_received_numbers = set(), set()
        self.sent_numbers, self.previous_sent_numbers = set(), set()

    def stop_pdos(self) -> None:
        self._rpdos, self._tpdos = {}, []
        self.received_numbers, self.previous_received_numbers = set(), set()
        self.sent_numbers, self.previous_sent_numbers = set(), set()

    def list_configured(self, direction: str) -> Iterator[Pdo]:
        """Yield the valid PDOs of a direction (``rpdo`` or ``tpdo``) from the dictionary."""
        communication, mapping = _PLACES[direction]
        sends = direction == "tpdo"
        for number in self.list_numbers(direction):
            n = number - 1
            cob_id = self._dictionary.get_number(communication + n, 1)
            entries = self._read_mapping(mapping + n)
            if cob_id & INVALID or not entries:
                continue
            found = [entry for entry, _ in entries if entry is not None]
            yield Pdo(
                number=number,
                cob_id=cob_id & _ID_BITS,
                kind=self._get_parameter(communication + n, 2),
                codec=struct.Struct("<" + "".join(code for _, code in entries)),
                keys=tuple(None if entry is None else entry.storage_key for entry, _ in entries),
                inhibit_s=self._get_parameter(communication + n, 3) * 1e-4 if sends else 0.0,
                event_s=self._get_parameter(communication + n, 5) * 1e-3,
                start_value=self._get_parameter(communication + n, 6) if sends else 0,
                on_request=sends and not cob_id & NO_RTR,
                checked=tuple(
                    entry for entry in found if entry.is_limited or entry.storage_key in self._dictionary.write_checks
                ),
                entries=tuple(entry for entry, _ in entries) if self._dictionary.has_foreign_units else None,
            )

    def list_mapped_entries(self, direction: str, number: int) -> list[Entry]:
        return [entry for entry, _ in self._read_mapping(_PLACES[direction][1] + number - 1) if entry is not None]

    def list_numbers(self, direction: str) -> Iterator[int]:
        """Yield the numbers of the PDOs that the device has, with a COB-ID and a mapping."""
        communication, mapping = _PLACES[direction]
        shown = self._dictionary.entries.keys() & self._dictionary.numbers.keys()  # exposed numbers
        for n in range(_MOST_PDOS):
            if communication + n << 8 | 1 in shown and mapping + n << 8 in shown:
                yield n + 1

    def _get_parameter(self, index: int, sub: int) -> int:
        """Return a communication parameter, 0 where the device does not have it."""
        return self._dictionary.numbers.get(index << 8 | sub, 0)

    def _read_mapping(self, index: int) -> list[tuple[Entry | None, str]]:
        """Return the mapped entries with their codes, None for a dummy; empty if an object cannot be mapped."""
        mapped: list[tuple[Entry | None, str]] = []
        for sub in range(1, self._dictionary.get_number(index, 0) + 1):
            word = self._get_parameter(index, sub)
            entry = self._dictionary.entries.get(word >> 8)
            if entry is not None and entry.type in _CODE:
                mapped.append((entry, _CODE[entry.type]))
            elif entry is None and word >> 16 in _DUMMIES:
                mapped.append((None, _DUMMIES[word >> 16][0]))
            else:
                return []
        return mapped

    def has_rpdo(self, can_id: int) -> bool:
        return can_id in self._rpdos

    def receive_rpdo(self, can_id: int, data: bytes, now_s: float) -> Pdo | None:
        """Receive an RPDO; return it when it is to be applied at once, else it waits for the SYNC.

        LookupError for an unknown identifier, ValueError for a frame shorter than the mapping; of a longer one only the
        mapped part is used (CiA 301, 7.2.2.5).
        """
        pdo = self._rpdos[can_id]
        if len(data) < pdo.codec.size:
            raise ValueError(f"RPDO {pdo.number} has {len(data)} bytes, its mapping needs {pdo.codec.size}")
        pdo.pending = data[: pdo.codec.size]
        pdo.last_s = now_s
        self.received_numbers.add(pdo.number)
        self.sent_numbers.add(pdo.number)
        return None if pdo.is_synchronous else pdo

    def mark_rpdo_lost(self, can_id: int) -> None:
        """Count an RPDO that was sent and lost on the way."""
        if can_id in self._rpdos:
            self.sent_numbers.add(self._rpdos[can_id].number)

    def latch_rpdos(self) -> None:
        for pdo in self._rpdos.values():
            if pdo.pending is not None and pdo.is_synchronous:
                self.apply_rpdo(pdo)
        self.previous_received_numbers, self.received_numbers = self.received_numbers, set()
        self.previous_sent_numbers, self.sent_numbers = self.sent_numbers, set()

    def apply_rpdo(self, pdo: Pdo) -> None:
        """Write the received values into the dictionary, except those out of range."""
        assert pdo.pending is not None
        values: tuple[int, ...] = pdo.codec.unpack(pdo.pending)
        received = {key: value for key, value in zip(pdo.keys, values, strict=True) if key is not None}
        pdo.pending = None
        for entry in pdo.checked:
            try:
                entry.check_range(received[entry.storage_key])
                if check := self._dictionary.write_checks.get(entry.storage_key):
                    check(entry, entry.convert_from_counts(received[entry.storage_key]))
            except TransferAbort:
                del received[entry.storage_key]
        for mapped in pdo.entries or ():
            if mapped is not None and mapped.storage_key in received:
                received[mapped.storage_key] = mapped.convert_from_counts(received[mapped.storage_key])
        self._dictionary.numbers.update(received)

    def find_overdue(self, now_s: float) -> list[int]:
        """Return the RPDOs whose event timer has just expired; monitoring starts with the first frame."""
        late = [
            pdo
            for pdo in self._rpdos.values()
            if pdo.event_s and pdo.last_s is not None and now_s - pdo.last_s > pdo.event_s
        ]
        for pdo in late:
            pdo.last_s = None
        return [pdo.number for pdo in late]

    def collect_sync_tpdos(self, counter: int | None, now_s: float) -> list[Frame]:
        """Return the TPDOs due at this SYNC: types 1 to 240 every n-th, type 0 when changed, and events."""
        frames: list[Frame] = []
        for pdo in self._tpdos:
            if not 1 <= pdo.kind <= 240:
                self._send_if_changed(pdo, now_s, frames)
                continue
            if pdo.start_value and counter is not None:
                if counter != pdo.start_value:
                    continue
                pdo.start_value = 0
            pdo.count += 1
            if pdo.count >= pdo.kind:
                pdo.count = 0
                self._send_tpdo(pdo, self._pack_content(pdo), now_s, frames)
        return frames

    def collect_event_tpdos(self, now_s: float) -> list[Frame]:
        """Return the event-driven TPDOs (types 254, 255) that changed or whose event timer expired."""
        frames: list[Frame] = []
        for pdo in self._tpdos:
            if pdo.kind > 240:
                self._send_if_changed(pdo, now_s, frames)
        return frames

    def answer_remote_frame(self, can_id: int) -> list[Frame]:
        """Return the TPDO that a remote frame requests, if bit 30 of its COB-ID allows it."""
        return [(can_id, self._pack_content(pdo)) for pdo in self._tpdos if pdo.cob_id == can_id and pdo.on_request]

    def _send_if_changed(self, pdo: Pdo, now_s: float, frames: list[Frame]) -> None:
        content = self._pack_content(pdo)
        since = None if pdo.last_s is None else now_s - pdo.last_s
        elapsed = bool(pdo.event_s) and pdo.kind > 240 and (since is None or since >= pdo.event_s)
        if (content != pdo.sent or elapsed) and (since is None or since >= pdo.inhibit_s):
            self._send_tpdo(pdo, content, now_s, frames)

    def _pack_content(self, pdo: Pdo) -> bytes:
        values = self._dictionary.numbers
        if pdo.entries is not None:
            return pdo.codec.pack(
                *[entry.convert_to_counts(values[entry.storage_key]) for entry in pdo.entries if entry is not None]
            )
        return pdo.codec.pack(*[values[key] for key in pdo.keys if key is not None])

    def _send_tpdo(self, pdo: Pdo, content: bytes, now_s: float, frames: list[Frame]) -> None:
        pdo.sent, pdo.last_s = content, now_s
        remaining = self._drop.get(pdo.number, 0)
        if remaining == 0:
            frames.append((pdo.cob_id, content))
        elif remaining > 0:
            self._drop[pdo.number] = remaining - 1

    def _register_checks(self) -> None:
        rules = {1: self._check_cob_id, 2: self._check_kind, 3: self._check_invalid, 6: self._check_invalid}
        entries = self._dictionary.entries
        for direction, (communication, mapping) in _PLACES.items():
            for n in (number - 1 for number in self.list_numbers(direction)):
                for sub in (1, 2, 3, 5, 6):
                    if (key := communication + n << 8 | sub) in entries:
                        self._dictionary.write_checks[key] = rules.get(sub, self._check_state)
                self._dictionary.write_checks[mapping + n << 8] = self._check_count
                for sub in range(1, self._count_mapping_entries(mapping + n) + 1):
                    self._dictionary.write_checks[mapping + n << 8 | sub] = self._check_mapping

    def _count_mapping_entries(self, index: int) -> int:
        entries = self._dictionary.entries
        return next(sub for sub in range(1, 256) if index << 8 | sub not in entries) - 1

    def _check_state(self, entry: Entry, value: int) -> None:
        if not self._changeable():
            raise TransferAbort(AbortCode.DEVICE_STATE)

    def _check_invalid(self, entry: Entry, value: int) -> None:
        """Require an invalid PDO; ``entry`` belongs to its communication or mapping parameter."""
        self._check_state(entry, value)
        if not self._dictionary.get_number(entry.index & ~0x200, 1) & INVALID:
            raise TransferAbort(AbortCode.DEVICE_STATE)

    def _check_cob_id(self, entry: Entry, value: int) -> None:
        self._check_state(entry, value)
        old = self._dictionary.get_number(entry.index, 1)
        if value & INVALID:
            return
        if not old & INVALID and (value ^ old) & _ID_BITS:
            raise TransferAbort(AbortCode.DEVICE_STATE)
        can_id = value & _ID_BITS
        if value & _EXTENDED or can_id > 0x7FF or any(low <= can_id <= high for low, high in _RESTRICTED):
            raise TransferAbort(AbortCode.RANGE)

    def _check_kind(self, entry: Entry, value: int) -> None:
        self._check_state(entry, value)
        if 241 <= value <= 253:
            raise TransferAbort(AbortCode.RANGE)

    def _check_count(self, entry: Entry, value: int) -> None:
        self._check_invalid(entry, value)
        if value > self._count_mapping_entries(entry.index):
            raise TransferAbort(AbortCode.PDO_LENGTH)
        mapped = [self._get_parameter(entry.index, sub) for sub in range(1, value + 1)]
        for word in mapped:
            self._check_mappable(entry.index, word)
        if sum(word & 0xFF for word in mapped) > 64:
            raise TransferAbort(AbortCode.PDO_LENGTH)

    def _check_mapping(self, entry: Entry, value: int) -> None:
        self._check_invalid(entry, value)
        if self._dictionary.get_number(entry.index, 0):
            raise TransferAbort(AbortCode.DEVICE_STATE)
        if value:
            self._check_mappable(entry.index, value)

    def _check_mappable(self, mapping_index: int, word: int) -> None:
        receives = mapping_index < 0x1800
        if receives and word >> 16 in _DUMMIES and word >> 8 & 0xFF == 0 and word & 0xFF == _DUMMIES[word >> 16][1]:
            return
        entry = self._dictionary.entries.get(word >> 8)
        if entry is None or not entry.mappable or entry.type not in _CODE or word & 0xFF != 8 * (entry.size or 0):
            raise TransferAbort(AbortCode.NOT_MAPPABLE)
        if entry.access not in (_RECEIVED if receives else _SENT):
            raise TransferAbort(AbortCode.NOT_MAPPABLE)
