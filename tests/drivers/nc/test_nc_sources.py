"""Every listed NC source meets the contract, against a real peer on a socket."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.nc import NcSource, load_nc_source
from fdhil.drivers.nc.nc_listener import NcListener
from fdhil.errors import ConnectError, DeviceError
from fdhil.records import MoveKind, NcState, Notice
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.nc.peers import PEERS, Peer

SAID = {
    "line": 12, "feed_override": 0.75, "rapid_override": 0.5, "feed_hold": False, "tool": 3, "program": "part.ngc",
    "feed_mm_min": 500.0, "programmed_feed_mm_min": 1000.0,
}  # fmt: skip

pytestmark = pytest.mark.parametrize("name", tables.NC_SOURCES)


def build_config(name: str, peer: Peer, **more: Any) -> MachineConfig:
    return build_machine_config(g0={"source": name}, nc_source={**more, name: dict(peer.settings)})


async def read_until(source: NcSource, holds: Callable[[NcState], bool]) -> NcState:
    """Read until a state satisfies the condition."""
    async with asyncio.timeout(300):
        while True:
            for state in await source.read_states():
                if holds(state):
                    return state


@pytest.mark.usefixtures("long_computation")
async def test_source_reports_what_its_interface_shows(name: str) -> None:
    async with PEERS[name]() as peer:
        source = load_nc_source(name)(build_config(name, peer))
        async with source:
            for kind in sorted(peer.knows, key=lambda kind: kind.value):
                reported = {key: value for key, value in SAID.items() if key in peer.tells}
                await peer.set_state(kind, **reported)
                state = await read_until(source, lambda state, kind=kind: state.motion is kind)  # type: ignore[misc]
                state = await read_until(source, lambda state, kind=kind: state.motion is kind)  # type: ignore[misc]
                assert {key: getattr(state, key) for key in reported} == pytest.approx(reported)
                assert state.error_ns > 0


async def test_time_stamps_increase_on_this_computers_clock(name: str) -> None:
    async with PEERS[name]() as peer:
        await peer.set_state(MoveKind.REST)
        async with load_nc_source(name)(build_config(name, peer)) as source:
            stamps = [state.stamp_ns for _ in range(5) for state in await source.read_states()]
    assert stamps == sorted(stamps)


@pytest.mark.usefixtures("real_time")
async def test_unreachable_nc_is_a_connect_error_with_its_address(name: str) -> None:
    async with PEERS[name]() as peer:
        source = load_nc_source(name)(build_config(name, peer))
    port = peer.settings.get("port") or peer.settings["url"].rpartition(":")[2]
    with pytest.raises(ConnectError, match=str(port)):
        await source.__aenter__()


async def test_invalid_answer_is_a_device_error_and_never_a_rapid(name: str) -> None:
    async with PEERS[name]() as peer:
        await peer.send_invalid_data()
        source = load_nc_source(name)(build_config(name, peer))
        with pytest.raises(DeviceError):
            await _assert_only_unknown_states(source)


async def _assert_only_unknown_states(source: NcSource) -> None:
    async with source, asyncio.timeout(300):
        while True:
            assert all(state.motion is MoveKind.UNKNOWN for state in await source.read_states())


async def test_lost_nc_is_reported_once_and_unknown_until_it_returns(name: str) -> None:
    reported: asyncio.Queue[NcState | Notice] = asyncio.Queue()
    async with PEERS[name]() as peer:
        await peer.set_state(MoveKind.RAPID if MoveKind.RAPID in peer.knows else MoveKind.REST)
        listening = asyncio.create_task(NcListener(build_config(name, peer, silence_s=0.5)).run(reported.put_nowait))
        assert isinstance(await reported.get(), NcState)
    async with asyncio.timeout(300):
        while not isinstance(lost := await reported.get(), NcState) or lost.motion is not MoveKind.UNKNOWN:
            pass
        notice = await reported.get()
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    assert isinstance(notice, Notice)
    assert (notice.code, notice.severity) == ("NcSilent", "MAJOR")
