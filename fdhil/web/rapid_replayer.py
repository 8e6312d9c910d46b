"""Runs the process that replays rapids: starts it on demand, and ends it if it does not answer."""

import asyncio
import json

from fdhil.bounded_process import BoundedProcess
from fdhil.config import MachineConfig
from fdhil.web.fault_responses import RequestRefused

PROCESS = "fdhil.web.rapid_replay_process"
LONGEST_S = 60.0
"""A rapid takes 20 ms, the start of the process a second, the first compilation of kernels half a minute."""
MOST_ASKING = 8


class RapidReplayer:
    """The only replay process of a serving process; requests are answered one after another."""

    def __init__(self, config: MachineConfig) -> None:
        self._config = config
        self._process: BoundedProcess | None = None
        self._one = asyncio.Lock()
        self._asking = 0

    async def replay_signals(self, axis: str, number: int) -> bytes:
        """Return a rapid's signals with the model, as JSON. Refused, also if many requests wait."""
        if self._asking >= MOST_ASKING:
            text = f"{MOST_ASKING} replays are waiting already, this rapid was not replayed"
            raise RequestRefused(503, "Busy", text, "try again in a few seconds")
        self._asking += 1
        try:
            async with self._one:
                return await self._request_replay(axis, number)
        finally:
            self._asking -= 1

    async def _request_replay(self, axis: str, number: int) -> bytes:
        fresh = self._process is None
        answer = await self._exchange(axis, number)
        if not answer and not fresh:  # it had ended because it was idle
            answer = await self._exchange(axis, number)
        if not answer:
            text = f"the replay of rapid {number} of axis {axis} failed, the machine is not affected"
            raise RequestRefused(
                500, "ReplayFailed", text, "check the log of fdhil web, and try fdhil replay on its recording"
            )
        if answer.startswith(b"-"):
            fault = json.loads(answer[1:])
            raise RequestRefused(fault["status"], fault["code"], fault["text"], fault["advice"])
        return answer[1:]

    async def _exchange(self, axis: str, number: int) -> bytes:
        answer = b""
        try:
            async with asyncio.timeout(LONGEST_S):
                if self._process is None:
                    self._process = BoundedProcess(PROCESS)
                    settings = {"config": self._config.model_dump(mode="json"), "digest": self._config.digest}
                    await self._process.start(settings)
                await self._process.send({"axis": axis, "number": number})
                answer = await self._process.read_line()
        except (TimeoutError, OSError, ValueError):
            pass
        finally:
            whole = answer.endswith(b"\n")
            if not whole:  # the next request must not get the answer to this one
                await self.close()
        return answer if whole else b""

    async def close(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            await process.kill_and_wait()
