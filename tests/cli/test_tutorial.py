"""The one-hour tutorial, executed line by line: terminals are processes, the panel is standard input."""

from __future__ import annotations

import queue
import re
import shlex
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdhil.child_process import wrap_to_end_with_parent
from tests.free_ports import find_free_port

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/tutorial/an-hour.md"
PATIENCE_S = 900.0  # only for hanging processes
SERVERS = {"fdhil sim": "is ready", "fdhil run": " ready: ", "fdhil-guard": '"event": "ready"'}
TYPED_BY_THE_TEST = ("make setup", ". .venv", "mkdir", "cd ")
RAPIDS = 20


class Terminal:
    def __init__(self, words: list[str], folder: Path) -> None:
        self._child = subprocess.Popen(
            wrap_to_end_with_parent(words),
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._printed: list[str] = []
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def type(self, line: str) -> None:
        assert self._child.stdin is not None
        self._child.stdin.write(line + "\n")
        self._child.stdin.flush()

    def wait_for(self, text: str, times: int = 1) -> None:
        while times:
            line = self._lines.get(timeout=PATIENCE_S)
            assert line is not None, "".join(self._printed)
            self._printed.append(line)
            times -= text in line

    def end(self) -> None:
        self._child.terminate()
        self._child.communicate(timeout=PATIENCE_S)
        self._reader.join()


class Workstation:
    def __init__(self, folder: Path) -> None:
        self._ports = {"29536": str(find_free_port()), "port = 5020": "port = 0", "port = 5021": "port = 0"}
        shutil.copytree(ROOT / "configs", folder / "configs", symlinks=True)
        shipped = folder / "configs/sim.toml"
        shipped.write_text(self._assign_free_ports(shipped.read_text("utf-8")), "utf-8")
        self.folder = folder / "hour"
        self.folder.mkdir()
        self.open: dict[str, Terminal] = {}

    def _assign_free_ports(self, text: str) -> str:
        for usual, free in self._ports.items():
            text = text.replace(usual, free)
        return text

    def execute_line(self, language: str, block: str) -> str:
        match language:
            case "toml":
                (self.folder / "answers.toml").write_text(self._assign_free_ports(block), "utf-8")
                return ""
            case "sh":
                return [self._prepare_command(line) for line in block.splitlines()][-1]
            case "text":
                return [self._type_panel_command(line) for line in block.splitlines()][-1]
        raise AssertionError(f"the page has a block of {language}")

    def _prepare_command(self, line: str) -> str:
        if line.startswith(TYPED_BY_THE_TEST):
            return ""
        name, *arguments = shlex.split(line)
        module = {"fdhil": "fdhil", "fdhil-guard": "fdhil.cli.guard"}[name]
        words = [sys.executable, "-m", module, *arguments]
        for server, ready in SERVERS.items():
            if line.startswith(server):
                self.open[server] = Terminal(words, self.folder)
                self.open[server].wait_for(ready)
                return ""
        return self._run_command(words)

    def _run_command(self, words: list[str]) -> str:
        done = subprocess.run(words, cwd=self.folder, input="y\n" * 20, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout

    def _type_panel_command(self, line: str) -> str:
        self.open["fdhil sim"].type(line)
        if "shuttle" in line:
            self.open["fdhil run"].wait_for("accepted", RAPIDS)
        elif "play" in line:
            self.open["fdhil sim"].wait_for("finished")
        return ""

    def close(self) -> None:
        for server in ("fdhil run", "fdhil-guard", "fdhil sim"):
            if server in self.open:
                self.open[server].end()


@pytest.fixture
def workstation(tmp_path: Path, processes: None) -> Iterator[Workstation]:
    del processes
    made = Workstation(tmp_path)
    yield made
    made.close()


def test_tutorial_ends_with_corrected_pass(workstation: Workstation) -> None:
    blocks = re.findall(r"^```(\w+)\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    printed = {block: workstation.execute_line(language, block) for language, block in blocks}
    (compared,) = (text for block, text in printed.items() if block.startswith("fdhil compare"))
    (factor,) = re.findall(r"smaller by a factor of ([\d.]+)", compared)
    assert float(factor) > 10.0
    assert (workstation.folder / "report.html").stat().st_size > 10_000
