"""A Modbus TCP connection through pymodbus, with its own deadline and one error per fault.

pymodbus repeats requests by itself (12 s of silence by default), logs every fault at ERROR and closes the line after a
few unanswered requests; none of it suits a sensor that is polled 20 times a second, so ``retries`` is 0, its logger is
quiet, and answers are validated here.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Awaitable, MutableSet
from weakref import WeakSet

from pymodbus import ModbusException
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.pdu import ModbusPDU

from fdhil.drivers.modbus.modbus_line import DamagedAnswer, ModbusAnswer, ModbusRefused, ModbusRequest, make_timeout
from fdhil.drivers.modbus.rtu_frames import (
    BIT_READS,
    READ_COILS,
    READ_DISCRETE,
    READ_HOLDING,
    READ_INPUT,
    WRITE_REGISTER,
    describe_foreign_unit,
)
from fdhil.errors import ConnectError, DeviceError

CONNECT_S = 2.0  # in addition to the answer's time-out
SILENT_ADVICE = "check the device and its line; a serial server that passes RTU frames needs framing = 'rtu'"
ANY_UNIT = 0  # of a device without a gateway
LIBRARYS_OWN_S = 100.0  # its only time-out, longer than any of ours

logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class _UnreadableBytes(ModbusException):
    """Bytes came that the library cannot read."""


class _OtherUnit(ModbusException):
    def __init__(self, unit: int) -> None:
        super().__init__(f"unit {unit}")
        self.unit = unit


class TcpLine:
    """A connection to ``host``:``port``, a sensor or a gateway to several."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._where = f"{host}:{port}"
        self.place = f"Modbus {host}:{port}"
        self.users: MutableSet[object] = WeakSet()
        self.fault_counts: Counter[str] = Counter()
        self._client: AsyncModbusTcpClient | None = None
        self._turn = asyncio.Lock()

    @property
    def is_connected(self) -> bool:
        return self._client is not None and bool(self._client.connected)

    async def connect(self, name: str, timeout_s: float) -> None:
        async with self._turn:
            if self.is_connected:
                return
            self.close()
            connected = False
            self._client = AsyncModbusTcpClient(
                self._host, port=self._port, timeout=LIBRARYS_OWN_S, retries=0, reconnect_delay=0
            )
            _end_wait_at_unreadable_bytes(self._client)
            _refuse_other_units(self._client)
            try:
                async with asyncio.timeout(timeout_s + CONNECT_S):
                    connected = await self._client.connect()
            except TimeoutError:
                pass
            if not connected:
                text = f"the Modbus device {self._where} cannot be reached; check its supply, host and port"
                raise ConnectError(name, text)

    async def send_request(self, request: ModbusRequest) -> ModbusAnswer:
        async with self._turn:
            asked_ns = time.monotonic_ns()
            answer = await self.await_answer(self._call_library(request), request)
            answered_ns = time.monotonic_ns()
        if answer.function_code != request.function:
            text = f"function {answer.function_code} was answered instead of {request.function}; compare host and port"
            raise DamagedAnswer(request.name, "ModbusShape", text)
        came = answer.bits if request.function in BIT_READS else answer.registers
        registers = tuple(map(int, came)) if request.count else ()
        spare = -request.count % 8 if request.function in BIT_READS else 0  # bits are padded to whole bytes
        if len(registers) != request.count + spare:
            what = "bits" if request.function in BIT_READS else "registers"
            text = f"{len(registers)} {what} came instead of {request.count}; check that only one client sends requests"
            raise DamagedAnswer(request.name, "ModbusShape", text)
        return ModbusAnswer(registers[: request.count], asked_ns, answered_ns)

    async def _call_library(self, request: ModbusRequest) -> ModbusPDU:
        client = self._client
        if client is None:
            raise self._make_gone_error(request)
        if request.function == WRITE_REGISTER:
            return await client.write_register(request.address, request.value, device_id=request.unit)
        reads = {
            READ_COILS: client.read_coils,
            READ_DISCRETE: client.read_discrete_inputs,
            READ_HOLDING: client.read_holding_registers,
            READ_INPUT: client.read_input_registers,
        }
        return await reads[request.function](request.address, count=request.value, device_id=request.unit)

    async def await_answer(self, call: Awaitable[ModbusPDU], request: ModbusRequest) -> ModbusPDU:
        """Wait for the library's answer until the request's deadline."""
        try:
            async with asyncio.timeout(request.timeout_s):
                answer = await call
        except TimeoutError:
            raise self._make_silence_error(request) from None
        except _OtherUnit as error:
            self.fault_counts["ModbusUnit"] += 1
            raise DamagedAnswer(request.name, "ModbusUnit", describe_foreign_unit(error.unit, request.unit)) from None
        except _UnreadableBytes:
            self.close()
            text = "the answer is not Modbus TCP: the connection is restarted; compare host and port"
            raise DamagedAnswer(request.name, "ModbusShape", text) from None
        except ModbusException as error:
            raise self._make_silence_error(request) from error
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            # the library uses wait_for, which in Python 3.11 loses a cancellation that meets the answer
            raise asyncio.CancelledError
        if answer.isError():
            raise ModbusRefused(request.name, request.address, int(answer.exception_code))
        return answer

    def _make_gone_error(self, request: ModbusRequest) -> ConnectError:
        text = f"the connection to the Modbus device {self._where} is gone"
        text += "; check its supply and cable, and its limit of clients"
        return ConnectError(request.name, text)

    def _make_silence_error(self, request: ModbusRequest) -> DeviceError:
        if not self.is_connected:  # closed by the device, which the library does not report to the waiting task
            self.close()
            return self._make_gone_error(request)
        # a late answer must not be taken for the next one's: reconnect
        self.close()
        return make_timeout(request, SILENT_ADVICE)

    def close(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


def _end_wait_at_unreadable_bytes(client: AsyncModbusTcpClient) -> None:
    """Fail the pending request when bytes come that the library cannot read: it raises in the event loop instead."""
    wire = client.ctx
    read = wire.callback_data

    def take_bytes(data: bytes, addr: tuple[str, int] | None = None) -> int:
        try:
            return read(data, addr)
        except ModbusException as error:
            if not wire.response_future.done():
                wire.response_future.set_exception(_UnreadableBytes(str(error)))
                wire.response_future.exception()  # retrieved, since no task may be waiting any more
            return len(data)

    wire.callback_data = take_bytes  # type: ignore[method-assign] # the library has no hook for it


def _refuse_other_units(client: AsyncModbusTcpClient) -> None:
    """Fail the pending request when another unit answers it: the library skips the answer and waits for ever.

    Its transaction number shows that it answers this request.
    """
    wire = client.ctx
    framer, decode = wire.framer, wire.framer.decode

    def decode_and_check_unit(data: bytes) -> tuple[int, int, int, bytes]:
        size, unit, transaction, body = decode(data)
        is_ours = body and transaction == wire.request_transaction_id
        if is_ours and unit != wire.request_dev_id != ANY_UNIT and not wire.response_future.done():
            wire.response_future.set_exception(_OtherUnit(unit))
            wire.response_future.exception()  # retrieved, since no task may be waiting any more
        return size, unit, transaction, body

    framer.decode = decode_and_check_unit  # type: ignore[method-assign, assignment] # the library has no hook for it
