"""Has every request that changes something in the audit, with who asked for it and what he was answered.

What makes the machine do more (arm, acknowledge) is written before it is done, and refused where it cannot be written.
What makes it do less (disarm, stop) is done and answered first: no disk delays it. A flood becomes a few
lines; the last of those that were held back is written a moment later, with how many there were.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fdhil.arming.answers import Answer, refusal
from fdhil.arming.own_thread import in_own_thread
from fdhil.daemon import journal
from fdhil.daemon.peers import NEEDS, Peer
from fdhil.errors import StoreError
from fdhil.guard.peers import Role
from fdhil.store import audit
from fdhil.system_clock import SYSTEM_CLOCK, Clock

LOOKING = ("status", "live")
DONE_FIRST = ("disarm", "stop")
TOLD = ("program", "method", "whole", "notices", "up_to", "note", "by")
MOST_CHARACTERS = 500
HELD_S = 1.0 / journal.REFILL_PER_S
REFUSED_S = 60.0  # one line for all that a user may not ask for in that time: he may not fill the disk


class _Held(NamedTuple):
    """The last line of a kind that was held back, of how many, and whether they were allowed to ask."""

    entry: dict[str, Any]
    lines: int
    allowed: bool


class Audited:
    """Hands requests on to ``handle``, those that change something by way of the audit of ``folder``."""

    def __init__(
        self, handle: Callable[[Mapping[str, Any]], Awaitable[Answer]], folder: Path, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self._handle, self._folder, self._clock = handle, folder, clock
        self._gate = journal.FloodGate()
        self._writing: set[asyncio.Task[Answer | None]] = set()
        self._held: dict[str, _Held] = {}
        self._quiet_until_s: dict[str, float] = {}
        self._disk = asyncio.Lock()

    async def of(self, request: Mapping[str, Any], peer: Peer) -> Answer:
        """Return the answer to a request; AuthRequired where the peer may not ask for that."""
        what = str(request["request"])
        if not peer.may(what):
            answer = _not_allowed(what, peer)
            await self._write(what, request, peer, answer)
            return answer
        if what in LOOKING or what not in (*NEEDS, *DONE_FIRST):
            return await self._handle(request)
        if what not in DONE_FIRST and (trouble := await self._write(what, request, peer, None)) is not None:
            return trouble
        answer = refusal("Stopped", "the daemon ended before it was answered", "start it, then ask again")
        try:
            answer = await self._handle(request)
        except Exception as error:
            answer = refusal(type(error).__name__, str(error))
            raise
        finally:
            writing = self._begin(self._write(what, request, peer, answer))
        if what not in DONE_FIRST:
            await writing
        return answer

    def _begin(self, write: Coroutine[Any, Any, Answer | None]) -> asyncio.Task[Answer | None]:
        writing = asyncio.create_task(write)
        self._writing.add(writing)
        writing.add_done_callback(self._writing.discard)
        return writing

    async def written(self) -> None:
        """Wait until what was answered already is in the audit too, also what was held back."""
        await asyncio.gather(*self._writing)
        for key in [*self._held]:
            self._release(key)
        await asyncio.gather(*self._writing)

    async def _write(self, what: str, request: Mapping[str, Any], peer: Peer, answer: Answer | None) -> Answer | None:
        """Write one line, before the answer is known with None; return why it could not be."""
        allowed = peer.may(what)
        kind = what if what in (*NEEDS, *DONE_FIRST) else "what there is not"
        key = f"{peer.uid} {kind} {answer is None}" if allowed else f"{peer.uid}"
        if self._admits(key, allowed):
            held = self._held.pop(key, None)
            return await self._append(_entry(what, request, peer, answer), held.lines if held else 0)
        text = f"{peer.user} asks for {what} too often to be written down"
        busy = refusal("Busy", text, "ask again in a second") if answer is None else None
        if key not in self._held:
            asyncio.get_running_loop().call_later(HELD_S if allowed else REFUSED_S, self._release, key)
        count = self._held[key].lines if key in self._held else 0
        self._held[key] = _Held(_entry(what, request, peer, busy or answer), count + 1, allowed)
        return busy

    def _admits(self, key: str, allowed: bool) -> bool:
        now_s = self._clock.now_s()
        if allowed:
            return self._gate.admit(key, now_s) is not None
        if now_s < self._quiet_until_s.get(key, now_s):
            return False
        self._quiet_until_s[key] = now_s + REFUSED_S
        return True

    def _release(self, key: str) -> None:
        """Write the last line that was held back, unless a later one has told of it."""
        if (held := self._held.pop(key, None)) is not None:
            self._admits(key, held.allowed)  # it is one more of its kind
            self._begin(self._append(held.entry, held.lines - 1))

    async def _append(self, entry: dict[str, Any], held: int) -> Answer | None:
        """Write one line, and how many were ``held`` back before it; return why it could not be."""
        if held:
            entry["not_written"] = held
        what = entry.get("asked") or entry["answered"]
        if "answered" in entry:
            journal.write_line(f"{_asker(entry)} asked to {what}: {entry['result']}")
        try:
            async with self._disk:  # in the order of what was asked
                await in_own_thread(audit.append, self._folder, entry, self._clock)
        except StoreError as error:
            text = f"{what} of {entry['who']['user']} is not in the audit: {error}"
            journal.write_line(text, "MAJOR")
            return refusal(error.code, text, "nothing was done; mend the store, then ask again")
        return None


def _asker(entry: Mapping[str, Any]) -> str:
    by = f" for {entry['by']}" if "by" in entry else ""
    return f"{entry['who']['user']} (process {entry['who']['pid']}){by}"


def _entry(what: str, request: Mapping[str, Any], peer: Peer, answer: Answer | None) -> dict[str, Any]:
    told = {key: _short(request[key]) for key in TOLD if request.get(key) is not None and peer.may(what)}
    what = _short(what)
    who = {"user": peer.user, "uid": peer.uid, "pid": peer.pid}
    if answer is None:
        return {"who": who, "asked": what, **told}
    result = "done" if answer["ok"] else str(answer["code"])
    return {"who": who, "answered": what, **told, "result": result, "text": _short(answer.get("text", ""))}


def _short(value: Any) -> Any:
    return value if isinstance(value, bool | int | float) else str(value)[:MOST_CHARACTERS]


def _not_allowed(what: str, peer: Peer) -> Answer:
    if peer.role is Role.NOBODY:
        text = f"user {peer.user} may not talk to the daemon"
        return refusal("AuthRequired", text, "[access] of the configuration says who may")
    needs = NEEDS.get(what, Role.COMMISSION)
    whom = "the daemon's own user or root" if needs is Role.COMMISSION else "[access] operate"
    return refusal(
        "AuthRequired", f"user {peer.user} may look and disarm, but not {_short(what)}", f"{whom} may do that"
    )
