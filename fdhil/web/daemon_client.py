"""Sends requests to the daemon's socket without blocking; cancelling a request withdraws it."""

import asyncio
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fdhil.errors import ConnectError, DeviceTimeout
from fdhil.json_lines import decode_line, encode_line

ANSWER_S = 10.0
FRESH_S = 0.5
LONGEST_ANSWER = 16 * 1024 * 1024
Progress = Callable[[Mapping[str, Any]], None]


class DaemonClient:
    """The daemon of one machine, as seen from another process."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._status: tuple[float, asyncio.Task[dict[str, Any]]] | None = None

    async def send_request(
        self, request: Mapping[str, Any], timeout_s: float = ANSWER_S, progress: Progress | None = None
    ) -> dict[str, Any]:
        """Send one request and return its answer. ConnectError if no daemon listens, DeviceTimeout if it is silent.

        Cancelling it closes the connection, by which the daemon abandons what it was preparing.
        """
        asked = {**request, "progress": True} if progress else request
        try:
            async with asyncio.timeout(timeout_s):
                reader, writer = await asyncio.open_unix_connection(self._path, limit=LONGEST_ANSWER)
                try:
                    writer.write(encode_line(asked))
                    return await _receive_answer(reader, progress)
                finally:
                    writer.close()
        except TimeoutError:
            text = f"did not answer within {timeout_s:.0f} s, the machine's state is unknown here; check its log"
            raise DeviceTimeout("daemon", text) from None
        except OSError as error:
            absent = f"is not running ({error.strerror or error}); start it with fdhil run CONFIG"
            raise ConnectError.from_socket_error("daemon", error, absent) from None

    async def read_status(self) -> Mapping[str, Any]:
        """Return the status document, at most half a second old: many browsers cause no more requests than one.

        Concurrent callers share one answer, or one failure: they do not queue for a silent daemon.
        """
        now_s = time.monotonic()
        if self._status is None or _is_stale(*self._status, now_s):
            self._status = (
                now_s,
                asyncio.create_task(self.send_request({"request": "status"}), name="status of the daemon"),
            )
        return await asyncio.shield(self._status[1])


def _is_stale(asked_s: float, answer: asyncio.Task[dict[str, Any]], now_s: float) -> bool:
    if not answer.done():
        return False
    return now_s - asked_s > FRESH_S or answer.cancelled() or answer.exception() is not None


async def _receive_answer(reader: asyncio.StreamReader, progress: Progress | None) -> dict[str, Any]:
    try:
        while (answer := decode_line(await reader.readline())) and progress and list(answer) == ["progress"]:
            progress(answer["progress"])
    except ValueError:  # a line without an end
        answer = None
    if answer is None:
        raise ConnectError("daemon", "closed the connection without an answer; check its log")
    return answer
