"""Answers SDO requests (CiA 301, 7.2.4): expedited, segmented and block transfers both ways, blocks with CRC.

Sans-I/O: requests of 8 bytes in, answers out. One client, one transfer at a time; a new initiate request drops the
present transfer, as the standard demands.
"""

import binascii
from dataclasses import dataclass, field

from fdhil.sim.drive.object_dictionary import AbortCode, Entry, ObjectDictionary, TransferAbort

MAX_DOWNLOAD_BYTES = 1 << 16  # the largest writable object
BLOCK_SEGMENTS = 127


@dataclass(slots=True)
class _Upload:
    index: int
    sub: int
    data: bytes  # data still to be sent
    toggle: int = 0


@dataclass(slots=True)
class _Download:
    index: int
    sub: int
    size: int | None
    toggle: int = 0
    data: bytearray = field(default_factory=bytearray)


@dataclass(slots=True)
class _BlockUpload:
    index: int
    sub: int
    data: bytes
    block_size: int
    with_crc: bool
    position: int = 0  # first unacknowledged byte
    sent: int = 0  # segments of the block in transit
    started: bool = False
    ended: bool = False


@dataclass(slots=True)
class _BlockDownload:
    index: int
    sub: int
    size: int | None
    with_crc: bool
    data: bytearray = field(default_factory=bytearray)
    received: int = 0  # segments of this block received in order
    complete: bool = False


