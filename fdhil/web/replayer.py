"""Asks the process that replays rapids, starts it where it does not run, and ends it where it does not answer."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from threading import BoundedSemaphore, Lock, Timer

from fdhil.config import MachineConfig
from fdhil.web.answers import Refused

PROCESS = "fdhil.web.replay_process"
LONGEST_S = 60.0
"""A rapid takes 20 ms, the process a second to start, kernels that were never compiled here half a minute."""
MOST_ASKING = 8
"""Who asks holds one of the forty threads that serve the pages until he is answered."""


class Replayer:
    """The one process that replays for a serving process; who asks waits for his turn."""

    def __init__(self, config: MachineConfig) -> None:
        self._config = config
        self._process: subprocess.Popen[bytes] | None = None
        self._one = Lock()
        self._places = BoundedSemaphore(MOST_ASKING)

    def signals(self, axis: str, number: int) -> bytes:
        """Return a rapid's signals with the model laid over them, as JSON (blocking). Refused, also where many wait."""
        if not self._places.acquire(blocking=False):
            text = f"{MOST_ASKING} others wait for a replay already, this rapid was not replayed"
            raise Refused(503, "Busy", text, "try again in a few seconds")
        try:
            return self._replayed(axis, number)
        finally:
            self._places.release()

    def _replayed(self, axis: str, number: int) -> bytes:
        request = json.dumps({"axis": axis, "number": number}).encode() + b"\n"
        with self._one:
            fresh = self._process is None
            answer = self._asked(request)
            if not answer and not fresh:  # it has ended since, for it was idle
                answer = self._asked(request)
        if not answer:
            text = f"the replay of rapid {number} of axis {axis} failed, the machine is not touched by it"
            raise Refused(500, "ReplayFailed", text, "see the log of fdhil web, and try fdhil replay on its recording")
        if answer.startswith(b"-"):
            fault = json.loads(answer[1:])
            raise Refused(fault["status"], fault["code"], fault["text"], fault["advice"])
        return answer[1:]

    def _asked(self, request: bytes) -> bytes:
        """Return the line that answers, empty where the process ended or had to be ended."""
        if self._process is None:
            told = {"config": self._config.model_dump(mode="json"), "digest": self._config.digest}
            request = json.dumps(told).encode() + b"\n" + request
            command = [sys.executable, "-m", PROCESS]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        answer = self._within_time(self._process, request)
        if answer.endswith(b"\n"):
            return answer
        self._end()
        return b""

    @staticmethod
    def _within_time(process: subprocess.Popen[bytes], request: bytes) -> bytes:
        assert process.stdin is not None
        assert process.stdout is not None
        timer = Timer(LONGEST_S, process.kill)
        timer.start()
        try:
            process.stdin.write(request)
            process.stdin.flush()
            return process.stdout.readline()
        except BrokenPipeError:
            return b""
        finally:
            timer.cancel()
            timer.join()

    def close(self) -> None:
        """End the process."""
        with self._one:
            self._end()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(BrokenPipeError):  # of what it has not read
                if pipe is not None:
                    pipe.close()
        process.wait()
