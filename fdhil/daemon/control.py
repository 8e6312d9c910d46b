"""Serves the control socket: one JSON object per line and request, one per answer, over a UNIX socket.

A request is {"request": "status" | "live" | "arm" | "disarm" | "stop", ...}; an answer is {"ok": true, ...} or
{"ok": false, "code", "text", "advice"}. With "progress": true lines {"progress": {...}} come before an answer that
takes its time; who asks to arm and closes the connection meanwhile abandons what is checked for him. Who is at the
other end is what the kernel says, and what he may ask for what the config says (``peers``); arming needs the operator's
token besides. After the answer to ``live`` the connection tells the samples as they pass (``fdhil.daemon.live``). Of
sixteen connections the one that has been idle for longest makes room for one more; where all wait for their answers,
four more may ask for ``status`` and ``disarm``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import select
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeVar

from fdhil.arming.answers import ABANDONED, Answer, refusal
from fdhil.arming.token import make_directory
from fdhil.cancellation import END_S, end_tasks
from fdhil.config import Access
from fdhil.daemon.peers import Peer, listen, peer_of
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, FdhilError
from fdhil.guard.peers import Role
from fdhil.json_lines import decode_line, encode_line

SOCKET_NAME = "daemon.sock"
MAX_LINE = 64 * 1024
MAX_CLIENTS = 16
RESERVE = 4  # more, for who must be heard while all others wait for their answers
ALWAYS_HEARD = ("disarm", "status")
IDLE_S = 60.0
LOOK_S = 1.0  # for the name of the socket
PROGRESS_S = 0.5

Handler = Callable[[Mapping[str, Any], Peer], Awaitable[Answer]]
Progress = Callable[[], Mapping[str, Any] | None]
Stream = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
FileId = tuple[int, int]
Done = TypeVar("Done")


class ControlServer:
    """Serves requests to ``handle``; each client has its own task, a slow or dead one delays nobody else."""

    def __init__(
        self,
        handle: Handler,
        progress: Progress,
        abandon: Callable[[], object],
        access: Access,
        live: Stream | None = None,
        lost: Callable[[str], Awaitable[object]] | None = None,
    ) -> None:
        """``progress`` tells how far what takes long is, ``abandon`` ends it; ``access`` says who may come.

        ``lost`` is called when the socket's name has gone: with "" where it was made again, else with why it cannot be.

        ``live`` serves a connection after the answer that opens it as a stream.
        """
        self._handle, self._progress, self._abandon, self._access = handle, progress, abandon, access
        self._live, self._lost = live, lost
        # the clients in the order of their last answers, the longest idle first, and those that wait for one
        self._clients: dict[asyncio.Task[None], None] = {}
        self._busy: set[asyncio.Task[None]] = set()
        self._arming: list[asyncio.StreamWriter] = []  # who waits for an arming: what is checked is for the first

    @property
    def hung_up(self) -> bool:
        """Whether who has something checked and armed has left by now; may be asked from any thread."""
        return any(map(_hung_up, self._arming[:1]))

    @asynccontextmanager
    async def serving(self, path: Path) -> AsyncIterator[None]:
        """Listen at ``path`` until the block is left; a socket file left by a crash is replaced. ConnectError."""
        try:
            listener = listen(path, self._access)
        except OSError as error:
            text = f"cannot be opened: {error.strerror or error}; set another [store] run_directory"
            raise ConnectError(str(path), text) from None
        self._server = await self._served(listener)
        keeping = asyncio.create_task(self._keep_name(path, _name_of(path)), name="control socket")
        try:
            yield
        finally:
            await end_tasks([keeping], END_S)
            self._server.close()
            for task in list(self._clients):
                task.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)
            with contextlib.suppress(OSError):  # the next daemon takes the place of one that stays
                path.unlink()

    async def _served(self, listener: socket.socket) -> asyncio.Server:
        return await asyncio.start_unix_server(self._accept, sock=listener, limit=MAX_LINE)

    async def _keep_name(self, path: Path, name: FileId | None) -> None:
        """Make the socket again where its name leads elsewhere, as in a run directory that was cleaned."""
        while True:
            listener = await self._renewed(path, name)
            before, self._server = self._server, await self._served(listener)
            before.close()
            name = await asyncio.to_thread(_name_of, path)
            await self._tell_lost("")

    async def _renewed(self, path: Path, name: FileId | None) -> socket.socket:
        """Wait until the name is gone, and return the listener that takes its place as soon as there can be one."""
        trouble = ""
        while True:
            await asyncio.sleep(LOOK_S)
            if name is not None and await asyncio.to_thread(_name_of, path) == name:
                continue
            try:
                await asyncio.to_thread(make_directory, path.parent)
                return await asyncio.to_thread(listen, path, self._access)
            except (DeviceError, OSError) as error:
                if not trouble:
                    trouble = str(error)
                    await self._tell_lost(trouble)

    async def _tell_lost(self, trouble: str) -> None:
        if self._lost is not None:
            await self._lost(trouble)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if not self._has_room():
            writer.close()
            return
        self._clients[task] = None
        try:
            await self._converse(task, reader, writer)
        except (OSError, asyncio.LimitOverrunError, ValueError, TimeoutError):
            pass  # a client that left, talks too much or never reads loses its connection, nothing else
        except asyncio.CancelledError:
            pass  # the daemon stops, or another has this place; the stream's own callback must not see it
        finally:
            self._clients.pop(task, None)
            self._busy.discard(task)
            writer.close()

    def _has_room(self) -> bool:
        """Whether one more may come; the connection that has been idle for longest is closed for it."""
        if len(self._clients) < MAX_CLIENTS:
            return True
        idle = next((client for client in self._clients if client not in self._busy), None)
        if idle is not None:
            self._clients.pop(idle)
            idle.cancel()
        return len(self._clients) < MAX_CLIENTS + RESERVE

    async def _converse(
        self, task: asyncio.Task[None], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        peer = peer_of(writer.get_extra_info("socket"), self._access)
        while line := await _in_time(reader.readline()):
            self._busy.add(task)
            answer = await self._attended(line, peer, writer)
            self._busy.discard(task)
            self._clients[task] = self._clients.pop(task, None)
            writer.write(encode_line(answer))
            await _in_time(writer.drain())
            if self._live is not None and "live" in answer:
                self._busy.add(task)  # it is never idle: nobody takes its place
                await self._live(reader, writer)
                return
            if peer.role is Role.NOBODY:
                return

    async def _attended(self, line: bytes, peer: Peer, writer: asyncio.StreamWriter) -> Answer:
        """Answer a request; of one to arm tell the progress meanwhile, and see whether somebody waits for it."""
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            return refusal("BadRequest", "the request is no JSON", "send one JSON object per line")
        if not isinstance(request, dict) or request.get("request") != "arm" or not peer.may("arm"):
            return await self._answer(request, peer)
        if _hung_up(writer):
            return ABANDONED  # it waited while this process slept: nobody is there who wants it by now
        answering = asyncio.ensure_future(self._answer(request, peer))
        self._arming.append(writer)
        try:
            while not (await asyncio.wait([answering], timeout=PROGRESS_S))[0]:
                if self._arming[0] is writer:
                    self._attend(writer, request.get("progress") is True)
            return await answering
        finally:
            answering.cancel()
            self._arming.remove(writer)

    def _attend(self, writer: asyncio.StreamWriter, wanted: bool) -> None:
        """Tell how far what is checked is where that is wanted; abandon it where nobody waits for it."""
        if _hung_up(writer):
            self._abandon()
        elif wanted and (told := self._progress()):
            writer.write(encode_line({"progress": told}))

    async def _answer(self, request: Any, peer: Peer) -> Answer:
        if not isinstance(request, dict) or not isinstance(request.get("request"), str):
            return refusal("BadRequest", "the request has no text under 'request'", "status, arm, disarm or stop")
        if len(self._busy) > MAX_CLIENTS and request["request"] not in ALWAYS_HEARD:
            return refusal("Busy", f"{MAX_CLIENTS} others wait for their answers", "wait for one of them to end")
        try:
            return await self._handle(request, peer)
        except FdhilError as error:
            text, _, advice = str(error).partition("; ")
            return refusal(type(error).__name__, text, advice) | {"exit_code": error.exit_code}


def _name_of(path: Path) -> FileId | None:
    """Return what identifies the file at a path, None where there is none."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _hung_up(writer: asyncio.StreamWriter) -> bool:
    """Whether the other end is closed altogether, unlike one that only sends no more."""
    poll = select.poll()
    try:
        poll.register(writer.get_extra_info("socket"), 0)
    except ValueError:  # it left while it was told something, and is closed here too
        return True
    return bool(poll.poll(0))


