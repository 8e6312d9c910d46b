"""Serves JSON lines to a few clients on a UNIX socket; none of them can block the loop or exhaust its memory.

Each turn of the loop serves at most one request of one client. A client that does not read its answers is not served.
"""

import contextlib
import json
import os
import queue
import select
import socket
import struct
import threading
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdhil.errors import DeviceError
from fdhil.guard.guard_access import ClientProcess, GuardAccess, Role, read_peer_credentials
from fdhil.guard.guard_protocol import SOCKET_NAME
from fdhil.guard.request_parsing import Document, parse_line

MAX_CLIENTS = 8
MAX_LINE_BYTES = 1 << 15
MOST_DESCRIPTORS = 253  # the kernel's limit: what does not fit the buffer would be closed in this thread
ANCILLARY_BYTES = socket.CMSG_SPACE(MOST_DESCRIPTORS * 4)

LOOK_S = 1.0  # period of the check of the socket's file
AT_ONCE = struct.pack("ii", 1, 0)


class DescriptorCloser:
    """Closes descriptors in a thread, because closing a file on a hung server may block. Sockets do not linger.

    ``look`` is called in that thread whenever the queue was empty for LOOK_S.
    """

    def __init__(self, look: Callable[[], None] = lambda: None) -> None:
        self._look = look
        self._left: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._close_descriptors, name="closer", daemon=True)
        self._thread.start()  # now: later no thread may be available

    def close_later(self, descriptor: int) -> None:
        """Queue a descriptor to be closed."""
        self._left.put(descriptor)

    def _close_descriptors(self) -> None:
        while True:
            try:
                descriptor = self._left.get(timeout=LOOK_S)
            except queue.Empty:
                self._look()
                continue
            if descriptor is None:
                return
            with contextlib.suppress(OSError):  # not a socket
                sent = socket.socket(fileno=descriptor)
                try:
                    sent.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, AT_ONCE)
                finally:
                    sent.detach()
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def finish_closing(self) -> None:
        """Wait briefly for the queue to drain; the end of the process closes the rest."""
        self._left.put(None)
        self._thread.join(0.5)


