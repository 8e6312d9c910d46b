"""Answers the layer setting services (CiA 305): node-ID over the bus, by identity or for the only node.

A new node-ID takes effect at the next communication reset and, once stored, survives a power cycle. The bit rate of a
simulated bus is fixed: every standard rate is accepted and changes nothing.
"""

from collections.abc import Callable

REQUEST, RESPONSE = 0x7E5, 0x7E4
UNCONFIGURED = 255
_OK, _OUT_OF_RANGE = 0, 1
_SELECT, _INQUIRE, _IDENTIFY = 0x40, 0x5A, 0x46
_ENTER, _FOUND, _FOUND_UNCONFIGURED, _FASTSCAN = 0x44, 0x4F, 0x50, 0x51
_BIT_RATES = frozenset({0, 1, 2, 3, 4, 6, 7, 8})  # indices of table 0; 5 is reserved


class LssSlave:
    """The LSS side of a node. ``identity`` gives the four numbers of 0x1018; ``node_id`` is the one in force.

    ``pending`` is the node-ID that takes effect at the next communication reset.
    """

    def __init__(self, node_id: int, identity: Callable[[], tuple[int, int, int, int]]) -> None:
        self._identity = identity
        self.node_id = self.pending = self._stored = node_id
        self.reset_selection()

    def reset_selection(self) -> None:
        self._configuring = False
        self._selected = 0
        self._identified = 0
        self._scanned = 0

    def restore_node_id(self) -> None:
        self.pending = self._stored

    def receive_request(self, data: bytes) -> bytes | None:
        """Process a request and return the answer, None where none is due."""
        if len(data) != 8:
            return None
        command, number = data[0], int.from_bytes(data[1:5], "little")
        if command == 0x04:
            self._configuring, self._selected = data[1] == 1, 0
        elif _SELECT <= command <= _SELECT + 3:
            return self._select_by_identity(command - _SELECT, number)
        elif _IDENTIFY <= command <= _IDENTIFY + 5:
            return self._identify_by_bounds(command - _IDENTIFY, number)
        elif command == 0x4C and self.node_id == UNCONFIGURED:
            return _build_answer(_FOUND_UNCONFIGURED)
        elif command == _FASTSCAN and self.node_id == UNCONFIGURED and not self._configuring:
            return self._answer_fastscan(number, *data[5:8])
        elif self._configuring:
            return self._configure_node(command, data)
        return None

    def _select_by_identity(self, number_index: int, number: int) -> bytes | None:
        """Accept one of the four numbers of a switch-selective; the last matching one selects the node."""
        fits = number_index == self._selected and self._identity()[number_index] == number
        self._selected = number_index + 1 if fits else 0
        if self._selected < 4:
            return None
        self._configuring, self._selected = True, 0
        return _build_answer(_ENTER)

    def _identify_by_bounds(self, number_index: int, number: int) -> bytes | None:
        """Accept vendor, product, and the bounds of revision and serial number; answer if all match."""
        vendor, product, revision, serial = self._identity()
        fits = (
            number == vendor, number == product, number <= revision, number >= revision, number <= serial,
            number >= serial,
        )  # fmt: skip
        self._identified = number_index + 1 if number_index == self._identified and fits[number_index] else 0
        if self._identified < 6:
            return None
        self._identified = 0
        return _build_answer(_FOUND)

    def _answer_fastscan(self, number: int, checked: int, sub: int, following: int) -> bytes | None:
        """Answer where the bits from ``checked`` upward match the requested number."""
        if checked == 0x80:
            self._scanned = 0
            return _build_answer(_FOUND)
        if sub > 3 or checked > 31 or sub != self._scanned or (self._identity()[sub] ^ number) >> checked:
            return None
        self._scanned = following
        if checked == 0 and following < sub:  # the whole identity matches
            self._configuring, self._scanned = True, 0
        return _build_answer(_FOUND)

    def _configure_node(self, command: int, data: bytes) -> bytes | None:
        if command == 0x11:
            valid = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED
            if valid:
                self.pending = data[1]
            return _build_answer(command, _OK if valid else _OUT_OF_RANGE)
        if command == 0x13:
            return _build_answer(command, _OK if data[1] == 0 and data[2] in _BIT_RATES else _OUT_OF_RANGE)
        if command == 0x17:
            self._stored = self.pending
            return _build_answer(command, _OK)
        if _INQUIRE <= command <= _INQUIRE + 3:
            return _build_answer(command, *self._identity()[command - _INQUIRE].to_bytes(4, "little"))
        return _build_answer(command, self.pending) if command == 0x5E else None


def _build_answer(command: int, *more: int) -> bytes:
    return bytes([command, *more]).ljust(8, b"\0")
