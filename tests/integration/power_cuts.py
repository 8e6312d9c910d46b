"""Cuts the power of a machine while it stores records of every kind, boots it again, and checks the records.

The machine is a user-mode Linux with an ext4 disk image. A cut is SIGKILL for all of it: unwritten data are lost as on
a real machine. ``python -m tests.integration.power_cuts CUTS PICTURES`` prints a table.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.crash.call_faults import looked_at
from tests.crash.stored_records import KEEPERS, MUCH_LATER, place_of

ROOT = Path(__file__).parents[2]
CACHE = Path(os.environ.get("VCAN_VM_CACHE") or Path.home() / ".cache" / "vcan-vm")
DISK_BYTES = 64 << 20
MEMORY_MIB = 512
COPIED_BYTES = 64 << 10
INIT = """#!{cache}/busybox sh
B={cache}/busybox
$B mount -t proc proc /proc
$B mount -t devtmpfs dev /dev
$B mount -t tmpfs tmp /mnt
$B mkdir /mnt/disk
$B mount -t ext4 /dev/ubda /mnt/disk || {{ echo "told no disk"; $B poweroff -f; }}
cd {root}
export PYTHONPATH={root} PYTHONDONTWRITEBYTECODE=1 HOME=/mnt OPENBLAS_NUM_THREADS=1
{python} -m tests.integration.power_cut_work /mnt/disk/store {how} 2>&1
echo "told ended"
$B poweroff -f
"""


Numbers = dict[str, set[int]]
"""Records, by their kind."""


@dataclass
class Findings:
    cuts: int = 0
    pictures: int = 0
    acknowledged: Counter[str] = field(default_factory=Counter)
    checked: int = 0
    lost: list[str] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)


def prepare() -> None:
    subprocess.run(["bash", ROOT / "tests/integration/vcan-vm.sh", "-q", "-m", "uml", "-p"], check=True)


def make_disk(folder: Path) -> Path:
    disk = folder / "disk"
    with disk.open("wb") as file:
        file.truncate(DISK_BYTES)
    subprocess.run(["mkfs.ext4", "-q", "-F", disk], check=True)
    return disk


@contextmanager
def booted(folder: Path, disk: Path, how: str) -> Iterator[subprocess.Popen[str]]:
    init = folder / "init"
    init.write_text(INIT.format(cache=CACHE, root=ROOT, python=sys.executable, how=how))
    init.chmod(0o755)
    padded = CACHE / "uml" / "xstate.so"
    environment = {"TMPDIR": str(folder), "PATH": os.environ["PATH"]}
    if padded.exists():
        environment["LD_PRELOAD"] = str(padded)
    arguments = [f"mem={MEMORY_MIB}M", f"ubd0={disk}", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro"]
    arguments += [f"init={init}", f"uml_dir={folder}", "con=null", "con0=null,fd:1", "ssl=null", "quiet", "panic=-1"]
    machine = subprocess.Popen(
        [CACHE / "uml" / "bin" / "linux.uml", *arguments],
        env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, errors="replace", start_new_session=True,
    )  # fmt: skip
    assert machine.stdout is not None
    try:
        yield machine
    finally:
        cut(machine)
        machine.wait()
        machine.stdout.close()


def cut(machine: subprocess.Popen[str]) -> None:
    os.killpg(machine.pid, signal.SIGKILL)


def cut_power(cuts: int, folder: Path, how: str = "careful", seed: int = 1, pictures: int = 0) -> Findings:
    found, chance = Findings(), random.Random(seed)
    disk, kept = make_disk(folder), {name: set[int]() for name in KEEPERS}
    for number in range(cuts + 1):
        with booted(folder, disk, how) as machine:
            assert machine.stdout is not None
            found.cuts = number
            if not _looked(machine.stdout, kept, found) or number == cuts:
                break
            for _ in range(pictures):
                _heard(machine.stdout, chance.randint(1, 25), kept, found)
                _pictured(machine, disk, folder / "picture", kept, found)
            _heard(machine.stdout, chance.randint(1, 25), kept, found)
            cut(machine)
            _heard(machine.stdout, sys.maxsize, kept, found)  # what it had acknowledged by then
    found.acknowledged = Counter({name: len(numbers) for name, numbers in kept.items()})
    return found


def _looked(console: Iterable[str], kept: Numbers, found: Findings) -> bool:
    for line in console:
        what, _, rest = line.strip().partition(" ")
        if what == "found":
            _compare({name: set(numbers) for name, numbers in json.loads(rest).items()}, kept, found)
            return True
        if what in ("told", "Traceback"):
            found.damage.append(f"cut {found.cuts}: {_said(line, console)}")
            break
    return False


def _compare(there: Mapping[str, set[int]], kept: Numbers, found: Findings) -> None:
    where = f"cut {found.cuts}, picture {found.pictures}"
    for name, numbers in kept.items():
        found.checked += len(numbers)
        found.lost += [f"{where}: {name} {number}" for number in sorted(numbers - there[name])]


def _heard(console: Iterable[str], records: int, kept: Numbers, found: Findings) -> None:
    for line in console:
        what, _, rest = line.rstrip("\n").partition(" ")
        if what == "kept" and line.endswith("\n"):
            name, _, number = rest.rpartition(" ")
            kept[name].add(int(number))
            records -= 1
        elif what in ("told", "Traceback"):
            found.damage.append(f"after cut {found.cuts}: {_said(line, console)}")
        if records <= 0:
            return


def _said(line: str, console: Iterable[str]) -> str:
    if line.startswith("Traceback"):
        line = next((end for end in console if end.strip() and not end.startswith((" ", "\t"))), line)
    return line.strip()[:300]


def _pictured(machine: subprocess.Popen[str], disk: Path, folder: Path, kept: Numbers, found: Findings) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    picture = folder / "disk"
    _take(machine, disk, picture)
    found.pictures += 1
    check = subprocess.run(["e2fsck", "-fy", picture], capture_output=True, text=True, check=False)
    if check.returncode > 1:  # more than a journal that was played
        found.damage.append(f"picture {found.pictures}: {check.stdout[-300:]}")
    subprocess.run(["debugfs", "-R", f"rdump /store {folder}", picture], check=True, capture_output=True)
    there = {}
    for name, make in KEEPERS.items():
        result = looked_at(make, folder / "store" / place_of(name), MUCH_LATER)
        there[name] = set(result.found)
        found.damage += [f"picture {found.pictures}: {name}: {text}" for text in (*result.wrong, *result.said)]
    _compare(there, kept, found)


def _take(machine: subprocess.Popen[str], disk: Path, picture: Path) -> None:
    processes = [machine.pid, *_writers(machine.pid)]
    for pid in processes:
        os.kill(pid, signal.SIGSTOP)
    while not all(_state(pid) == "T" for pid in processes):
        time.sleep(0.001)
    _copy(disk, picture)
    for pid in reversed(processes):
        os.kill(pid, signal.SIGCONT)


def _copy(disk: Path, picture: Path) -> None:
    with disk.open("rb") as source, picture.open("wb") as copy:
        while chunk := source.read(COPIED_BYTES):
            if chunk.strip(b"\0"):
                copy.seek(source.tell() - len(chunk))
                copy.write(chunk)
        copy.truncate(DISK_BYTES)


def _writers(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    children = [int(child) for task in tasks for child in task.read_text("ascii").split()]
    return [child for child in children if "TracerPid:\t0\n" in Path(f"/proc/{child}/status").read_text("ascii")]


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()[0]


def main() -> int:
    cuts, pictures = (int(number) for number in sys.argv[1:])
    prepare()
    with tempfile.TemporaryDirectory(prefix="power-cuts-") as name:
        found = cut_power(cuts, Path(name), pictures=pictures)
    for key, value in vars(found).items():
        sys.stdout.write(f"{key:12} {value}\n")
    return 1 if found.lost or found.damage or found.cuts < cuts else 0


if __name__ == "__main__":
    sys.exit(main())
