"""Runs the check of a long program in the background: starts it, follows it ahead of the motion, abandons it."""

import asyncio
import contextlib
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fdhil.arming.checked_program import CheckedBlock, CheckedProgram
from fdhil.arming.code_digest import MAKER
from fdhil.arming.program_check import SCHEMA, make_part_path
from fdhil.bounded_process import BoundedProcess
from fdhil.config import MachineConfig
from fdhil.prediction import list_values
from fdhil.records import Parameters, Reason
from fdhil.store import make_store_error

FOLDER = "checked"

Enough = Callable[[CheckedProgram], bool]


class BackgroundCheck:
    """Runs at most one check at a time; it continues after the caller has enough, until it ends or is abandoned."""

    def __init__(self, config: MachineConfig) -> None:
        self._config = config
        self._folder = config.store.directory / FOLDER
        self._going: _RunningCheck | None = None

    @property
    def progress(self) -> Mapping[str, Any] | None:
        """The last progress report; None while no check runs."""
        return None if self._going is None or self._going.ended else self._going.progress

    async def check_until(
        self,
        program: Path,
        program_digest: str,
        models: Mapping[str, Parameters],
        enough: Enough,
        config: MachineConfig | None = None,
    ) -> CheckedProgram | tuple[Reason, ...]:
        """Return the program once ``enough`` of it, or all of it, has passed; else every reason why it is refused.

        ``config`` is the configuration with the identified regulators; the default is the configured one. Results of
        earlier checks are reused. A running check of the same program is joined, one of another program is ended.
        Raises StoreError if the rows cannot be written.
        """
        config = config or self._config
        key = self._make_key(program_digest, models, config)
        known = await asyncio.to_thread(CheckedProgram.find_checked, self._folder, key, program.parent)
        if known is not None:
            return known
        going = self._going
        if going is None or going.ended or going.key != key:
            await self.close()
            request = self._make_request(program, program_digest, models, key, config)
            going = self._going = _RunningCheck(request, await asyncio.to_thread(self._open_rows, key))
        with contextlib.ExitStack() as on_failure:  # the caller was cancelled, or ``enough`` failed
            on_failure.callback(self.abandon)
            found = await going.wait_until(enough)
            on_failure.pop_all()
        return found

    def _make_key(self, program_digest: str, models: Mapping[str, Parameters], config: MachineConfig) -> str:
        parts = [SCHEMA, program_digest, config.digest, {axis: list_values(m) for axis, m in models.items()}]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]

    def _open_rows(self, key: str) -> CheckedProgram:
        """Open the file before the child process writes it, so that no rename or removal can come in between."""
        part = make_part_path(self._folder, key)
        try:
            part.parent.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            part.touch()
            return CheckedProgram(part, tuple(self._config.axis))
        except OSError as error:
            raise make_store_error(part, error) from None

    def _make_request(
        self, program: Path, digest: str, models: Mapping[str, Parameters], key: str, config: MachineConfig
    ) -> Mapping[str, Any]:
        return {
            "program": str(program),
            "program_digest": digest,
            "config": config.model_dump(mode="json"),
            "models": {axis: list_values(model) for axis, model in models.items()},
            "folder": str(self._folder),
            "key": key,
        }

    def abandon(self) -> bool:
        """End a running check; return whether there was one."""
        return self._going is not None and self._going.kill()

    async def raise_failure(self) -> None:
        if self._going is not None and self._going.ended:
            await self._going.task

    async def close(self) -> None:
        self.abandon()
        if self._going is not None:
            await asyncio.wait([self._going.task])


class _RunningCheck:
    def __init__(self, request: Mapping[str, Any], checked: CheckedProgram) -> None:
        self.key, self.checked = str(request["key"]), checked
        self.ended = self._abandoned = False
        self._program = str(request["program"])
        self.progress: Mapping[str, Any] = {}
        self._news = asyncio.Event()
        self._take_message({"progress": {"checked_s": 0.0, "line": 0, "times_real_time": 0.0, "refused": 0}})
        self._process = BoundedProcess(MAKER)
        self.task = asyncio.create_task(self._follow_process(request), name=f"check of {self._program}")

    async def wait_until(self, enough: Enough) -> CheckedProgram | tuple[Reason, ...]:
        while not self.ended:
            if not self.checked.refused and enough(self.checked):
                return self.checked
            self._news.clear()
            await self._news.wait()
        await self.task
        return self.checked if self.checked.is_complete else self.checked.refused

    def kill(self) -> bool:
        running = not self.ended
        self._abandoned = self._abandoned or running
        self._process.kill()
        return running

    async def _follow_process(self, request: Mapping[str, Any]) -> None:
        try:
            self._report_failure(await self._process.run(request, self._take_message))
        except OSError as error:
            text = f"the check cannot be started ({error.strerror or error})"
            self.checked.refused += (Reason("InternalError", text, "free memory and processes, then arm again"),)
        finally:
            self.ended = True
            self._news.set()

    def _take_message(self, message: Mapping[str, Any]) -> None:
        checked = self.checked
        self._news.set()
        if "progress" in message:
            self.progress = {"program": self._program, **message["progress"]}
        elif "block" in message:
            end, sha256 = message["block"]
            checked.add_block(CheckedBlock(end, sha256, message["last"]), message["errors"])
        elif "header" in message:
            checked.refused = tuple(Reason(**each) for each in message["header"]["refused"])
            if not checked.refused:
                checked.set_header(message["header"])
        elif refused := message.get("refused") or message.get("error"):
            checked.refused += (Reason(**refused),)

    def _report_failure(self, code: int) -> None:
        if self.checked.is_complete or (self.checked.refused and code == 0):
            return
        if self._abandoned:
            died = Reason("Abandoned", "the check was abandoned", "arm again when it is wanted")
        else:
            text = f"the check ended with exit code {code} and no answer"
            died = Reason("InternalError", text, "see the daemon's log, then report it")
        self.checked.refused += (died,)
