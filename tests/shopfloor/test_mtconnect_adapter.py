"""The MTConnect adapter, read by a test agent over TCP; its Devices.xml against the standard."""

from __future__ import annotations

import asyncio
import itertools
import re
import socket
import xml.etree.ElementTree as ElementTree
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.config.publish_sections import MtConnectAdapter
from fdhil.errors import ConnectError
from fdhil.shopfloor import mtconnect_adapter
from fdhil.shopfloor.mtconnect_adapter import MAX_AGENTS, ShdrAdapter
from fdhil.shopfloor.published_items import MACHINE, PublishedEvent
from fdhil.shopfloor.shdr import (
    UNITS,
    build_adapter_state,
    encode_devices_xml,
    format_notice,
    format_value,
    list_changed_lines,
    make_default_uuid,
)
from fdhil.shopfloor.status_poller import StatusUpdate
from tests.daemon.machine_rig import BENCH, fdhil
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.daemon.test_daemon_service import serving
from tests.shopfloor.polled_daemon import NOW, Daemon, identified, load_changed
from tests.shopfloor.shdr_agent import SPACE, Agent, connected, data_items
from tests.shopfloor.status_documents import trouble

# units of MTConnect 2.0 that are in use here; any other has a prefix
STANDARD_UNITS = {"CELSIUS", "HERTZ", "MILLIMETER", "MILLIMETER/SECOND", "NEWTON_METER", "OHM", "PERCENT", "SECOND"}
STANDARD_TYPES = {
    "AVAILABILITY", "LINE_NUMBER", "MESSAGE", "PATH_FEEDRATE", "PATH_FEEDRATE_OVERRIDE", "PROGRAM", "RESISTANCE",
    "SYSTEM", "TEMPERATURE",
}  # fmt: skip
EXTENDED = re.compile(r"[a-ln-z][a-z]*:[A-Z_0-9]+")


def xml_of(news: StatusUpdate) -> str:
    return encode_devices_xml("bench", "", news.values, NOW)


def test_devices_xml_follows_the_standard(tmp_path: Path) -> None:
    text = xml_of(Daemon(tmp_path).news())
    root = ElementTree.fromstring(text)
    device = root.find(f"{SPACE}Devices/{SPACE}Device")
    assert device is not None
    assert device.attrib == {"id": "fdhil", "name": "bench", "uuid": make_default_uuid("bench")}
    assert [child.tag.removeprefix(SPACE) for child in device] == ["Description", "DataItems", "Components"]
    assert [axis.attrib["name"] for axis in device.iter(f"{SPACE}Linear")] == ["X", "Y"]
    ids = [each.attrib["id"] for each in root.iter() if "id" in each.attrib]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", each) for each in ids)
    for item in data_items(text).values():
        assert item["type"] in STANDARD_TYPES or EXTENDED.fullmatch(item["type"]), item
        assert ("units" in item) == (item["category"] == "SAMPLE"), item
        assert item.get("units", "OHM") in STANDARD_UNITS or EXTENDED.fullmatch(item["units"]), item


def test_every_published_unit_has_an_mtconnect_name(tmp_path: Path) -> None:
    units = {value.item.unit for value in Daemon(tmp_path).news().values if value.item.kind == "measure"}
    assert units - set(UNITS) == {"", "1"}  # what is counted, and shares


