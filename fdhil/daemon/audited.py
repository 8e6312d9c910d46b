"""Has every request that changes something in the audit, with who asked for it and what he was answered.

What makes the machine do more (arm, acknowledge) is written before it is done, and refused where it cannot be written.
What makes it do less (disarm, stop) is done and answered first: no disk delays it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from fdhil.arming.answers import Answer, refusal
from fdhil.daemon import journal
from fdhil.daemon.peers import NEEDS, Peer
from fdhil.errors import StoreError
from fdhil.guard.peers import Role
from fdhil.store import audit

LOOKING = ("status", "live")
DONE_FIRST = ("disarm", "stop")
TOLD = ("program", "method", "whole", "notices", "up_to", "note", "by")
MOST_CHARACTERS = 500


class Audited:
    """Hands requests on to ``handle``, those that change something by way of the audit of ``folder``."""

    def __init__(self, handle: Callable[[Mapping[str, Any]], Awaitable[Answer]], folder: Path) -> None:
        self._handle, self._folder = handle, folder
        self._gate = journal.FloodGate()
        self._writing: set[asyncio.Task[Answer | None]] = set()

    async def of(self, request: Mapping[str, Any], peer: Peer) -> Answer:
        """Return the answer to a request; AuthRequired where the peer may not ask for that."""
        what = str(request["request"])
        if not peer.may(what):
            answer = _not_allowed(what, peer)
            await self._write(what, request, peer, answer)
            return answer
        if what in LOOKING or what not in (*NEEDS, *DONE_FIRST):
            return await self._handle(request)
        if what in DONE_FIRST:
            answer = await self._handle(request)
            writing = asyncio.create_task(self._write(what, request, peer, answer))
            self._writing.add(writing)
            writing.add_done_callback(self._writing.discard)
            return answer
        if (trouble := await self._write(what, request, peer, None)) is not None:
            return trouble
        answer = await self._handle(request)
        await self._write(what, request, peer, answer)
        return answer

    async def written(self) -> None:
        """Wait until what was answered already is in the audit too."""
        await asyncio.gather(*self._writing)

    async def _write(self, what: str, request: Mapping[str, Any], peer: Peer, answer: Answer | None) -> Answer | None:
        """Write one line, before the answer is known with None; return why it could not be."""
        kind = what if what in (*NEEDS, *DONE_FIRST) else "what there is not"
        held = self._gate.admit(f"{peer.uid} {kind} {answer is None}", time.monotonic())
        if held is None:
            return refusal("Busy", f"{peer.user} asks for {what} too often to be written down", "ask again in a second")
        entry = {**_entry(what, request, peer, answer), **({"not_written": held} if held else {})}
        if answer is not None:
            journal.write_line(f"{_asker(entry)} asked to {_short(what)}: {entry['result']}")
        try:
            await asyncio.to_thread(audit.append, self._folder, entry)
        except StoreError as error:
            text = f"{what} of {peer.user} is not in the audit: {error}"
            journal.write_line(text, "MAJOR")
            return refusal(error.code, text, "nothing was done; mend the store, then ask again")
        return None


def _asker(entry: Mapping[str, Any]) -> str:
    by = f" for {entry['by']}" if "by" in entry else ""
    return f"{entry['who']['user']} (process {entry['who']['pid']}){by}"


def _entry(what: str, request: Mapping[str, Any], peer: Peer, answer: Answer | None) -> dict[str, Any]:
    what = _short(what)
    told = {key: _short(request[key]) for key in TOLD if request.get(key) is not None}
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
