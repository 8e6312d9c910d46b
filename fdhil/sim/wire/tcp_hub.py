"""Serves a CAN bus on TCP in the text protocol of socketcand, so that any python-can program can join the bus.

    client -> hub   < open can0 >   < rawmode >   < echo >   < send 181 2 a ff >
    hub -> client   < hi >          < ok >        < ok >     < frame 181 1700000000.000000 0AFF >

A client's frames reach every other client and the simulator, but not the client itself, as on SocketCAN. Every frame is
padded with blanks inside its brackets to 64 bytes: python-can reads 1024 bytes at a time, so that no frame is split.
Nothing is lost: each client has a queue, and while one queue is full the hub accepts no frames from anyone and reports
it (:attr:`Hub.congested`); a client that reads nothing for ``STALL_S`` is then disconnected.
"""

import errno
import socket
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from fdhil.errors import ConnectError
from fdhil.sim.frame_types import EXTENDED, Frame
from fdhil.sim.wire.bus_attachment import BusAttachment, Handler

QUEUE_BYTES = 8 << 20
STALL_S = 5.0
_MAX_COMMAND = 4096
_CHUNK = 1 << 16
_ONE_MORE = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR})


def encode_frames(frames: Sequence[Frame], stamp_s: float) -> bytes:
    """Return the frames as the hub sends them, 64 bytes each, all with the time stamp ``stamp_s`` (Unix time)."""
    stamp = f"{stamp_s:.6f}"
    text = []
    for can_id, data in frames:
        name = f"{can_id:03X}" if can_id < EXTENDED else f"{can_id & 0x1FFFFFFF:08X}"
        text.append(f"< frame {name} {stamp} {data.hex().upper()}".ljust(62) + " >")
    return "".join(text).encode("ascii")


def decode_send_command(command: bytes) -> Frame | None:
    """Return the frame of a ``send`` command (without its closing bracket), None when it is malformed.

    >>> decode_send_command(b"< send 181 2 a ff ")
    (385, b'\\n\\xff')
    """
    words = command.split()
    try:
        can_id, length = int(words[2], 16), int(words[3], 16)
        data = bytes([int(word, 16) for word in words[4:]])
    except (IndexError, ValueError):
        return None
    extended = len(words[2]) > 3
    if length > 8 or len(data) != length or not 0 <= can_id <= (0x1FFFFFFF if extended else 0x7FF):
        return None
    return can_id | EXTENDED if extended else can_id, data


@dataclass(slots=True, eq=False)
class _Client:
    """One connection; ``raw`` once it receives frames."""

    socket: socket.socket
    inbox: bytearray = field(default_factory=bytearray)
    outbox: bytearray = field(default_factory=bytearray)
    opened: bool = False
    raw: bool = False
    gone: bool = False
    sends: bool = False
    moved_s: float = 0.0


