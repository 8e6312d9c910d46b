"""Records every request that changes something in the audit log, with its client and the answer.

A request that makes the machine do more (arm, acknowledge) is recorded before it is executed, and refused where it
cannot be recorded. One that makes it do less (disarm, stop) is executed and answered first: no disk delays it. A flood
becomes a few lines; the last suppressed line follows a moment later with the number of suppressed ones.
"""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fdhil.arming import Answer, make_refusal, run_in_dedicated_thread
from fdhil.daemon import service_log
from fdhil.daemon.daemon_access import NEEDS, ClientProcess
from fdhil.errors import StoreError
from fdhil.guard import Role
from fdhil.store import append_entry
from fdhil.system_clock import SYSTEM_CLOCK, Clock

LOOKING = ("status", "live")
DONE_FIRST = ("disarm", "stop")
TOLD = ("program", "method", "whole", "notices", "up_to", "note", "by")
MOST_CHARACTERS = 500
HELD_S = 1.0 / service_log.REFILL_PER_S
REFUSED_S = 60.0  # one line for all refused requests of a user in that time: they cannot fill the disk


class _SuppressedLine(NamedTuple):
    """The last suppressed line of a kind, the number of suppressed lines, and whether they were allowed."""

    entry: dict[str, Any]
    lines: int
    allowed: bool


class AuditMiddleware:
    """Passes requests to ``handle``; those that change something are recorded in the audit of ``folder``."""

    def __init__(
        self, handle: Callable[[Mapping[str, Any]], Awaitable[Answer]], folder: Path, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self._handle, self._folder, self._clock = handle, folder, clock
        self._gate = service_log.LogThrottle()
        self._writing: set[asyncio.Task[Answer | None]] = set()
        self._held: dict[str, _SuppressedLine] = {}
        self._quiet_until_s: dict[str, float] = {}
        self._disk = asyncio.Lock()

    async def answer_request(self, request: Mapping[str, Any], peer: ClientProcess) -> Answer:
        """Return the answer to a request; AuthRequired where the peer lacks the right."""
        what = str(request["request"])
        if not peer.may_request(what):
            answer = _refuse_access(what, peer)
            await self._write_entry(what, request, peer, answer)
            return answer
        if what in LOOKING or what not in (*NEEDS, *DONE_FIRST):
            return await self._handle(request)
        if what not in DONE_FIRST and (trouble := await self._write_entry(what, request, peer, None)) is not None:
            return trouble
        answer = make_refusal("Stopped", "the daemon ended before the answer", "start it, then repeat the request")
        try:
            answer = await self._handle(request)
        except Exception as error:
            answer = make_refusal(type(error).__name__, str(error))
            raise
        finally:
            writing = self._begin_writing(self._write_entry(what, request, peer, answer))
        if what not in DONE_FIRST:
            await writing
        return answer

    def _begin_writing(self, write: Coroutine[Any, Any, Answer | None]) -> asyncio.Task[Answer | None]:
        writing = asyncio.create_task(write)
        self._writing.add(writing)
        writing.add_done_callback(self._writing.discard)
        return writing

    async def wait_until_written(self) -> None:
        """Wait until all answered requests are in the audit, including suppressed lines."""
        await asyncio.gather(*self._writing)
        for key in [*self._held]:
            self._write_suppressed(key)
        await asyncio.gather(*self._writing)

    async def _write_entry(
        self, what: str, request: Mapping[str, Any], peer: ClientProcess, answer: Answer | None
    ) -> Answer | None:
        """Write one line, with answer None before the request is executed; return a refusal when that fails."""
        allowed = peer.may_request(what)
        kind = what if what in (*NEEDS, *DONE_FIRST) else "unknown"
        key = f"{peer.uid} {kind} {answer is None}" if allowed else f"{peer.uid}"
        if self._admit_line(key, allowed):
            held = self._held.pop(key, None)
            return await self._append_entry(_build_entry(what, request, peer, answer), held.lines if held else 0)
        text = f"{peer.user} sends {what} requests too often for the audit log"
        busy = make_refusal("Busy", text, "try again in a second") if answer is None else None
        if key not in self._held:
            asyncio.get_running_loop().call_later(HELD_S if allowed else REFUSED_S, self._write_suppressed, key)
        count = self._held[key].lines if key in self._held else 0
        self._held[key] = _SuppressedLine(_build_entry(what, request, peer, busy or answer), count + 1, allowed)
        return busy

    def _admit_line(self, key: str, allowed: bool) -> bool:
        now_s = self._clock.now_s()
        if allowed:
            return self._gate.admit_line(key, now_s) is not None
        if now_s < self._quiet_until_s.get(key, now_s):
            return False
        self._quiet_until_s[key] = now_s + REFUSED_S
        return True

    def _write_suppressed(self, key: str) -> None:
        """Write the last suppressed line, unless a later line has reported it."""
        if (held := self._held.pop(key, None)) is not None:
            self._admit_line(key, held.allowed)  # counts as one more line of its kind
            self._begin_writing(self._append_entry(held.entry, held.lines - 1))

    async def _append_entry(self, entry: dict[str, Any], held: int) -> Answer | None:
        """Append one line with the number of lines ``held`` back before it; return a refusal when that fails."""
        if held:
            entry["not_written"] = held
        what = entry.get("asked") or entry["answered"]
        if "answered" in entry:
            service_log.write_line(f"{_describe_requester(entry)} requested {what}: {entry['result']}")
        try:
            async with self._disk:  # keeps the order of the requests
                await run_in_dedicated_thread(append_entry, self._folder, entry, self._clock)
        except StoreError as error:
            text = f"{what} of {entry['who']['user']} could not be recorded in the audit log: {error}"
            service_log.write_line(text, "MAJOR")
            return make_refusal(error.code, text, "nothing was done; repair the store, then try again")
        return None


def _describe_requester(entry: Mapping[str, Any]) -> str:
    by = f" for {entry['by']}" if "by" in entry else ""
    return f"{entry['who']['user']} (process {entry['who']['pid']}){by}"


def _build_entry(what: str, request: Mapping[str, Any], peer: ClientProcess, answer: Answer | None) -> dict[str, Any]:
    fields = {
        key: _truncate_value(request[key]) for key in TOLD if request.get(key) is not None and peer.may_request(what)
    }
    what = _truncate_value(what)
    who = {"user": peer.user, "uid": peer.uid, "pid": peer.pid}
    if answer is None:
        return {"who": who, "asked": what, **fields}
    result = "done" if answer["ok"] else str(answer["code"])
    return {"who": who, "answered": what, **fields, "result": result, "text": _truncate_value(answer.get("text", ""))}


def _truncate_value(value: Any) -> Any:
    return value if isinstance(value, bool | int | float) else str(value)[:MOST_CHARACTERS]


def _refuse_access(what: str, peer: ClientProcess) -> Answer:
    if peer.role is Role.NOBODY:
        text = f"user {peer.user} has no access to the daemon"
        return make_refusal("AuthRequired", text, "[access] of the configuration assigns the rights")
    needs = NEEDS.get(what, Role.COMMISSION)
    whom = "the daemon's own user or root" if needs is Role.COMMISSION else "[access] operate"
    return make_refusal(
        "AuthRequired",
        f"user {peer.user} may watch and disarm, but not request {_truncate_value(what)}",
        f"this needs {whom}",
    )
