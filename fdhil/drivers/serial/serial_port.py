"""A serial port as a stream of bytes; the only module that uses pyserial."""

import asyncio
import os
import termios
import time
from pathlib import Path

import serial

from fdhil.config import SerialDevice
from fdhil.drivers.serial.byte_stream import ByteStream
from fdhil.errors import ConnectError

_PARITY = {"even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD, "none": serial.PARITY_NONE}


class SerialPort(ByteStream):
    """A device opened exclusively. ``name`` is the sensor's, for messages.

    A pseudo terminal has neither rate nor parity: ``compute_wire_ns`` is 0 there.
    """

    def __init__(self, place: SerialDevice) -> None:
        super().__init__()
        self.device = place.device
        self.where = f"the serial device {place.device}"
        self._place = place
        bits = 1 + 8 + (place.parity != "none") + place.stop_bits
        self.character_s = bits / place.baud_rate
        self._is_pty = os.path.realpath(place.device).startswith("/dev/pts/")
        self._serial: serial.Serial | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    @property
    def is_open(self) -> bool:
        return self._serial is not None and not self._gone

    def compute_wire_ns(self, count: int) -> int:
        return 0 if self._is_pty else super().compute_wire_ns(count)

    async def connect(self, name: str, timeout_s: float) -> None:
        self.open(name)

    def open(self, name: str) -> None:
        """Open the device; ConnectError when it is missing, not permitted, or used by another program."""
        self.close()
        self._is_pty = os.path.realpath(self.device).startswith("/dev/pts/")
        try:
            self._serial = serial.Serial(
                self.device,
                self._place.baud_rate,
                parity=serial.PARITY_NONE if self._is_pty else _PARITY[self._place.parity],
                stopbits=self._place.stop_bits,
                timeout=0,
                exclusive=True,
            )
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
            raise ConnectError(name, f"{self._explain_open_error(error)}") from error
        self._gone = ""
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._serial.fileno(), self._read_available)

    def _explain_open_error(self, error: Exception) -> str:
        if not Path(self.device).exists():
            return f"serial device {self.device} does not exist; plug the adapter in, or correct device"
        if not os.access(self.device, os.R_OK | os.W_OK):
            return f"the serial device {self.device} is not permitted; add the user to the group dialout"
        if isinstance(error, serial.SerialException) and "lock" in str(error):
            return f"the serial device {self.device} is used by another program; end that (fdhil run uses it, too)"
        return f"the serial device {self.device} cannot be opened ({error}); check that it is a serial line"

    def _read_available(self) -> None:
        assert self._serial is not None
        try:
            data = os.read(self._serial.fileno(), 4096)
        except BlockingIOError:
            return
        except OSError as error:
            self._end_stream(error.strerror or str(error))
            return
        if not data:
            self._end_stream("it was unplugged")
            return
        self._store_bytes(data)

    def _end_stream(self, why: str) -> None:
        super()._end_stream(why)
        self._stop_reading()

    def send(self, name: str, data: bytes) -> int:
        port = self._require_open(name)
        try:
            written = os.write(port.fileno(), data)
        except OSError as error:
            self._end_stream(error.strerror or str(error))
            raise self._make_gone_error(name) from error
        if written != len(data):
            self._end_stream("it accepts no more bytes")
            raise self._make_gone_error(name)
        return time.monotonic_ns()

    def _require_open(self, name: str) -> serial.Serial:
        if self._serial is None or self._gone:
            raise self._make_gone_error(name)
        return self._serial

    def _stop_reading(self) -> None:
        if self._serial is not None and self._loop is not None and not self._loop.is_closed():
            self._loop.remove_reader(self._serial.fileno())

    def close(self) -> None:
        if self._serial is not None:
            if not self._gone:
                self._stop_reading()
            self._serial.close()
        self._serial, self._gone = None, ""
        self.discard_input()