class TcpHub(BusAttachment):
    """The bus ``channel`` on a TCP port of ``host``, port 0 for any free one; ConnectError when it cannot be opened.

    Not thread-safe: one loop selects on :meth:`readers` and :meth:`writers`, calls :meth:`pump`, then :meth:`flush`.
    ``lost_clients`` counts the clients disconnected because they read nothing, ``senders_left`` those that left after
    sending frames, ``malformed`` the invalid commands.
    """

    def __init__(self, channel: str, host: str = "127.0.0.1", port: int = 0, queue_bytes: int = QUEUE_BYTES) -> None:
        self.channel = channel
        self.lost_clients = 0
        self.malformed = 0
        self._queue_bytes = queue_bytes
        self._clients: list[_Client] = []
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((host, port))
            self._listener.listen(64)
        except OSError as error:
            self._listener.close()
            raise ConnectError(
                f"bus {channel}",
                f"TCP port {port} of {host} cannot be opened ({error.strerror or error}); end its program, "
                "or set another port (0 lets the simulator choose one)",
            ) from None
        self._listener.setblocking(False)
        self.host, self.port = self._listener.getsockname()[:2]
        self.settings = {"interface": "socketcand", "channel": channel, "host": self.host, "port": self.port}

    @property
    def is_congested(self) -> bool:
        """Whether a client's queue is full: no more frames may be produced until it has been read."""
        return any(len(client.outbox) > self._queue_bytes for client in self._clients)

    @property
    def has_clients(self) -> bool:
        return bool(self._clients)

    @property
    def clients(self) -> int:
        return sum(client.raw for client in self._clients)

    def list_readers(self) -> list[socket.socket]:
        return [self._listener] if self.is_congested else [self._listener, *(c.socket for c in self._clients)]

    def list_writers(self) -> list[socket.socket]:
        """Return the sockets to select for writing: those with data in the queue."""
        return [client.socket for client in self._clients if client.outbox]

    def receive_frames(self, ready: Sequence[object], handler: Handler) -> None:
        """Read the sockets among ``ready``; each frame goes to the other clients, then to ``handler``, in order."""
        if self._listener in ready:
            self._accept_client()
        for client in tuple(self._clients):
            if client.socket in ready:
                self._read_client(client, handler)

    def relay_frame(self, frame: Frame, sender: object) -> None:
        if len(self._clients) > 1:
            self.queue_frames((frame,), sender)

    def disconnect_clients(self) -> None:
        for client in self._clients:
            client.gone = True

    def queue_frames(self, frames: Sequence[Frame], sender: object = None) -> None:
        if not self._clients:
            return
        text = encode_frames(frames, time.time())
        for client in self._clients:
            if client.raw and client is not sender:
                client.outbox += text

    def flush_frames(self, now_s: float) -> None:
        for client in self._clients:
            if client.outbox:
                self._write_client(client, now_s)
        if any(client.gone for client in self._clients):
            for client in self._clients:
                if client.gone:
                    client.socket.close()
                    self.senders_left += client.sends
            self._clients = [client for client in self._clients if not client.gone]

    def close(self) -> None:
        for client in self._clients:
            client.socket.close()
        self._clients.clear()
        self._listener.close()

    def _accept_client(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError as error:  # the client has left already, or descriptors are exhausted
            if error.errno not in _ONE_MORE and error.errno not in (errno.ECONNABORTED, errno.EMFILE):
                raise
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection, moved_s=time.monotonic())
        client.outbox += b"< hi >"
        self._clients.append(client)

    def _read_client(self, client: _Client, handler: Handler) -> None:
        try:
            chunk = client.socket.recv(_CHUNK)
            # the stock client leaves Nagle on: without a quick acknowledgement its next frame is delayed by 40 ms
            client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        except OSError as error:
            client.gone = error.errno not in _ONE_MORE
            return
        if not chunk:
            client.gone = True
            return
        client.inbox += chunk
        *commands, rest = bytes(client.inbox).split(b">")
        client.inbox = bytearray(rest)
        for command in commands:
            self._handle_command(client, command, handler)
        if len(client.inbox) > _MAX_COMMAND:  # not a client of this protocol
            self.malformed += 1
            client.gone = True

    def _handle_command(self, client: _Client, command: bytes, handler: Handler) -> None:
        words = command.split(None, 2)
        if client.raw and words[:2] == [b"<", b"send"]:
            frame = decode_send_command(command)
            if frame is None:
                self.malformed += 1
                return
            client.sends = True
            for each, sender in self.apply_faults(frame, client):
                self.relay_frame(each, sender)
                handler(each)
        else:
            self._answer_greeting(client, [word.decode("ascii", "replace") for word in command.split()[1:]])

    def _answer_greeting(self, client: _Client, words: list[str]) -> None:
        """Answer the commands that lead to raw mode; the answers precede any frame in the queue."""
        answer = b"< ok >"
        if words == ["open", self.channel] and not client.opened:
            client.opened = True
        elif words == ["rawmode"] and client.opened and not client.raw:
            client.outbox += answer
            self._write_client(client, time.monotonic())
            self._mark_end_of_greeting(client)
            client.raw = True
            return
        elif words == ["echo"]:
            answer = b"< echo >"
        elif words[:1] == ["open"]:
            answer = b"< error could not open bus >"
        else:
            self.malformed += 1
            answer = b"< error unknown command >"
        client.outbox += answer

    def _mark_end_of_greeting(self, client: _Client) -> None:
        """Keep the frames out of the recv that reads the last greeting, however late the client calls it.

        The stock client reads each greeting with one recv and expects nothing else in it. A recv never reads across the
        mark of urgent data (RFC 6093), and the urgent byte itself does not appear in the stream.
        """
        with suppress(OSError):
            client.socket.send(b" ", socket.MSG_OOB)

    def _write_client(self, client: _Client, now_s: float) -> None:
        try:
            sent = client.socket.send(client.outbox)
        except OSError as error:
            sent = 0
            client.gone = error.errno not in _ONE_MORE
        if sent:
            del client.outbox[:sent]
            client.moved_s = now_s
        elif len(client.outbox) > self._queue_bytes and now_s - client.moved_s > STALL_S:
            self.lost_clients += 1
            client.gone = True
