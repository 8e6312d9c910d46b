"""Serves the control socket: one JSON object per line for each request and answer, over a UNIX socket.

A request is {"request": "status" | "live" | "arm" | "disarm" | "stop", ...}; an answer is {"ok": true, ...} or {"ok":
false, "code", "text", "advice"}. With "progress": true, lines {"progress": {...}} precede an answer that takes time;
closing the connection meanwhile abandons the check of an arm request. The kernel identifies the client, and the config
assigns its rights (``daemon_access``); arming also needs the operator's token. After the answer to ``live`` the
connection
streams samples (``fdhil.daemon.live_stream``). When all sixteen connections are in use, the longest idle one makes
room; where all wait for answers, four more clients may send ``status`` and ``disarm``.
"""

import asyncio
import contextlib
import select
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeVar

from fdhil.arming import CHECK_ABANDONED, Answer, make_refusal, make_run_directory
from fdhil.cancellation import END_S, end_tasks
from fdhil.config import Access
from fdhil.daemon.daemon_access import ClientProcess, identify_peer, open_listener
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, FdhilError
from fdhil.guard import Role
from fdhil.json_lines import decode_line, encode_line

SOCKET_NAME = "daemon.sock"
MAX_LINE = 64 * 1024
MAX_CLIENTS = 16
RESERVE = 4  # extra clients, for ALWAYS_HEARD while all others wait for answers
ALWAYS_HEARD = ("disarm", "status")
IDLE_S = 60.0
LOOK_S = 1.0  # period of the check of the socket's file
PROGRESS_S = 0.5

Handler = Callable[[Mapping[str, Any], ClientProcess], Awaitable[Answer]]
Progress = Callable[[], Mapping[str, Any] | None]
Stream = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
FileId = tuple[int, int]
Done = TypeVar("Done")


