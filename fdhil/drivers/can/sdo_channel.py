"""Reads and writes objects of one node through the canopen library's SDO client, with limits on size and time.

The library limits neither size nor duration, and takes a late answer to an earlier request of the same object for the
answer to the present one. So after a time-out, and after an answer to another request (another program's, perhaps), the
channel stays quiet until no late answer can come, and the object is then read twice: two equal answers, or an error.
"""

import logging
import operator
import queue
import time
from collections.abc import Callable
from typing import Any

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from fdhil.cia402 import COB_SDO_REQUEST, COB_SDO_RESPONSE
from fdhil.errors import DeviceTimeout, ProtocolError, SdoAbort, SdoTimeout, SdoToggle, SdoTooLarge

RESPONSE_TIMEOUT_S = 0.5
QUIET_S = 1.0
DEADLINE_S = 2.0
MAX_BYTES = 64 * 1024
NO_OBJECT = 0x06020000
NO_SUB_INDEX = 0x06090011
_UPLOAD_BEGINS, _EXPEDITED, _SIZE_GIVEN = 2, 2, 1
_DEADLINE_ABORT = 0x05040000
_MEMORY_ABORT = 0x05040005

logging.getLogger("canopen").setLevel(logging.CRITICAL)


def _format_object(index: int, sub: int) -> str:
    return f"0x{index:04X}:{sub:02X}"


class SdoChannel:
    """The SDO channel of one node. ``deliver_response`` is called by the bus reader, all else by one other thread.

    ``send`` puts a frame on the bus; ``patience`` multiplies the time-outs, for a slow simulated drive.
    """

    def __init__(self, device: str, node_id: int, send: Callable[[int, bytes], None], patience: float = 1.0) -> None:
        self._patience = patience
        self.device = device
        self.response_id = COB_SDO_RESPONSE + node_id
        self._send = send
        # the library has no annotations
        client: Any = SdoClient
        dictionary: Any = ObjectDictionary
        self._client = client(COB_SDO_REQUEST + node_id, self.response_id, dictionary())
        self._client.network = self
        self._client.RESPONSE_TIMEOUT = RESPONSE_TIMEOUT_S * patience
        self._late = False
        self._sized = True

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send for the library's client; remote frames are never sent."""
        self._send(can_id, bytes(data))

    def deliver_response(self, data: bytes) -> None:
        """Hand over a response frame of this node; one that is not 8 bytes long is no SDO frame."""
        if len(data) == 8:
            if data[0] >> 5 == _UPLOAD_BEGINS:
                self._sized = bool(data[0] & _SIZE_GIVEN) or not data[0] & _EXPEDITED
            self._client.on_response(self.response_id, data, 0.0)

    def read_bytes(self, index: int, sub: int = 0) -> bytes:
        """Read an object; SdoAbort, DeviceTimeout or ProtocolError."""
        try:
            return self._upload_object(index, sub)
        except (DeviceTimeout, ProtocolError):
            if not self._late:
                raise
            first, second = self._upload_object(index, sub), self._upload_object(index, sub)
            if first != second:
                text = (
                    f"{_format_object(index, sub)} gave two answers after a time-out; "
                    "check that only one master sends requests"
                )
                raise ProtocolError(self.device, text) from None
            return second

    def read_size(self, index: int, sub: int = 0) -> int | None:
        """Return the size of an object in bytes; None where the answer does not state it (CiA 301, 7.2.4.3.5)."""
        data = self.read_bytes(index, sub)
        return len(data) if self._sized else None

    def read_int(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        return int.from_bytes(self.read_bytes(index, sub), "little", signed=signed)

    def write_int(self, index: int, sub: int, value: int, length: int) -> None:
        """Write an integer of ``length`` bytes; after a time-out, read back whether it arrived.

        TypeError when ``value`` is no integer, ValueError when it does not fit.
        """
        number = operator.index(value)  # the library would silently truncate 1.7
        if not -(1 << 8 * length - 1) <= number < 1 << 8 * length:
            raise ValueError(f"{number} does not fit {length} bytes")
        data = (number & (1 << 8 * length) - 1).to_bytes(length, "little")
        try:
            self._translate_errors(index, sub, lambda: self._client.download(index, sub, data))
        except (DeviceTimeout, ProtocolError):
            if not self._late:
                raise
            if self._upload_object(index, sub) == data == self._upload_object(index, sub):
                return
            self._translate_errors(index, sub, lambda: self._client.download(index, sub, data))

    def _wait_for_silence(self) -> None:
        time.sleep(QUIET_S)
        self._client.responses = queue.Queue()
        self._late = False

    def _upload_object(self, index: int, sub: int) -> bytes:
        data: bytes = self._translate_errors(index, sub, lambda: self._read_segments(index, sub))
        return data

    def _read_segments(self, index: int, sub: int) -> bytes:
        deadline = time.monotonic() + DEADLINE_S * self._patience
        data = bytearray()
        with self._client.open(index, sub, "rb", buffering=0) as stream:
            size = stream.size or 0  # some drives announce it
            while size <= MAX_BYTES:
                part = stream.read(7)
                if not part:
                    return bytes(data)
                data += part
                size = max(size, len(data))
                if time.monotonic() > deadline:
                    self._client.abort(_DEADLINE_ABORT)
                    text = f"{_format_object(index, sub)} was not finished after {DEADLINE_S:g} s; check the bus load"
                    raise SdoTooLarge(self.device, text)
            self._client.abort(_MEMORY_ABORT)
        text = (
            f"{_format_object(index, sub)} is longer than {MAX_BYTES} bytes; "
            "no object of a working drive is; check the drive"
        )
        raise SdoTooLarge(self.device, text)

    def _translate_errors(self, index: int, sub: int, call: Any) -> Any:
        if self._late:
            self._wait_for_silence()
        try:
            return call()
        except SdoAbortedError as abort:
            reason = SdoAbortedError.CODES.get(abort.code, "unknown reason").lower()
            text = f"{_format_object(index, sub)} was refused ({reason}, {abort.code:08X}); compare the drive's manual"
            raise SdoAbort(self.device, text, abort.code) from None
        except SdoCommunicationError as error:
            if "No SDO response" in str(error) or "could not be retransmitted" in str(error):
                self._late = True
                text = f"{_format_object(index, sub)} was not answered; check the drive's supply and its node-ID"
                raise SdoTimeout(self.device, text) from None
            self._late = True
            text = (
                f"{_format_object(index, sub)} got a wrong answer ({error}); check that only one master sends requests"
            )
            kind = SdoToggle if "toggle" in str(error).lower() else ProtocolError
            raise kind(self.device, text) from None