@dataclass(slots=True, eq=False)
class GuardSocketClient:
    """One connection to the guard.

    ``last_request_s``: time of its last request (monotonic), ``armed``: whether it armed the correction.
    ``descriptor`` came with the requests that are read now; only a request that needs it takes it.
    """

    socket: socket.socket
    last_request_s: float
    closer: DescriptorCloser
    peer: ClientProcess
    inbox: bytes = b""
    outbox: bytearray = field(default_factory=bytearray)
    descriptor: int | None = None
    armed: bool = False
    gone: bool = False

    def fileno(self) -> int:
        """Return the descriptor, for poll."""
        return self.socket.fileno()

    def read_request(self, now_s: float) -> Document | None:
        """Return the next complete request, None when there is none; an invalid line is answered at once."""
        if b"\n" not in self.inbox:
            self._receive_bytes()
        line, newline, rest = self.inbox.partition(b"\n")
        if not newline:
            self.gone = self.gone or len(line) > MAX_LINE_BYTES
            return None
        self.inbox, self.last_request_s = rest, now_s
        document = parse_line(line)
        if document is None:
            self.queue_reply(
                {}, ok=False, code="BadRequest", text="the line is not a valid request", advice="send a JSON object"
            )
        return document

    def _receive_bytes(self) -> None:
        try:
            chunk, ancillary, _, _ = self.socket.recvmsg(MAX_LINE_BYTES, ANCILLARY_BYTES, socket.MSG_CMSG_CLOEXEC)
        except BlockingIOError:
            return
        except OSError:
            chunk, ancillary = b"", []
        for _, _, data in ancillary:
            for descriptor in array("i", data):
                self.release_descriptor()
                self.descriptor = descriptor
        self.gone = self.gone or not chunk  # a client that made room stays gone
        self.inbox += chunk

    def close_unclaimed_descriptor(self) -> None:
        """After a request, close a descriptor that none of the requests read so far has claimed."""
        if not self.inbox:
            self.release_descriptor()

    def release_descriptor(self) -> None:
        """Close the descriptor later."""
        if self.descriptor is not None:
            self.closer.close_later(self.descriptor)
            self.descriptor = None

    def queue_reply(self, request: Mapping[str, Any], **answer: Any) -> None:
        """Queue an answer to ``request``, with its ``id``."""
        if "id" in request:
            answer["id"] = request["id"]
        self.outbox += json.dumps(answer).encode() + b"\n"
        self.flush_replies()

    def flush_replies(self) -> None:
        """Send as much of the queued answers as the socket takes."""
        try:
            sent = self.socket.send(self.outbox) if self.outbox else 0
            del self.outbox[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self.gone = True

    def close(self) -> None:
        """Close the connection, including descriptors that were never claimed."""
        self.release_descriptor()
        self.closer.close_later(self.socket.detach())


class SocketListener:
    """A listening socket at ``path``, created again when its file is gone (a cleaned run directory).

    ``lost`` gives the reason when that fails, else it is empty. OSError when the socket cannot be created at all.
    """

    def __init__(self, path: Path, shared: bool) -> None:
        self.lost = ""
        self._path, self._mode = path, 0o660 if shared else 0o600
        self._name = (0, 0)
        self._renewed: socket.socket | None = None
        self.socket = self._open_listener()

    def _open_listener(self) -> socket.socket:
        made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            os.fchmod(made.fileno(), 0o600)  # from the beginning, whatever the umask
            self._path.unlink(missing_ok=True)  # the bus lock is ours already: no other guard listens here
            made.bind(str(self._path))
            self._path.chmod(self._mode)
            made.listen(MAX_CLIENTS)
            made.setblocking(False)
            found = self._path.lstat()
            self._name = found.st_dev, found.st_ino
        except OSError:
            made.close()
            raise
        return made

    def restore_socket_file(self) -> None:
        """Create the socket again when its file is gone or replaced; runs in a thread, disk access may block."""
        if self._renewed is not None or self._is_socket_file_ours():
            self.lost = ""
            return
        folder = self._path.parent
        try:
            with contextlib.suppress(FileExistsError):  # the daemon may create it first
                folder.mkdir(parents=True)
                folder.chmod(0o710 if self._mode == 0o660 else 0o700)
            if folder.stat().st_mode & 0o002:
                raise PermissionError(0, "its folder is writable for every user")
            self._renewed, self.lost = self._open_listener(), ""
        except OSError as error:
            self.lost = error.strerror or str(error)

    def _is_socket_file_ours(self) -> bool:
        try:
            found = self._path.lstat()
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == self._name

    def adopt_new_listener(self) -> None:
        """Switch to the socket that was created again, if there is one."""
        if self._renewed is not None:
            self.socket.close()
            self.socket, self._renewed = self._renewed, None


class GuardSocketServer:
    """The listening socket ``guard.sock`` and its clients; DeviceError when it cannot be created.

    Only the guard's user may open the file (0600), or its group too (0660) where ``access`` names other users. Users
    that it does not name get a refusal and are disconnected, and ``turned_away`` is called.
    """

    def __init__(
        self, run_directory: Path, access: GuardAccess, turned_away: Callable[[ClientProcess, object], None]
    ) -> None:
        self.path = run_directory / SOCKET_NAME
        self.clients: list[GuardSocketClient] = []
        self._access, self._turned_away = access, turned_away
        try:
            self._listener = SocketListener(self.path, access.shared)
        except OSError as error:
            text = f"the control socket cannot be created ({error.strerror or error}), and nothing is sent"
            raise DeviceError(str(self.path), f"{text}; check the run directory") from None
        self._closer = DescriptorCloser(self._listener.restore_socket_file)

    def fileno(self) -> int:
        """Return the listener's descriptor, for poll."""
        return self._listener.socket.fileno()

    @property
    def lost(self) -> str:
        """The reason why no client can connect any more; empty while clients can."""
        return self._listener.lost

    @property
    def pending(self) -> bool:
        """Whether requests are waiting that were already read."""
        return any(b"\n" in client.inbox and not client.outbox for client in self.clients)

    def register_sockets(self, poll: select.poll) -> None:
        """Have ``poll`` watch the listener and every client: for input, or for room while answers wait."""
        self._listener.adopt_new_listener()
        poll.register(self, select.POLLIN)
        for client in self.clients:
            poll.register(client, select.POLLOUT if client.outbox else select.POLLIN)

    def serve_one_client(self, ready: set[int], now_s: float) -> tuple[GuardSocketClient, Document] | None:
        """Accept one connection, and return one request of the client that has waited longest."""
        if self.fileno() in ready:
            self._accept_client(now_s)
        for client in [client for client in self.clients if not client.gone]:
            if client.fileno() in ready or (b"\n" in client.inbox and not client.outbox):
                self.clients.remove(client)
                self.clients.append(client)
                client.flush_replies()
                document = None if client.outbox else client.read_request(now_s)
                if document is not None:
                    return client, document
                client.close_unclaimed_descriptor()
                return None
        return None

    def _accept_client(self, now_s: float) -> None:
        """Accept one connection of an authorised user; when there are too many, the longest silent one is closed."""
        try:
            connection, _ = self._listener.socket.accept()
        except OSError:
            return
        connection.setblocking(False)
        pid, uid = read_peer_credentials(connection)
        client = GuardSocketClient(connection, now_s, self._closer, ClientProcess(uid, pid, self._access.get_role(uid)))
        if client.peer.role is Role.NOBODY:
            client.queue_reply({}, ok=False, **client.peer.describe_refusal(None))
            client.close()
            self._turned_away(client.peer, None)
            return
        if len(self.clients) >= MAX_CLIENTS:
            silent = min((c for c in self.clients if not c.armed), key=lambda c: c.last_request_s)
            silent.gone = True
        self.clients.append(client)

    def drop_gone(self) -> None:
        """Close and forget the clients that have disconnected."""
        for client in self.clients:
            if client.gone:
                client.close()
        self.clients = [client for client in self.clients if not client.gone]

    def close(self) -> None:
        """Close everything and remove the socket's file."""
        for client in self.clients:
            client.flush_replies()
            client.close()
        self.clients = []
        self._closer.finish_closing()
        self._listener.adopt_new_listener()
        self._listener.socket.close()
        with contextlib.suppress(OSError):
            self.path.unlink()
