"""What happens in a shop that runs for long: rounds of rapids, and between them what a working life is made of."""

from __future__ import annotations

import json
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from fdhil.errors import FdhilError
from studies.soak_clients import (
    Silent,
    browse_pages,
    drop_a_program,
    flood_bus,
    leave_live_stream,
    look_at_a_rapid,
    scrape_metrics,
    send_invalid_requests,
)
from studies.soak_shop import MachineRig
from studies.usage import measure_size_mb, measure_usage

RAPIDS = 40  # in a round, of both axes together
THERE_AND_BACK = "G0 X160 Y160\nG4 P0.2\nG0 X0 Y0\nG4 P0.2\n"  # four rapids
NOTE_S = 30.0  # between two notes in a rest
CORNER = "G21 G90 G94\nG4 P0.3\nG1 X60 F8000\nG1 Y40\nG4 P0.2\nG1 X0 Y0\nG4 P0.2\nM2\n"
FLOOD = 50_000  # emergencies at a time
SETTLED_LOOKS = 3
SIZES = ("windows", "history.sqlite", "history.sqlite-wal", "audit.jsonl", "blackbox")


@dataclass
class Life:
    """A shop at work; ``happened`` counts what happened, ``failed`` what did not answer as it must."""

    shop: MachineRig
    samples: Path
    seed: int
    rapids: int = RAPIDS
    began_s: float = field(default_factory=time.monotonic)
    rounds: int = 0
    happened: Counter[str] = field(default_factory=Counter)
    failed: Counter[str] = field(default_factory=Counter)
    silent: Silent = field(default_factory=Silent)
    rng: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        round_ = "G21 G17 G90 G94\n" + THERE_AND_BACK * (self.rapids // 4) + "M2\n"
        for name, text in (("round.ngc", round_), ("corner.ngc", CORNER)):
            (self.shop.folder / name).write_text(text, "utf-8")

    def round(self, events: Mapping[str, Event]) -> None:
        """Let the machine work for a round with what is due in it, and note what everybody uses after it."""
        self.rounds += 1
        self.shop.restart_ended()
        due = [name for name, event in events.items() if self.rounds % event.every == event.every // 2]
        during = [name for name in due if events[name].during]

        def others() -> None:
            for name in during:
                self.happen(name, events[name])

        whole = self.shop.play_program(self.shop.folder / "round.ngc", others)
        self.happened["rounds" if whole else "rounds that a fault stopped"] += 1
        self.settle()
        for name in due:
            if name not in during:
                self.happen(name, events[name])
        self.note()

    @property
    def at_s(self) -> float:
        """How long it has gone on."""
        return time.monotonic() - self.began_s

    def rest(self, seconds: float) -> None:
        """Let nothing happen for so long, and note now and then what everybody uses."""
        until_s = self.at_s + seconds
        while (left_s := until_s - self.at_s) > 0:
            time.sleep(min(left_s, NOTE_S))
            self.note()

    def happen(self, name: str, event: Event) -> None:
        """Run one event; requests without an answer are counted."""
        self.happened[name] += 1
        try:
            bad = event.act(self)
        except (FdhilError, OSError, TimeoutError) as error:
            self.failed[f"{name}: {error}"[:200]] += 1
            return
        if bad:
            self.failed[name] += bad

    def settle(self) -> None:
        """Wait until the daemon has analysed what it received."""
        before, same = None, 0
        while same < SETTLED_LOOKS:
            axes = self.shop.read_status_part("axes")
            now = {name: told["accepted"] + told["refused"] for name, told in axes.items()}
            same = same + 1 if now == before else 0
            before = now
            time.sleep(0.1)

    def note(self) -> None:
        """Append what everybody uses, and what the daemon counts, to the file of samples."""
        status = self.shop.query_status() or {}
        process = {}
        for name, pid in self.shop.list_pids().items():
            try:
                process[name] = {"pid": pid, **asdict(measure_usage(pid))}
            except OSError:
                continue
        axes = status.get("axes", {})
        reported = {
            "at_s": self.at_s,
            "round": self.rounds,
            "rapids": {name: [axis["accepted"], axis["refused"]] for name, axis in axes.items()},
            "frames": status.get("frames", {}),
            "dropped": status.get("dropped", {}),
            "unacknowledged": status.get("unacknowledged", {}).get("count"),
            "process": process,
            "store_mb": {name: measure_size_mb(self.shop.store / name) for name in SIZES},
            "log_mb": {file.stem: measure_size_mb(file) for file in sorted(self.shop.logs.glob("*.log"))},
            "happened": dict(self.happened),
            "failed": dict(self.failed),
            "restarts": dict(self.shop.restarts),
        }
        with self.samples.open("a", encoding="utf-8") as file:
            file.write(json.dumps(reported) + "\n")


@dataclass(frozen=True)
class Event:
    """Something that happens every so many rounds, while the rapids are played or after them; returns what failed."""

    every: int
    act: Callable[[Life], int]
    during: bool = False


def clients(life: Life) -> int:
    """Run browsers and scrapers, a viewer that leaves in mid-line, and a client with invalid requests."""
    shop = life.shop
    return browse_pages(shop) + scrape_metrics(shop) + leave_live_stream(shop) + send_invalid_requests(shop)


def arm(life: Life) -> bool:
    """Arm a program; what an earlier correction may have left in the drives is adopted first, as an operator would."""
    shop = life.shop
    token = (shop.folder / "run" / "token").read_text("utf-8").strip()
    for code in ("OffsetStands", None):
        answer = shop.query_daemon("arm", program=str(shop.folder / "corner.ngc"), token=token)
        if not code or answer.get("code") != code:
            break
        adopted = shop.run_command("adopt", "--yes", fine=(0, 1, 3)).get("ok")
        life.happened["adopted" if adopted else "an adoption refused"] += 1
    if not answer.get("ok"):
        life.failed[f"arm: {answer.get('code')}"] += 1
    return bool(answer.get("ok"))


def armed(life: Life) -> int:
    """Arm a program and cut it."""
    shop = life.shop
    if not arm(life):
        return 0
    shop.play_program(shop.folder / "corner.ngc")
    shop.wait(lambda: shop.read_status_part("state") in ("OFF", "OFF(SHADOW)", "FROZEN"), "the guard comes to rest")
    cause = (shop.read_status_part("guard").get("cause") or {}).get("code")
    life.happened[f"cut ended by {cause}"] += 1
    return 0


def armed_and_hurt(life: Life) -> int:
    """Arm, and lose TPDOs of a drive in the cut: the guard ramps down and a black box is written."""
    life.shop.start_fault("drop_tpdo", axis="X", value=3, at_row=life.rng.randint(100, 300), duration_s=0.3)
    return armed(life)


def disarmed(life: Life) -> int:
    """Arm, and disarm at once."""
    if not arm(life):
        return 0
    life.happened["disarmed"] += 1
    return int(not life.shop.query_daemon("disarm").get("ok"))


def frames_lost(life: Life) -> int:
    """A drive's TPDOs are lost for a while."""
    axis = life.rng.choice("XY")
    life.shop.start_fault("drop_tpdo", axis=axis, value=life.rng.choice((1, 2)), duration_s=life.rng.uniform(0.02, 0.4))
    return 0


def sensor_silent(life: Life) -> int:
    """A thermometer answers nothing, or refuses."""
    axis = life.rng.choice("XY")
    life.shop.start_fault("sensor_silent", axis=axis, duration_s=2.0)
    return 0


def emergencies(life: Life) -> int:
    """A drive floods the bus with emergencies."""
    life.happened["emergencies"] += flood_bus(life.shop, FLOOD)
    return 0


def sync_lost(life: Life) -> int:
    """The NC's SYNC fails for a while."""
    life.shop.start_fault("sync_lost", duration_s=0.5)
    return 0


def reboot(life: Life) -> int:
    """A drive loses its power for a moment: the NC stops, the record is void until the drive is compared."""
    shop = life.shop
    shop.start_fault("reboot", axis="X")
    shop.switch_nc(on=False)
    shop.compare_drives()
    return 0


def trip(life: Life) -> int:
    """A drive trips; the operator clears it."""
    shop = life.shop
    shop.start_fault("trip", axis="Y", value=0x3210)
    time.sleep(0.3)
    shop.switch_nc(on=True)
    return 0


def machine_off(life: Life) -> int:
    """The machine is switched off and on."""
    life.shop.power_cycle()
    return 0


def disk_full(life: Life) -> int:
    """The disk is full for a round."""
    shop = life.shop
    if not shop.mounted:
        return 0
    ballast = shop.folder / "store" / "ballast"
    try:
        with ballast.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(1 << 20))
    except OSError:
        pass
    shop.play_program(shop.folder / "round.ngc")
    life.settle()
    reported = shop.read_status_part("store").get("fault")
    ballast.unlink()
    shop.play_program(shop.folder / "round.ngc")
    life.settle()
    return int(reported is None) + int(shop.read_status_part("store").get("fault") is not None)


def acknowledge(life: Life) -> int:
    """Acknowledge every notice."""
    return int(not life.shop.query_daemon("acknowledge", up_to=2**31, by="soak").get("ok"))


def again(name: str, number: int) -> Callable[[Life], int]:
    """Return what ends one of fdhil's processes by a signal and starts it again."""

    def act(life: Life) -> int:
        life.shop.restart(name, number)
        return 0

    return act


def program(life: Life) -> int:
    """Upload a program in a browser."""
    return drop_a_program(life.shop, f"part{life.rounds}.ngc", f"(part {life.rounds})\n{CORNER}")


EVENTS: Mapping[str, Event] = {
    "clients came and went": Event(1, clients, during=True),
    "a viewer that never reads": Event(7, lambda life: life.silent.connect_silently(life.shop)),
    "a rapid was looked at": Event(3, lambda life: look_at_a_rapid(life.shop)),
    "a program was dropped in a browser": Event(11, program),
    "armed and cut": Event(5, armed),
    "armed, frames lost in the cut": Event(13, armed_and_hurt),
    "armed and disarmed": Event(9, disarmed),
    "TPDOs lost": Event(4, frames_lost, during=True),
    "thermometer silent": Event(6, sensor_silent, during=True),
    "flood of emergencies": Event(16, emergencies, during=True),
    "SYNC lost": Event(14, sync_lost, during=True),
    "drive tripped": Event(22, trip),
    "drive rebooted": Event(34, reboot),
    "machine off and on": Event(100, machine_off),
    "disk full": Event(40, disk_full),
    "notices acknowledged": Event(10, acknowledge),
}
RESTARTS: Mapping[str, Event] = {
    "a program was dropped in a browser": Event(3, program),  # until as many are kept as ever are
    "daemon restarted": Event(8, again("daemon", signal.SIGTERM)),
    "daemon killed": Event(12, again("daemon", signal.SIGKILL)),
    "guard restarted": Event(10, again("guard", signal.SIGTERM)),
}
