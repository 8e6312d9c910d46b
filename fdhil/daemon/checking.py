"""The check of a whole program, seen from the daemon: started, watched, abandoned, remembered."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import importlib.metadata
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdhil.config import MachineConfig
from fdhil.daemon.program_check import SCHEMA
from fdhil.daemon.streamed import Checked
from fdhil.records import Parameters, Reason

FOLDER = "checked"
MAX_LINE = 1 << 20
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Check:
    """At most one check at a time; ``progress`` is what it said last, None while none runs."""

    def __init__(self, config: MachineConfig) -> None:
        self._config = config
        self._folder = config.store.directory / FOLDER
        self._process: asyncio.subprocess.Process | None = None
        self._abandoned = False
        self.progress: Mapping[str, Any] | None = None

    async def run(
        self, program: Path, program_digest: str, models: Mapping[str, Parameters]
    ) -> Checked | tuple[Reason, ...]:
        """Return the checked program, or why it is refused; what was checked before is not checked again."""
        key = self._key(program_digest, models)
        known = await asyncio.to_thread(Checked.find, self._folder, key, program.parent)
        if known is not None:
            return known
        request = {
            "program": str(program),
            "program_digest": program_digest,
            "config": self._config.model_dump(mode="json"),
            "models": {axis: model.as_dict() for axis, model in models.items()},
            "folder": str(self._folder),
            "key": key,
        }
        self._abandoned = False
        self.progress = {"program": str(program), "checked_s": 0.0, "line": 0, "times_real_time": 0.0, "refused": 0}
        try:
            answer = await self._ask(request, str(program))
        finally:
            self.progress = None
        if "header" in answer and not answer["header"]["refused"]:
            done = await asyncio.to_thread(Checked.find, self._folder, key, program.parent)
            if done is not None:
                return done
            answer = {"error": {"code": "StoreFault", "text": "the check's rows cannot be read back", "advice": ""}}
        refused = answer["header"]["refused"] if "header" in answer else [answer["error"]]
        return tuple(Reason(told["code"], told["text"], told["advice"]) for told in refused)

    def _key(self, program_digest: str, models: Mapping[str, Parameters]) -> str:
        of = [
            importlib.metadata.version("fdhil"),
            SCHEMA,
            program_digest,
            self._config.digest,
            {axis: m.as_dict() for axis, m in models.items()},
        ]
        return hashlib.sha256(json.dumps(of).encode()).hexdigest()[:32]

    async def _ask(self, request: Mapping[str, Any], program: str) -> Mapping[str, Any]:
        """Start the process, take its progress, return its last word."""
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "fdhil.daemon.program_check",
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=MAX_LINE,
            env={**os.environ, **ONE_THREAD},
        )
        self._process = process
        assert process.stdin is not None
        assert process.stdout is not None
        answer: Mapping[str, Any] = {}
        try:
            with contextlib.suppress(ConnectionError):  # a process that ended already is told by its silence
                process.stdin.write(json.dumps(request).encode() + b"\n")
                await process.stdin.drain()
            async for line in process.stdout:
                with contextlib.suppress(ValueError):  # half a line is what an ended process leaves
                    answer = json.loads(line)
                if "progress" in answer:
                    self.progress = {"program": program, **answer["progress"]}
        finally:
            self._end()
            await process.wait()
            self._process = None
        if "header" in answer or "error" in answer:
            return answer
        if self._abandoned:
            error = {"code": "Abandoned", "text": "the check was abandoned", "advice": "arm again when it is wanted"}
        else:
            text = f"the check ended with exit code {process.returncode} and no answer"
            error = {"code": "InternalError", "text": text, "advice": "see the daemon's log, then report it"}
        return {"error": error}

    def _end(self) -> None:
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()

    def abandon(self) -> bool:
        """End a check that runs; return whether one did."""
        running = self._process is not None
        self._abandoned = self._abandoned or running
        self._end()
        return running