async def _in_time(doing: Awaitable[Done]) -> Done:
    """Wait for a client no longer than it may idle; TimeoutError. A cancellation is kept, as wait_for may not."""
    async with asyncio.timeout(IDLE_S):
        return await doing


def ask(
    path: Path,
    request: Mapping[str, Any],
    timeout_s: float = 10.0,
    progress: Callable[[Mapping[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Send one request to a running daemon and return its answer (blocking; for the command line).

    With ``progress`` the daemon is asked to tell how far it is, and each of its tellings goes there.

    ConnectError when no daemon listens, DeviceTimeout when it does not answer.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(timeout_s)
            client.connect(str(path))
            wanted = {"progress": True} if progress else {}
            client.sendall(encode_line({**request, **wanted}))
            with client.makefile("rb") as lines:
                line = lines.readline()
                while progress and line.startswith(b'{"progress"'):
                    progress(json.loads(line)["progress"])
                    line = lines.readline()
    except TimeoutError:
        text = f"did not answer within {timeout_s:.0f} s; see its log"
        raise DeviceTimeout("daemon", text) from None
    except OSError as error:
        absent = f"is not running ({path}: {error.strerror or error}); start it with `fdhil run CONFIG`"
        raise ConnectError.of_socket("daemon", error, absent) from None
    if not line:
        raise ConnectError("daemon", "closed the connection without an answer; see its log")
    answer = decode_line(line)
    if answer is None:
        raise ConnectError("daemon", f"gave no answer of a daemon; see what listens at {path}")
    return answer
