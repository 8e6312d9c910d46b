"""Queues programs dropped in a browser, has them forecast one after another, and keeps the newest.

Programs are kept as long as the process that serves the pages, under the digest of their bytes. Their name is displayed
and never used as a path.
"""

import asyncio
import hashlib
import os
import shutil
import signal
import tempfile
from collections import OrderedDict
from collections.abc import AsyncIterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from fdhil.bounded_process import BoundedProcess
from fdhil.config import MachineConfig
from fdhil.web.answers import Refused
from fdhil.web.forecast.kept import Forecast, read_advice

MAKER = "fdhil.web.forecast.process"
KEPT = 6
MOST_WAITING = 3
LONGEST_S = 600.0  # on a busy PC; the process limits its own processor time
LONGEST_NAME = 100
STATES = Literal["waiting", "computing", "done", "failed", "cancelled"]
ADVICE = {
    "ProgramError": "correct the program, then drop it again",
    "RecordingError": "record or export the demand again, then drop it again",
    "ConfigError": "correct the configuration or identify the axis, then drop the program again",
    "StoreError": "see the history's fault in fdhil status, then drop the program again",
}


@dataclass(slots=True)
class Work:
    """One child process' computation: its progress and its failure. ``tolerance_um`` None: the forecast itself."""

    tolerance_um: float | None = None
    state: STATES = "waiting"
    progress: Mapping[str, Any] = field(default_factory=dict)
    fault: Mapping[str, Any] | None = None
    task: asyncio.Task[None] | None = None

    @property
    def over(self) -> bool:
        return self.state in ("done", "failed", "cancelled")

    def fail(self, code: str, text: str, advice: str, line: int | None = None) -> None:
        self.state, self.fault = "failed", {"code": code, "text": text, "advice": advice, "line": line}


@dataclass(slots=True)
class Job:
    """One program: its name, its files, its computations and their results."""

    digest: str
    name: str
    folder: Path
    program: Path
    forecasting: Work = field(default_factory=Work)
    advising: Work | None = None
    forecast: Forecast | None = None
    advice: list[dict[str, Any]] = field(default_factory=list)

    @property
    def works(self) -> list[Work]:
        return [self.forecasting, *([self.advising] if self.advising else [])]

    @property
    def over(self) -> bool:
        return all(work.over for work in self.works)


