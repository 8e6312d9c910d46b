"""Examines what is wired to the PC, through the comparison of ``fdhil check``, and asks the guard how it is."""

from collections.abc import Callable, Collection, Iterator, Sequence

from fdhil.arming.guard_client import GuardClient
from fdhil.cli.doctor.trouble import Trouble
from fdhil.commissioning.compare import POINT
from fdhil.commissioning.config_check import Place, check_machine
from fdhil.config import MachineConfig
from fdhil.daemon.control import SOCKET_NAME as DAEMON_SOCKET
from fdhil.daemon.control import ask
from fdhil.daemon.status import config_difference
from fdhil.errors import DeviceError
from fdhil.guard.protocol import SOCKET_NAME

ORDER = ("NC", "SYNC", "drive")  # what must be right before anything else of a drive can be
MEANS = {
    "voltage": "resistance and inductance of this axis cannot be identified",
    "temperature": "drift is told by time alone",
    "heartbeat": "a drive that falls silent is noticed later",
    "SYNC": "samples are placed at the wrong instants",
    "loops": "the regulators of the config are not the drive's, and predictions are off",
}
WITHOUT = "what this drive tells is misread or missing"
HARMLESS = frozenset({"heartbeat", "temperature", "loops"})


def examine_devices(
    config: MachineConfig, buses: Collection[str], recorded: Collection[str], say: Callable[[str], None]
) -> Iterator[Trouble]:
    """Compare the devices of the axes on ``buses`` with the config; they are only listened to, or read with no NC.

    Of the places in ``recorded`` it is known that their commissioning record is bad.
    """
    axes = {name: axis for name, axis in config.axis.items() if axis.drive.bus in buses}
    if not axes:
        return
    try:
        found = check_machine(config.model_copy(update={"axis": axes}), say)
    except DeviceError as error:
        what, _, mend = str(error).partition("; ")
        yield Trouble(type(error).__name__, error.device, what, "no drive can be heard", mend)
        return
    yield from troubles_of([each for each in found if each[0] not in recorded or each[1].point != POINT])


def troubles_of(found: Sequence[Place]) -> list[Trouble]:
    """Return what differs, in the order in which it must be mended: a drive that is away tells nothing of the rest."""
    differ = [(place, finding) for place, finding in found if finding.ok is False]
    rank = {point: k for k, point in enumerate(ORDER)}
    differ.sort(key=lambda item: (rank.get(item[1].point, len(ORDER)), item[1].point in HARMLESS))
    away = {place for place, finding in differ if finding.point == "drive"}
    return [
        Trouble(
            f"{finding.point.title().replace(' ', '').replace('-', '')}Differs",
            place,
            finding.cause,
            MEANS.get(finding.point, WITHOUT),
            finding.advice,
            finding.point not in HARMLESS,
        )
        for place, finding in differ
        if place not in away or finding.point in ("drive", *MEANS)
    ]


def examine_daemon(config: MachineConfig) -> Iterator[Trouble]:
    """Ask a running daemon whether the configuration is the one that it runs with."""
    if not (config.run_directory / DAEMON_SOCKET).exists():
        return
    try:
        difference = config_difference(ask(config.run_directory / DAEMON_SOCKET, {"request": "status"}), config.digest)
    except DeviceError as error:
        what, _, mend = str(error).partition("; ")
        yield Trouble("DaemonSilent", "daemon", what, "nothing is identified, and nothing can be armed", mend)
        return
    if difference:
        what, _, mend = difference.partition("; ")
        means = "what is shown or edited in the file is not what the machine is corrected by"
        yield Trouble("ConfigDiffers", "daemon", what, means, mend, False)


def examine_guard(config: MachineConfig) -> Iterator[Trouble]:
    """Ask a running guard; one that does not run is no trouble, since nothing starts to send by itself."""
    if not (config.guard_directory / SOCKET_NAME).exists():
        return
    try:
        with GuardClient(config.guard_directory) as guard:
            state = str(guard.status().get("state"))
    except DeviceError as error:
        what, _, mend = str(error).partition("; ")
        yield Trouble("GuardSilent", "guard", what, "nothing can be armed, and what stands in the drives stays", mend)
        return
    if state == "FROZEN":
        what = "it holds the offsets where they are (FROZEN), since it cannot know what the drives do"
        means = "an offset of an earlier correction may stand in the drives"
        yield Trouble("GuardFrozen", "guard", what, means, "hold the feed, then run `fdhil adopt`")
