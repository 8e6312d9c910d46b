"""Every listed NC source meets the contract, against a real peer on a socket."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.nc import NcSource, load_nc_source
from fdhil.drivers.nc.listener import NcListener
from fdhil.errors import ConnectError, DeviceError
from fdhil.records import MoveKind, NcState, Notice
from tests.drivers.nc.peers import PEERS, Peer
from tests.drivers.wire import machine

SAID = {
    "line": 12, "feed_override": 0.75, "rapid_override": 0.5, "feed_hold": False, "tool": 3, "program": "part.ngc",
    "feed_mm_min": 500.0, "programmed_feed_mm_min": 1000.0,
}  # fmt: skip

pytestmark = pytest.mark.parametrize("name", tables.NC_SOURCES)


def config_of(name: str, peer: Peer, **more: Any) -> MachineConfig:
    return machine(g0={"source": name}, nc_source={**more, name: dict(peer.settings)})


async def until(source: NcSource, holds: Callable[[NcState], bool]) -> NcState:
    """Read until a state satisfies the condition."""
    async with asyncio.timeout(300):
        while True:
            for state in await source.read():
                if holds(state):
                    return state


@pytest.mark.usefixtures("long_computation")
async def test_it_tells_what_the_nc_does_as_far_as_it_can(name: str) -> None:
    async with PEERS[name]() as peer:
        source = load_nc_source(name)(config_of(name, peer))
        async with source:
            for kind in sorted(peer.knows, key=lambda kind: kind.value):
                told = {key: value for key, value in SAID.items() if key in peer.tells}
                await peer.say(kind, **told)
                state = await until(source, lambda state, kind=kind: state.motion is kind)  # type: ignore[misc]
                state = await until(source, lambda state, kind=kind: state.motion is kind)  # type: ignore[misc]
                assert {key: getattr(state, key) for key in told} == pytest.approx(told)
                assert state.error_ns > 0


async def test_stamps_rise_and_are_of_this_computers_clock(name: str) -> None:
    async with PEERS[name]() as peer:
        await peer.say(MoveKind.REST)
        async with load_nc_source(name)(config_of(name, peer)) as source:
            stamps = [state.stamp_ns for _ in range(5) for state in await source.read()]
    assert stamps == sorted(stamps)


@pytest.mark.usefixtures("real_time")
async def test_nobody_there_is_a_connect_error_that_names_the_place(name: str) -> None:
    async with PEERS[name]() as peer:
        source = load_nc_source(name)(config_of(name, peer))
    port = peer.settings.get("port") or peer.settings["url"].rpartition(":")[2]
    with pytest.raises(ConnectError, match=str(port)):
        await source.__aenter__()


async def test_nonsense_is_a_device_error_and_never_a_rapid(name: str) -> None:
    async with PEERS[name]() as peer:
        await peer.talk_nonsense()
        source = load_nc_source(name)(config_of(name, peer))
        with pytest.raises(DeviceError):
            await _hear_only_unknown(source)


async def _hear_only_unknown(source: NcSource) -> None:
    async with source, asyncio.timeout(300):
        while True:
            assert all(state.motion is MoveKind.UNKNOWN for state in await source.read())


async def test_an_nc_that_goes_and_comes_is_told_once_and_is_unknown_meanwhile(name: str) -> None:
    told: asyncio.Queue[NcState | Notice] = asyncio.Queue()
    async with PEERS[name]() as peer:
        await peer.say(MoveKind.RAPID if MoveKind.RAPID in peer.knows else MoveKind.REST)
        listening = asyncio.create_task(NcListener(config_of(name, peer, silence_s=0.5)).run(told.put_nowait))
        assert isinstance(await told.get(), NcState)
    async with asyncio.timeout(300):
        while not isinstance(lost := await told.get(), NcState) or lost.motion is not MoveKind.UNKNOWN:
            pass
        notice = await told.get()
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    assert isinstance(notice, Notice)
    assert (notice.code, notice.severity) == ("NcSilent", "MAJOR")