class SdoServer:
    """Answers the SDO requests of one client from an object dictionary."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self._transfer: _Upload | _Download | _BlockUpload | _BlockDownload | None = None

    @property
    def is_receiving_block(self) -> bool:
        """Whether a block download waits for segments: every request is taken for one."""
        return isinstance(self._transfer, _BlockDownload) and not self._transfer.complete

    def reset_transfer(self) -> None:
        self._transfer = None

    def answer_request(self, data: bytes) -> list[bytes]:
        """Process one request and return the responses, 8 bytes each; frames of another length are ignored."""
        if len(data) != 8:
            return []
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        goes_on = (data[0] >> 5 in (0, 3, 5) and data[0] & 0xE3 != 0xA0) or data[0] & 0xE1 == 0xC1
        goes_on |= self.is_receiving_block
        if goes_on and self._transfer is not None:  # such a request does not repeat index and sub-index
            index, sub = self._transfer.index, self._transfer.sub
        try:
            return self._dispatch_request(data, index, sub)
        except TransferAbort as abort:
            self._transfer = None
            return [_build_header(0x80, index, sub) + abort.code.to_bytes(4, "little")]

    def _dispatch_request(self, data: bytes, index: int, sub: int) -> list[bytes]:
        transfer = self._transfer
        if isinstance(transfer, _BlockDownload) and not transfer.complete and data[0] != 0x80:
            return self._receive_block_segment(transfer, data)
        match data[0] >> 5:
            case 0:
                return self._receive_download_segment(data)
            case 1:
                return self._initiate_download(data, index, sub)
            case 2:
                return self._initiate_upload(index, sub)
            case 3:
                return self._send_upload_segment(data)
            case 4:
                self._transfer = None
                return []
            case 5:
                return self._handle_block_upload(data, index, sub)
            case 6:
                return self._handle_block_download(data, index, sub)
            case _:
                raise TransferAbort(AbortCode.COMMAND)

    def _initiate_upload(self, index: int, sub: int) -> list[bytes]:
        self._transfer = None
        value = self._dictionary.read_entry(index, sub)
        if 1 <= len(value) <= 4:
            return [_build_header(0x43 | (4 - len(value)) << 2, index, sub) + value.ljust(4, b"\0")]
        self._transfer = _Upload(index, sub, value)
        return [_build_header(0x41, index, sub) + len(value).to_bytes(4, "little")]

    def _send_upload_segment(self, data: bytes) -> list[bytes]:
        transfer = self._transfer
        if not isinstance(transfer, _Upload):
            raise TransferAbort(AbortCode.COMMAND)
        toggle = _check_toggle(transfer, data)
        part, transfer.data = transfer.data[:7], transfer.data[7:]
        last = not transfer.data
        if last:
            self._transfer = None
        return [bytes([toggle << 4 | (7 - len(part)) << 1 | last]) + part.ljust(7, b"\0")]

    def _initiate_download(self, data: bytes, index: int, sub: int) -> list[bytes]:
        self._transfer = None
        expedited, sized = data[0] >> 1 & 1, data[0] & 1
        entry = self._dictionary.require_writable(index, sub)
        if expedited:
            length = 4 - (data[0] >> 2 & 3) if sized else min(entry.size or 4, 4)
            self._dictionary.write_entry(index, sub, data[4 : 4 + length])
        else:
            size = _read_announced_size(entry, data) if sized else None
            self._transfer = _Download(index, sub, size)
        return [_build_header(0x60, index, sub) + bytes(4)]

    def _receive_download_segment(self, data: bytes) -> list[bytes]:
        transfer = self._transfer
        if not isinstance(transfer, _Download):
            raise TransferAbort(AbortCode.COMMAND)
        toggle = _check_toggle(transfer, data)
        transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
        last = data[0] & 1
        size = transfer.size if transfer.size is not None else MAX_DOWNLOAD_BYTES
        if len(transfer.data) > size or (last and transfer.size is not None and len(transfer.data) != size):
            raise TransferAbort(AbortCode.LENGTH)
        if last:
            self._transfer = None
            self._dictionary.write_entry(transfer.index, transfer.sub, bytes(transfer.data))
        return [bytes([0x20 | toggle << 4]) + bytes(7)]

    def _handle_block_download(self, data: bytes, index: int, sub: int) -> list[bytes]:
        if data[0] & 1:
            return self._end_block_download(data)
        self._transfer = None
        entry = self._dictionary.require_writable(index, sub)
        size = _read_announced_size(entry, data) if data[0] & 2 else None
        self._transfer = _BlockDownload(index, sub, size, bool(data[0] & 4))
        return [_build_header(0xA4, index, sub) + bytes([BLOCK_SEGMENTS, 0, 0, 0])]

    def _receive_block_segment(self, transfer: _BlockDownload, data: bytes) -> list[bytes]:
        """Accept a segment in sequence; others are repeated after the block's acknowledgement."""
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if number == 0:
            raise TransferAbort(AbortCode.SEQUENCE)
        if number == transfer.received + 1:
            transfer.data += data[1:]
            transfer.received = number
            transfer.complete = last
            if len(transfer.data) > (transfer.size or MAX_DOWNLOAD_BYTES) + 6:
                raise TransferAbort(AbortCode.LENGTH)
        if not last and number < BLOCK_SEGMENTS:
            return []
        acknowledged, transfer.received = transfer.received, 0
        return [bytes([0xA2, acknowledged, BLOCK_SEGMENTS]) + bytes(5)]

    def _end_block_download(self, data: bytes) -> list[bytes]:
        transfer, self._transfer = self._transfer, None
        if not isinstance(transfer, _BlockDownload):
            raise TransferAbort(AbortCode.COMMAND)
        content = bytes(transfer.data[: len(transfer.data) - (data[0] >> 2 & 7)])
        if transfer.size is not None and len(content) != transfer.size:
            raise TransferAbort(AbortCode.LENGTH)
        if transfer.with_crc and int.from_bytes(data[1:3], "little") != binascii.crc_hqx(content, 0):
            raise TransferAbort(AbortCode.CRC)
        self._dictionary.write_entry(transfer.index, transfer.sub, content)
        return [bytes([0xA1]) + bytes(7)]

    def _handle_block_upload(self, data: bytes, index: int, sub: int) -> list[bytes]:
        command = data[0] & 3
        if command == 0:
            return self._initiate_block_upload(data, index, sub)
        transfer = self._transfer
        if not isinstance(transfer, _BlockUpload):
            raise TransferAbort(AbortCode.COMMAND)
        if command == 3 and not transfer.started:
            transfer.started = True
            return self._build_block(transfer)
        if command == 2 and transfer.started and not transfer.ended:
            return self._accept_acknowledgement(transfer, data[1], data[2])
        if command == 1 and transfer.ended:
            self._transfer = None
            return []
        raise TransferAbort(AbortCode.COMMAND)

    def _initiate_block_upload(self, data: bytes, index: int, sub: int) -> list[bytes]:
        self._transfer = None
        value = self._dictionary.read_entry(index, sub)
        if not 1 <= data[4] <= 127:
            raise TransferAbort(AbortCode.BLOCK_SIZE)
        if 0 < len(value) <= data[5]:  # the protocol switch threshold: shorter objects use the normal transfer
            return self._initiate_upload(index, sub)
        # a client without CRC may still check an offered one: offer it on request only
        with_crc = bool(data[0] & 4)
        self._transfer = _BlockUpload(index, sub, value, data[4], with_crc)
        return [_build_header(0xC2 | with_crc << 2, index, sub) + len(value).to_bytes(4, "little")]

    def _build_block(self, transfer: _BlockUpload) -> list[bytes]:
        """Return the segments of the next block, each with its sequence number, the very last one marked."""
        remaining = max(-(-(len(transfer.data) - transfer.position) // 7), 1)
        transfer.sent = min(remaining, transfer.block_size)
        frames = []
        for number in range(1, transfer.sent + 1):
            start = transfer.position + 7 * (number - 1)
            last = number == remaining
            frames.append(bytes([number | last << 7]) + transfer.data[start : start + 7].ljust(7, b"\0"))
        return frames

    def _accept_acknowledgement(self, transfer: _BlockUpload, received: int, block_size: int) -> list[bytes]:
        if received > transfer.sent:
            raise TransferAbort(AbortCode.COMMAND)
        if not 1 <= block_size <= 127:
            raise TransferAbort(AbortCode.BLOCK_SIZE)
        transfer.block_size = block_size
        all_sent = transfer.position + 7 * received >= len(transfer.data) and received == transfer.sent
        transfer.position += 7 * received
        if not all_sent:
            return self._build_block(transfer)
        transfer.ended = True
        unused = -len(transfer.data) % 7 if transfer.data else 7
        crc = binascii.crc_hqx(transfer.data, 0) if transfer.with_crc else 0
        return [bytes([0xC1 | unused << 2]) + crc.to_bytes(2, "little") + bytes(5)]


def _read_announced_size(entry: Entry, data: bytes) -> int:
    """Return the size announced by an initiate download request; TransferAbort if the object has another size."""
    size = int.from_bytes(data[4:8], "little")
    if size > MAX_DOWNLOAD_BYTES or (entry.size is not None and size != entry.size):
        raise TransferAbort(AbortCode.LENGTH)
    return size


def _check_toggle(transfer: _Upload | _Download, data: bytes) -> int:
    """Return the toggle bit of a segment request and expect the other one next."""
    toggle = data[0] >> 4 & 1
    if toggle != transfer.toggle:
        raise TransferAbort(AbortCode.TOGGLE)
    transfer.toggle ^= 1
    return toggle


def _build_header(command: int, index: int, sub: int) -> bytes:
    return bytes([command]) + index.to_bytes(2, "little") + bytes([sub])