class ControlServer:
    """Passes requests to ``handle``; each client has its own task, so that a slow or dead one delays no other."""

    def __init__(
        self,
        handle: Handler,
        progress: Progress,
        abandon: Callable[[], object],
        access: Access,
        live: Stream | None = None,
        lost: Callable[[str], Awaitable[object]] | None = None,
    ) -> None:
        """Serve users with ``access``; ``progress`` describes a long check, ``abandon`` ends it.

        ``lost`` is called when the socket's file has gone: with "" once it was created again, else with the reason.
        ``live`` serves a connection after the answer that opens it as a stream.
        """
        self._handle, self._progress, self._abandon, self._access = handle, progress, abandon, access
        self._live, self._lost = live, lost
        # all clients, the longest idle first, and those that wait for an answer
        self._clients: dict[asyncio.Task[None], None] = {}
        self._busy: set[asyncio.Task[None]] = set()
        self._arming: list[asyncio.StreamWriter] = []  # clients that wait to arm; the check is for the first

    @property
    def is_armer_gone(self) -> bool:
        """Whether the client whose arm request is checked has disconnected; safe in any thread."""
        return any(map(_is_hung_up, self._arming[:1]))

    @asynccontextmanager
    async def serve_socket(self, path: Path) -> AsyncIterator[None]:
        """Listen at ``path`` until the block ends; replaces a socket file left by a crash. ConnectError."""
        try:
            listener = open_listener(path, self._access)
        except OSError as error:
            text = f"cannot be opened: {error.strerror or error}; set another [store] run_directory"
            raise ConnectError(str(path), text) from None
        self._server = await self._start_server(listener)
        keeping = asyncio.create_task(self._keep_socket_file(path, _read_file_id(path)), name="control socket")
        try:
            yield
        finally:
            await end_tasks([keeping], END_S)
            self._server.close()
            for task in list(self._clients):
                task.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)
            with contextlib.suppress(OSError):  # the next daemon replaces a file that stays
                path.unlink()

    async def _start_server(self, listener: socket.socket) -> asyncio.Server:
        return await asyncio.start_unix_server(self._serve_client, sock=listener, limit=MAX_LINE)

    async def _keep_socket_file(self, path: Path, name: FileId | None) -> None:
        """Create the socket again when its file is gone or replaced, as in a cleaned run directory."""
        while True:
            listener = await self._wait_for_new_listener(path, name)
            before, self._server = self._server, await self._start_server(listener)
            before.close()
            name = await asyncio.to_thread(_read_file_id, path)
            await self._report_lost_socket("")

    async def _wait_for_new_listener(self, path: Path, name: FileId | None) -> socket.socket:
        """Wait until the file is gone; return the listener that replaces it as soon as one can be created."""
        trouble = ""
        while True:
            await asyncio.sleep(LOOK_S)
            if name is not None and await asyncio.to_thread(_read_file_id, path) == name:
                continue
            try:
                await asyncio.to_thread(make_run_directory, path.parent)
                return await asyncio.to_thread(open_listener, path, self._access)
            except (DeviceError, OSError) as error:
                if not trouble:
                    trouble = str(error)
                    await self._report_lost_socket(trouble)

    async def _report_lost_socket(self, trouble: str) -> None:
        if self._lost is not None:
            await self._lost(trouble)

    async def _serve_client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if not self._make_room():
            writer.close()
            return
        self._clients[task] = None
        try:
            await self._answer_client(task, reader, writer)
        except (OSError, asyncio.LimitOverrunError, ValueError, TimeoutError):
            pass  # a client that left, sends too much or never reads loses only its connection
        except asyncio.CancelledError:
            pass  # the daemon stops, or made room; the stream's own callback must not see it
        finally:
            self._clients.pop(task, None)
            self._busy.discard(task)
            writer.close()

    def _make_room(self) -> bool:
        """Return whether one more client may connect; close the longest idle connection for it."""
        if len(self._clients) < MAX_CLIENTS:
            return True
        idle = next((client for client in self._clients if client not in self._busy), None)
        if idle is not None:
            self._clients.pop(idle)
            idle.cancel()
        return len(self._clients) < MAX_CLIENTS + RESERVE

    async def _answer_client(
        self, task: asyncio.Task[None], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        peer = identify_peer(writer.get_extra_info("socket"), self._access)
        while line := await _await_client(reader.readline()):
            self._busy.add(task)
            answer = await self._answer_line(line, peer, writer)
            self._busy.discard(task)
            self._clients[task] = self._clients.pop(task, None)
            writer.write(encode_line(answer))
            await _await_client(writer.drain())
            if self._live is not None and "live" in answer:
                self._busy.add(task)  # a stream is never idle: it is not closed for others
                await self._live(reader, writer)
                return
            if peer.role is Role.NOBODY:
                return

    async def _answer_line(self, line: bytes, peer: ClientProcess, writer: asyncio.StreamWriter) -> Answer:
        """Answer a request; during an arm request report progress and check that the client still waits."""
        request = decode_line(line)
        if request is None:
            return make_refusal("BadRequest", "the request is not a JSON object", "send one JSON object per line")
        if request.get("request") != "arm" or not peer.may_request("arm"):
            return await self._answer_request(request, peer)
        if _is_hung_up(writer):
            return CHECK_ABANDONED  # the client left while this process was suspended
        answering = asyncio.ensure_future(self._answer_request(request, peer))
        self._arming.append(writer)
        try:
            while not (await asyncio.wait([answering], timeout=PROGRESS_S))[0]:
                if self._arming[0] is writer:
                    self._report_progress(writer, request.get("progress") is True)
            return await answering
        finally:
            answering.cancel()
            self._arming.remove(writer)

    def _report_progress(self, writer: asyncio.StreamWriter, wanted: bool) -> None:
        """Report the progress of a check to the client; abandon the check when the client has gone."""
        if _is_hung_up(writer):
            self._abandon()
        elif wanted and (progress := self._progress()):
            writer.write(encode_line({"progress": progress}))

    async def _answer_request(self, request: Mapping[str, Any], peer: ClientProcess) -> Answer:
        if not isinstance(request.get("request"), str):
            return make_refusal(
                "BadRequest", "the request has no text under the key 'request'", "status, arm, disarm or stop"
            )
        if len(self._busy) > MAX_CLIENTS and request["request"] not in ALWAYS_HEARD:
            return make_refusal("Busy", f"{MAX_CLIENTS} other requests are pending", "wait for one of them to end")
        try:
            return await self._handle(request, peer)
        except FdhilError as error:
            text, _, advice = str(error).partition("; ")
            return make_refusal(type(error).__name__, text, advice) | {"exit_code": error.exit_code}


def _read_file_id(path: Path) -> FileId | None:
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _is_hung_up(writer: asyncio.StreamWriter) -> bool:
    """Return whether the other end is fully closed, not only its sending side."""
    poll = select.poll()
    try:
        poll.register(writer.get_extra_info("socket"), 0)
    except ValueError:  # the client left during an answer, and is closed here too
        return True
    return bool(poll.poll(0))


async def _await_client(doing: Awaitable[Done]) -> Done:
    """Wait for a client, at most its idle time; TimeoutError. Keeps a cancellation, which wait_for may lose."""
    async with asyncio.timeout(IDLE_S):
        return await doing


def ask_daemon(
    path: Path,
    request: Mapping[str, Any],
    timeout_s: float = 10.0,
    progress: Callable[[Mapping[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Send one request to a running daemon and return its answer (blocking; for the command line).

    With ``progress`` the daemon reports its progress, and each report is passed to it. ConnectError when no daemon
    listens, DeviceTimeout when it does not answer.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(timeout_s)
            client.connect(str(path))
            wanted = {"progress": True} if progress else {}
            client.sendall(encode_line({**request, **wanted}))
            with client.makefile("rb") as lines:
                line = lines.readline()
                while progress and line.startswith(b'{"progress"') and (report := decode_line(line)):
                    progress(report["progress"])
                    line = lines.readline()
    except TimeoutError:
        text = f"did not answer within {timeout_s:.0f} s; see its log"
        raise DeviceTimeout("daemon", text) from None
    except OSError as error:
        absent = f"is not running ({path}: {error.strerror or error}); start it with `fdhil run CONFIG`"
        raise ConnectError.from_socket_error("daemon", error, absent) from None
    if not line:
        raise ConnectError("daemon", "closed the connection without an answer; see its log")
    answer = decode_line(line)
    if answer is None:
        raise ConnectError("daemon", f"sent an invalid answer; see what listens at {path}")
    return answer