class Desk:
    """The programs of one serving process."""

    def __init__(self, config: MachineConfig) -> None:
        self._config = config
        self._folder: Path | None = None
        self._jobs: OrderedDict[str, Job] = OrderedDict()
        self._one = asyncio.Semaphore(1)

    @property
    def jobs(self) -> list[Job]:
        return list(reversed(self._jobs.values()))

    def job(self, digest: str) -> Job:
        """Return a program; Refused if it is not kept (any more)."""
        job = self._jobs.get(digest)
        if job is None:
            text = "this program is not kept (any more): only the newest are, until fdhil web ends"
            raise Refused(404, "NotFound", text, "drop its file again")
        return job

    def forecast(self, digest: str) -> Forecast:
        """Return the forecast of a program; Refused while there is none."""
        job = self.job(digest)
        if job.forecast is None:
            raise Refused(
                409, "NotReady", f"the forecast of {job.name} is {job.forecasting.state}", "wait until it is done"
            )
        return job.forecast

    async def take(self, name: str, content: AsyncIterable[bytes]) -> Job:
        """Store a program's bytes and have it forecast; known bytes are forecast again, unless that is in progress.

        Refused if too many wait, or for an empty file. A program that is still being uploaded does not displace others.
        """
        self._check_room()
        suffix = ".csv" if name.lower().endswith(".csv") else ".ngc"
        part = self._room() / f".{os.urandom(8).hex()}.part"
        try:
            digest = await _written(part, content)
            running = self._jobs.get(digest)
            if running is not None and not running.over:
                return running
            self._check_room()
            folder = self._room() / digest
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            program = folder / f"program{suffix}"
            part.rename(program)
        except OSError as error:
            text = f"the program cannot be stored ({error.strerror or error}), nothing was computed"
            raise Refused(507, "DiskFault", text, "free space on the disk of temporary files") from None
        finally:
            part.unlink(missing_ok=True)
        job = self._jobs[digest] = Job(digest, shown(name), folder, program)
        self._jobs.move_to_end(digest)
        self._forget()
        self._start(job, job.forecasting)
        return job

    def advise(self, digest: str, tolerance_um: float) -> Job:
        """Compute the feeds that keep a program's path within a tolerance; Refused while there is no forecast."""
        job = self.job(digest)
        self.forecast(digest)
        if job.advising is None or job.advising.over:
            self._check_room()
            job.advising = Work(tolerance_um)
            self._start(job, job.advising)
        return job

    def _check_room(self) -> None:
        if sum(not work.over for job in self._jobs.values() for work in job.works) > MOST_WAITING:
            text = f"{MOST_WAITING} programs are waiting already, this one was not accepted"
            raise Refused(429, "TooMany", text, "wait for one of them, or cancel it")

    def _start(self, job: Job, work: Work) -> None:
        work.task = asyncio.create_task(self._run(job, work), name=f"forecast of {job.name}")

    def _room(self) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="fdhil-web-"))
        return self._folder

    def _forget(self) -> None:
        for digest, job in list(self._jobs.items()):
            if len(self._jobs) > KEPT and job.over:
                del self._jobs[digest]
                shutil.rmtree(job.folder, ignore_errors=True)

    async def cancel(self, digest: str) -> Job:
        """Cancel the computations of a program; completed ones are kept."""
        job = self.job(digest)
        for work in job.works:
            if work.task is not None and not work.over:
                work.task.cancel()
                await asyncio.wait([work.task])
                work.state = "cancelled"  # also if it had not begun
        return job

    async def close(self) -> None:
        tasks = [work.task for job in self._jobs.values() for work in job.works if work.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._jobs.clear()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    async def _run(self, job: Job, work: Work) -> None:
        try:
            async with self._one:
                work.state = "computing"
                async with asyncio.timeout(LONGEST_S):
                    await self._compute(job, work)
        except TimeoutError:
            text = f"{job.name} took longer than {LONGEST_S:.0f} s, there is no result"
            work.fail("TooLong", text, "shorten the program, or use the command line")
        except OSError as error:
            text = f"the forecast cannot be started ({error.strerror or error})"
            work.fail("InternalError", text, "free memory and processes, then try again")
        except (ValueError, LookupError, TypeError):
            text = f"the forecast of {job.name} returned an invalid result"
            work.fail("InternalError", text, "report it with the program")
        except asyncio.CancelledError:
            work.state = "cancelled"

    async def _compute(self, job: Job, work: Work) -> None:
        def take(message: Mapping[str, Any]) -> None:
            if "progress" in message:
                work.progress = message["progress"]
            elif error := message.get("error"):
                work.fail(error["code"], error["text"], ADVICE.get(error["code"], ""), error.get("line"))

        request = {
            "program": str(job.program),
            "name": job.name,
            "config": self._config.model_dump(mode="json"),
            "folder": str(job.folder),
            "tolerance_um": work.tolerance_um,
        }
        code = await BoundedProcess(MAKER).run(request, take)
        if work.fault is None:
            await _conclude(job, work, code)


async def _conclude(job: Job, work: Work, code: int) -> None:
    try:
        if code != 0:
            raise ValueError(code)
        if work.tolerance_um is None:
            job.forecast = await asyncio.to_thread(Forecast.read, job.folder)
        else:
            job.advice = await asyncio.to_thread(read_advice, job.folder)
        work.state = "done"
    except (OSError, ValueError):
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            text = f"{job.name} needs more processor time or memory than allowed for the browser"
            work.fail("TooLong", text, "shorten the program, or use the command line")
            return
        text = f"the forecast ended with exit code {code} and no result"
        work.fail("InternalError", text, "check the log of fdhil web, then report it")


async def _written(part: Path, content: AsyncIterable[bytes]) -> str:
    digest, size = hashlib.sha256(), 0
    with part.open("xb") as file:
        async for piece in content:
            size += len(piece)
            digest.update(piece)
            file.write(piece)
    if size == 0:
        raise Refused(422, "BadRequest", "the file is empty, nothing was computed", "drop an NC program or a demand")
    return digest.hexdigest()


def shown(name: str) -> str:
    """Return a file name for display: its last part, printable, of limited length."""
    last = name.replace("\\", "/").rpartition("/")[2]
    printable = "".join(letter for letter in last if letter.isprintable())[:LONGEST_NAME].strip()
    return printable or "program"
