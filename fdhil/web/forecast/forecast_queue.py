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
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.forecast.forecast_files import StoredForecast, read_advice

MAKER = "fdhil.web.forecast.forecast_process"
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
class ForecastTask:
    """One child process' computation: its progress and its failure. ``tolerance_um`` None: the forecast itself."""

    tolerance_um: float | None = None
    state: STATES = "waiting"
    progress: Mapping[str, Any] = field(default_factory=dict)
    fault: Mapping[str, Any] | None = None
    task: asyncio.Task[None] | None = None

    @property
    def is_over(self) -> bool:
        return self.state in ("done", "failed", "cancelled")

    def fail(self, code: str, text: str, advice: str, line: int | None = None) -> None:
        self.state, self.fault = "failed", {"code": code, "text": text, "advice": advice, "line": line}


@dataclass(slots=True)
class ForecastJob:
    """One program: its name, its files, its computations and their results."""

    digest: str
    name: str
    folder: Path
    program: Path
    forecasting: ForecastTask = field(default_factory=ForecastTask)
    advising: ForecastTask | None = None
    forecast: StoredForecast | None = None
    advice: list[dict[str, Any]] = field(default_factory=list)

    @property
    def tasks(self) -> list[ForecastTask]:
        return [self.forecasting, *([self.advising] if self.advising else [])]

    @property
    def is_over(self) -> bool:
        return all(work.is_over for work in self.tasks)


class ForecastQueue:
    """The programs of one serving process."""

    def __init__(self, config: MachineConfig) -> None:
        self._config = config
        self._folder: Path | None = None
        self._jobs: OrderedDict[str, ForecastJob] = OrderedDict()
        self._one = asyncio.Semaphore(1)

    @property
    def jobs(self) -> list[ForecastJob]:
        return list(reversed(self._jobs.values()))

    def get_job(self, digest: str) -> ForecastJob:
        """Return a program; Refused if it is not kept (any more)."""
        job = self._jobs.get(digest)
        if job is None:
            text = "this program is not kept (any more): only the newest are, until fdhil web ends"
            raise RequestRefused(404, "NotFound", text, "drop its file again")
        return job

    def get_forecast(self, digest: str) -> StoredForecast:
        """Return the forecast of a program; Refused while there is none."""
        job = self.get_job(digest)
        if job.forecast is None:
            raise RequestRefused(
                409, "NotReady", f"the forecast of {job.name} is {job.forecasting.state}", "wait until it is done"
            )
        return job.forecast

    async def add_program(self, name: str, content: AsyncIterable[bytes]) -> ForecastJob:
        """Store a program's bytes and have it forecast; known bytes are forecast again, unless that is in progress.

        Refused if too many wait, or for an empty file. A program that is still being uploaded does not displace others.
        """
        self._check_queue_length()
        suffix = ".csv" if name.lower().endswith(".csv") else ".ngc"
        part = self._make_folder() / f".{os.urandom(8).hex()}.part"
        try:
            digest = await _write_program(part, content)
            running = self._jobs.get(digest)
            if running is not None and not running.is_over:
                return running
            self._check_queue_length()
            folder = self._make_folder() / digest
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            program = folder / f"program{suffix}"
            part.rename(program)
        except OSError as error:
            text = f"the program cannot be stored ({error.strerror or error}), nothing was computed"
            raise RequestRefused(507, "DiskFault", text, "free space on the disk of temporary files") from None
        finally:
            part.unlink(missing_ok=True)
        job = self._jobs[digest] = ForecastJob(digest, clean_name(name), folder, program)
        self._jobs.move_to_end(digest)
        self._remove_oldest()
        self._start_task(job, job.forecasting)
        return job

    def request_advice(self, digest: str, tolerance_um: float) -> ForecastJob:
        """Compute the feeds that keep a program's path within a tolerance; Refused while there is no forecast."""
        job = self.get_job(digest)
        self.get_forecast(digest)
        if job.advising is None or job.advising.is_over:
            self._check_queue_length()
            job.advising = ForecastTask(tolerance_um)
            self._start_task(job, job.advising)
        return job

    def _check_queue_length(self) -> None:
        if sum(not work.is_over for job in self._jobs.values() for work in job.tasks) > MOST_WAITING:
            text = f"{MOST_WAITING} programs are waiting already, this one was not accepted"
            raise RequestRefused(429, "TooMany", text, "wait for one of them, or cancel it")

    def _start_task(self, job: ForecastJob, work: ForecastTask) -> None:
        work.task = asyncio.create_task(self._run_task(job, work), name=f"forecast of {job.name}")

    def _make_folder(self) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="fdhil-web-"))
        return self._folder

    def _remove_oldest(self) -> None:
        for digest, job in list(self._jobs.items()):
            if len(self._jobs) > KEPT and job.is_over:
                del self._jobs[digest]
                shutil.rmtree(job.folder, ignore_errors=True)

    async def cancel_job(self, digest: str) -> ForecastJob:
        """Cancel the computations of a program; completed ones are kept."""
        job = self.get_job(digest)
        for work in job.tasks:
            if work.task is not None and not work.is_over:
                work.task.cancel()
                await asyncio.wait([work.task])
                work.state = "cancelled"  # also if it had not begun
        return job

    async def close(self) -> None:
        tasks = [work.task for job in self._jobs.values() for work in job.tasks if work.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._jobs.clear()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    async def _run_task(self, job: ForecastJob, work: ForecastTask) -> None:
        try:
            async with self._one:
                work.state = "computing"
                async with asyncio.timeout(LONGEST_S):
                    await self._compute_task(job, work)
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

    async def _compute_task(self, job: ForecastJob, work: ForecastTask) -> None:
        def take_message(message: Mapping[str, Any]) -> None:
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
        code = await BoundedProcess(MAKER).run(request, take_message)
        if work.fault is None:
            await _read_result(job, work, code)


async def _read_result(job: ForecastJob, work: ForecastTask, code: int) -> None:
    try:
        if code != 0:
            raise ValueError(code)
        if work.tolerance_um is None:
            job.forecast = await asyncio.to_thread(StoredForecast.read_folder, job.folder)
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


async def _write_program(part: Path, content: AsyncIterable[bytes]) -> str:
    digest, size = hashlib.sha256(), 0
    with part.open("xb") as file:
        async for piece in content:
            size += len(piece)
            digest.update(piece)
            file.write(piece)
    if size == 0:
        raise RequestRefused(
            422, "BadRequest", "the file is empty, nothing was computed", "drop an NC program or a demand"
        )
    return digest.hexdigest()


def clean_name(name: str) -> str:
    """Return a file name for display: its last part, printable, of limited length."""
    last = name.replace("\\", "/").rpartition("/")[2]
    printable = "".join(letter for letter in last if letter.isprintable())[:LONGEST_NAME].strip()
    return printable or "program"
