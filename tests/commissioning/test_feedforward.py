"""Speed and torque offset: commissioned on a drive that applies them correctly, refused by name on any other."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator

import pytest

from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError, DriveFault
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer

Frames = list[tuple[int, bytes]]
NOT_VALID = 0x80000401


class FaultyDrive(DrivePeer):
    """A drive whose received frames ``spoil`` changes, answers (a list of frames) or drops (None)."""

    spoil: Callable[[int, bytes], bytes | Frames | None] = staticmethod(lambda _id, data: data)

    def handle_frame(self, can_id: int, data: bytes) -> Frames:
        changed = self.spoil(can_id, data)
        if isinstance(changed, bytes):
            return super().handle_frame(can_id, changed)
        return changed or []

    def feedforward_cob_id(self) -> int:
        """COB-ID of the RPDO with both offsets."""
        return self.drive.dictionary.get_number(0x1402, 1)

    def active_offsets(self) -> tuple[int, int]:
        """Active speed and torque offset."""
        return self.drive.dictionary.get_number(0x60B1), self.drive.dictionary.get_number(0x60B2)


pytestmark = pytest.mark.usefixtures("fast_commissioning")


@pytest.fixture
def peer() -> Iterator[tuple[FaultyDrive, MachineConfig]]:
    bus: dict[str, object] = {"interface": "virtual", "channel": uuid.uuid4().hex}
    settings = build_machine_config(bus=bus, feedforward={})
    with FaultyDrive(settings) as running:
        yield running, settings


@pytest.mark.usefixtures("long_computation")
def test_drive_that_applies_both_offsets_is_signed_off_with_cob_id(peer: tuple[FaultyDrive, MachineConfig]) -> None:
    drive, settings = peer
    seen: list[tuple[int, int]] = []

    def record_frames(can_id: int, data: bytes) -> bytes:
        if can_id == 0x401:
            seen.append((int.from_bytes(data[:4], "little", signed=True), int.from_bytes(data[4:], "little")))
        return data

    drive.spoil = record_frames
    record = commission_axis(settings, "X")
    assert record.options["1402"] == drive.feedforward_cob_id() == 0x401
    assert set(seen) == {(0x0102, 3), (0, 0)}
    assert seen[-1] == (0, 0)
    assert drive.active_offsets() == (0, 0)


def swap_offsets(can_id: int, data: bytes) -> bytes:
    return data[2:] + data[:2] if can_id == 0x401 else data


def drop_torque_offset(can_id: int, data: bytes) -> bytes:
    return data[:4] + bytes(2) if can_id == 0x401 else data


def drop_frame(can_id: int, data: bytes) -> bytes | None:
    return None if can_id == 0x401 else data


def keep_offset(can_id: int, data: bytes) -> bytes | None:
    return None if can_id == 0x401 and not any(data) else data


def abort_download(can_id: int, data: bytes) -> bytes | Frames:
    if can_id == 0x601 and data[0] >> 5 == 1 and data[1:3] == b"\x02\x14":
        return [(0x581, b"\x80" + data[1:4] + (0x06010000).to_bytes(4, "little"))]
    return data


def ignore_download(can_id: int, data: bytes) -> bytes | Frames:
    """Confirm a download to 0x1402 without executing it."""
    if can_id == 0x601 and data[0] >> 5 == 1 and data[1:3] == b"\x02\x14":
        return [(0x581, b"\x60" + data[1:4] + bytes(4))]
    return data


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (swap_offsets, "was sent (258, 3) as speed and torque offset and holds"),
        (drop_torque_offset, "holds (258, 0)"),
        (drop_frame, "holds (0, 0)"),
        (keep_offset, "was sent (0, 0) as speed and torque offset and holds (258, 3)"),
        (abort_download, "it refuses the RPDO of 60B1 and 60B2"),
        (ignore_download, "the RPDO of 60B1 and 60B2 stays at 80000401"),
    ],
)
def test_drive_with_faulty_offsets_is_refused_and_restored(
    spoil: Callable[[int, bytes], bytes | Frames | None], says: str, peer: tuple[FaultyDrive, MachineConfig]
) -> None:
    drive, settings = peer
    drive.spoil = spoil
    with pytest.raises(DriveFault, match="FeedforwardOff: ") as caught:
        commission_axis(settings, "X")
    assert says in str(caught.value)
    assert "remove [axis.X.feedforward]" in str(caught.value)
    assert drive.feedforward_cob_id() == NOT_VALID
    assert drive.active_offsets() == (0, 0)
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"


@pytest.mark.parametrize("entries", [[(0x60B2, 0, 16), (0x60B1, 0, 32)], [(0x60B1, 0, 32)], []])
def test_different_mapping_is_refused_before_writing(
    entries: list[tuple[int, int, int]], peer: tuple[FaultyDrive, MachineConfig]
) -> None:
    drive, settings = peer
    drive.drive.overwrite_mapping(0x1602, entries)
    with pytest.raises(DriveFault, match=r"FeedforwardOff: its RPDO3 maps .* instead of 60B1 and 60B2"):
        commission_axis(settings, "X")
    assert drive.feedforward_cob_id() == NOT_VALID
    assert not {0x000, 0x080, 0x401} & set(drive.heard)


def test_later_failure_makes_rpdo_invalid_again(peer: tuple[FaultyDrive, MachineConfig]) -> None:
    drive, settings = peer
    drive.drive.faults.ignore_offset = True
    with pytest.raises(DeviceError, match="0x60B0 holds 0"):
        commission_axis(settings, "X")
    assert drive.feedforward_cob_id() == NOT_VALID


def test_ctrl_c_makes_rpdo_invalid_again(peer: tuple[FaultyDrive, MachineConfig]) -> None:
    drive, settings = peer

    def raise_interrupt(step: str) -> None:
        if step == "sign test":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        commission_axis(settings, "X", raise_interrupt)
    assert drive.feedforward_cob_id() == NOT_VALID
    assert drive.active_offsets() == (0, 0)
