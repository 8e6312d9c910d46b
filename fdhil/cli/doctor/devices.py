"""Examines the connected devices by the comparison of ``fdhil check``, and the daemon and the guard."""

from collections.abc import Callable, Collection, Iterator, Sequence

from fdhil.arming import GuardClient
from fdhil.cli.doctor.trouble import Trouble
from fdhil.commissioning import RECORD_POINT, Place, check_machine
from fdhil.config import MachineConfig
from fdhil.daemon import SOCKET_NAME as DAEMON_SOCKET
from fdhil.daemon import ask_daemon, describe_config_difference
from fdhil.errors import DeviceError
from fdhil.guard import SOCKET_NAME

ORDER = ("NC", "SYNC", "drive")  # prerequisites of all other points of a drive
MEANS = {
    "voltage": "resistance and inductance of this axis cannot be identified",
    "temperature": "drift can be related only to time",
    "heartbeat": "the loss of a drive is detected later",
    "SYNC": "samples get wrong times",
    "loops": "the regulators of the configuration differ from the drive's, and predictions are wrong",
}
WITHOUT = "signals of this drive are misread or missing"
HARMLESS = frozenset({"heartbeat", "temperature", "loops"})


def examine_devices(
    config: MachineConfig, buses: Collection[str], recorded: Collection[str], say: Callable[[str], None]
) -> Iterator[Trouble]:
    """Compare the devices of the axes on ``buses`` with the configuration, by listening, or reading if no NC is active.

    ``recorded`` are the places whose commissioning record is known to be bad.
    """
    axes = {name: axis for name, axis in config.axis.items() if axis.drive.bus in buses}
    if not axes:
        return
    try:
        found = check_machine(config.model_copy(update={"axis": axes}), say)
    except DeviceError as error:
        yield Trouble.create_from_error(type(error).__name__, error.device, error, "no drive can be received")
        return
    yield from list_troubles([each for each in found if each[0] not in recorded or each[1].point != RECORD_POINT])


def list_troubles(found: Sequence[Place]) -> list[Trouble]:
    """Return the differences in the order in which to fix them; an absent drive hides its other differences."""
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
    """Compare the configuration with that of a running daemon."""
    if not (config.run_directory / DAEMON_SOCKET).exists():
        return
    try:
        difference = describe_config_difference(
            ask_daemon(config.run_directory / DAEMON_SOCKET, {"request": "status"}), config.digest
        )
    except DeviceError as error:
        yield Trouble.create_from_error(
            "DaemonSilent", "daemon", error, "nothing is identified, and nothing can be armed"
        )
        return
    if difference:
        what, _, mend = difference.partition("; ")
        means = "the machine is corrected with values other than those in the file"
        yield Trouble("ConfigDiffers", "daemon", what, means, mend, False)


def examine_guard(config: MachineConfig) -> Iterator[Trouble]:
    """Examine a running guard; a guard that does not run is no problem, because nothing is sent without it."""
    if not (config.guard_directory / SOCKET_NAME).exists():
        return
    try:
        with GuardClient(config.guard_directory) as guard:
            state = str(guard.read_status().get("state"))
    except DeviceError as error:
        means = "nothing can be armed, and applied offsets remain in the drives"
        yield Trouble.create_from_error("GuardSilent", "guard", error, means)
        return
    if state == "FROZEN":
        what = "it holds the offsets (FROZEN), because the state of the drives is unknown"
        means = "the drives may still apply an offset of an earlier correction"
        yield Trouble("GuardFrozen", "guard", what, means, "hold the feed, then run `fdhil adopt`")