def test_command_writes_devices_xml(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine, file = tmp_path / "machine.toml", tmp_path / "Devices.xml"
    machine.write_text(BENCH + '[publish.mtconnect]\ndevice_uuid = "works.mill-3"\n')
    code, out, err = fdhil("publish", "mtconnect", machine, "--devices", file, capsys=capsys)
    assert (code, out) == (0, ""), err
    text = file.read_text()
    assert 'uuid="works.mill-3"' in text
    assert set(data_items(text)) == set(data_items(xml_of(Daemon(tmp_path).news())))
    code, _, err = fdhil("publish", "prometheus", machine, "--devices", file, capsys=capsys)
    assert (code, "--devices applies only to mtconnect" in err) == (2, True)


def test_new_agent_receives_every_data_item(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    news = daemon.news()
    agent = Agent(xml_of(news))
    for line in list_changed_lines(None, build_adapter_state(news)):
        agent.take(line)
    conditions = {"machine_condition", "X_condition", "Y_condition"}
    assert set(agent.values) | conditions == set(agent.items) - {"machine_notice", "X_notice", "Y_notice"}
    assert agent.conditions == {key: {} for key in conditions}
    assert agent.values["avail"] == "AVAILABLE"
    assert agent.values["X_K"] == "UNAVAILABLE"


def test_only_changes_are_sent_in_standard_units(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    before = daemon.news()
    agent = Agent(xml_of(before))
    after = daemon.news(*identified())
    output = list_changed_lines(build_adapter_state(before), build_adapter_state(after))
    for line in output:
        agent.take(line)
    assert float(agent.values["X_K"]) == 0.8
    assert agent.items["X_K"]["units"] == "x:NEWTON_METER_PER_AMPERE"
    assert (agent.items["X_K_low"]["type"], agent.items["X_K_low"]["subType"]) == (
        "x:TORQUE_CONSTANT",
        "x:INTERVAL_LOW",
    )
    assert not any(key.startswith("Y_") for key in agent.values)
    daemon.changes = {"nc": {"feed_mm_min": 1200.0, "feed_override": 0.5, "line": 7, "heard_s_ago": 0.1}}
    for line in list_changed_lines(build_adapter_state(after), build_adapter_state(daemon.news())):
        agent.take(line)
    result = {key: agent.values[f"machine_nc_{key}"] for key in ("feed", "feed_override", "line")}
    assert result == {"feed": "20", "feed_override": "50", "line": "7"}
    assert agent.items["machine_nc_feed"]["units"] == "MILLIMETER/SECOND"


def test_alarms_are_conditions_with_their_codes(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    agent, last = Agent(xml_of(daemon.news())), None
    severities, seen = {"NoSamples": "MAJOR", "MovesNotUsed": "minor"}, []
    for codes in ([], ["NoSamples", "MovesNotUsed"], ["MovesNotUsed"], [], None, []):
        troubles = [trouble(code, "X", severities[code], f"{code} | again\nand again") for code in codes or []]
        daemon.changes = {"troubles": troubles}
        now = build_adapter_state(daemon.silence() if codes is None else daemon.news())
        for line in list_changed_lines(last, now):
            agent.take(line)
        last = now
        seen.append(agent.conditions["X_condition"])
    text = " / again and again"
    minor = {"MovesNotUsed": ("WARNING", f"MovesNotUsed{text}")}
    assert seen == [{}, {"NoSamples": ("FAULT", f"NoSamples{text}"), **minor}, minor, {}, None, {}]


def test_silent_daemon_makes_everything_unavailable(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    before = daemon.news(*identified())
    agent = Agent(xml_of(before))
    for line in [
        *list_changed_lines(None, build_adapter_state(before)),
        *list_changed_lines(build_adapter_state(before), build_adapter_state(daemon.silence())),
    ]:
        agent.take(line)
    assert set(agent.values.values()) == {"UNAVAILABLE"}
    assert set(agent.conditions.values()) == {None}


def test_notice_is_a_one_line_message(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    agent = Agent(xml_of(daemon.news()))
    for event in daemon.news(load_changed("a|b\r\nc")).events:
        agent.take(format_notice(event))
    assert agent.messages == [("X_notice", "LoadChanged", "a/b c")]


@given(st.text(st.characters()))
def test_any_text_stays_in_its_field(text: str) -> None:
    line = format_notice(PublishedEvent("LoadChanged", "minor", text, "X", NOW, 0.0))
    program = format_value(next(item for item in MACHINE if item.name == "nc_program"), text)
    for output, bars in ((line, 3), (program, 0)):
        assert output.count("|") == bars
        assert output.isprintable()
        output.encode()


@asynccontextmanager
async def adapting() -> AsyncIterator[tuple[ShdrAdapter, int]]:
    adapter = ShdrAdapter()
    listening = socket.create_server(("127.0.0.1", 0))
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)  # else a deaf agent's queue is megabytes
    server = await asyncio.start_server(adapter.serve_agent, sock=listening, limit=mtconnect_adapter.MAX_LINE)
    async with server:
        yield adapter, server.sockets[0].getsockname()[1]
        adapter.close()


async def test_agents_are_answered_and_receive_values_and_changes(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    text = xml_of(daemon.news())
    async with adapting() as (adapter, port), connected(text, port) as early:
        early.send(b"* PING\n")
        await early.until(lambda agent: agent.pongs == ["10000"])
        adapter.publish_update(daemon.news(*identified(), load_changed()))
        await early.until(lambda agent: agent.messages)
        async with connected(text, port) as late:
            await late.until(lambda agent: agent.messages)
            for each in (early, late):
                assert each.agent.values["avail"] == "AVAILABLE"
                assert float(each.agent.values["X_K"]) == 0.8
            adapter.publish_update(daemon.silence())
            for each in (early, late):
                await each.until(lambda agent: agent.values["X_K"] == "UNAVAILABLE")


async def test_agent_input_has_no_effect(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    text = xml_of(daemon.news())
    async with adapting() as (adapter, port), connected(text, port) as agent:
        agent.send(b"\xff\xfe\n{}\narm\n* PINGS\nGET / HTTP/1.1\n\n* PING\n")
        await agent.until(lambda agent: agent.pongs)
        assert agent.agent.lines == 2  # the greeting and the answer
        agent.send(b"x" * 100_000)
        await agent.until_let_go()
        adapter.publish_update(daemon.news())


async def test_agent_beyond_the_limit_is_refused(tmp_path: Path) -> None:
    text = xml_of(Daemon(tmp_path).news())
    async with adapting() as (_, port), AsyncExitStack() as open_ones:
        for _ in range(MAX_AGENTS):
            agent = await open_ones.enter_async_context(connected(text, port))
            agent.send(b"* PING\n")
            await agent.until(lambda agent: agent.pongs)
        async with connected(text, port) as another:
            await another.until_let_go()
        async with connected(text, port, "127.0.0.2") as elsewhere:  # one address has no claim to all places
            elsewhere.send(b"* PING\n")
            await elsewhere.until(lambda agent: agent.pongs)


async def test_client_that_never_pings_makes_room_for_an_agent(tmp_path: Path) -> None:
    text = xml_of(Daemon(tmp_path).news())
    async with adapting() as (_, port), AsyncExitStack() as open_ones:
        strangers = [await open_ones.enter_async_context(connected(text, port)) for _ in range(MAX_AGENTS)]
        for stranger in strangers:
            await stranger.until(lambda agent: agent.lines)
        async with connected(text, port) as agent:
            agent.send(b"* PING\n")
            await agent.until(lambda agent: agent.pongs)
            await strangers[0].until_let_go()


async def test_agent_that_stops_pinging_is_disconnected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mtconnect_adapter, "HEARTBEAT_S", 0.02)
    async with adapting() as (_, port), connected(xml_of(Daemon(tmp_path).news()), port) as agent:
        agent.send(b"* PING\n")
        await agent.until_let_go()


async def test_agent_that_does_not_read_is_disconnected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mtconnect_adapter, "MAX_UNREAD", 1000)
    daemon = Daemon(tmp_path)
    async with adapting() as (adapter, port), connected(xml_of(daemon.news()), port) as deaf:
        await deaf.until(lambda agent: agent.lines)
        deaf.pause()
        pictures = (daemon.news(*identified()), daemon.silence())
        async with asyncio.timeout(60):
            for news in itertools.cycle(pictures):
                adapter.publish_update(news)
                await asyncio.sleep(0)
                if adapter.agent_count == 0:
                    break


async def test_adapter_publishes_a_daemon_until_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)
    config = config_of(tmp_path, publish={"mtconnect": {"port": 0, "period_s": 0.1}})
    output = asyncio.Queue[str]()
    monkeypatch.setattr(mtconnect_adapter, "report_ready", output.put_nowait)
    publishing = asyncio.create_task(mtconnect_adapter.publish(config))
    port = int((await output.get()).rpartition(":")[2])
    async with connected(xml_of(Daemon(tmp_path, ("X",)).news()), port) as agent:
        await agent.until(lambda agent: agent.values.get("avail") == "UNAVAILABLE")
        async with serving(config, SimulatedMachine()):
            await agent.until(lambda agent: agent.values["avail"] == "AVAILABLE")
            await agent.until(lambda agent: agent.values["machine_config_digest"] == config.digest)
            assert agent.agent.values["machine_state"] == "OFF(SHADOW)"
        await agent.until(lambda agent: agent.values["avail"] == "UNAVAILABLE")
        publishing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await publishing
        await agent.until_let_go()


async def test_occupied_port_is_named(tmp_path: Path) -> None:
    async with adapting() as (_, port):
        config = config_of(tmp_path, publish={"mtconnect": {"port": port}})
        with pytest.raises(ConnectError, match=f"cannot listen at 127.0.0.1:{port}: "):
            await mtconnect_adapter.publish(config)


def test_remote_access_needs_an_explicit_setting() -> None:
    with pytest.raises(ValueError, match="unprotected = true"):
        MtConnectAdapter(host="0.0.0.0")
    assert MtConnectAdapter(host="0.0.0.0", unprotected=True).port == 7878
