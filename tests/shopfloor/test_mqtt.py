"""A broker session: births, changes, silence, commands, a primary host; the broker is a list."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import aiomqtt
import pytest

from fdhil.config.credentials import create_tls_context, read_password
from fdhil.config.publish_sections import MqttBroker
from fdhil.errors import ConnectError
from fdhil.shopfloor import mqtt_publisher
from fdhil.shopfloor.mqtt_publisher import HostGone, MqttSession
from tests.daemon.simulated_machine import config_of
from tests.shopfloor.mosquitto import certify
from tests.shopfloor.polled_daemon import NOW, Daemon, identified, load_changed
from tests.shopfloor.sparkplug_host import Host, command
from tests.shopfloor.status_documents import publishing, trouble

NCMD = "spBv1.0/fdhil/NCMD/mill"


@pytest.fixture(autouse=True)
def _skip_rebirth_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_publisher, "REBIRTH_S", 0.0)


class Broker:
    def __init__(self) -> None:
        self.host = Host()
        self.subscribed: list[str] = []
        self._commands: asyncio.Queue[Any] = asyncio.Queue()
        self._heard = asyncio.Event()

    async def subscribe(self, topic: str, qos: int) -> None:
        assert qos == 1
        self.subscribed.append(topic)

    async def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool, timeout: float | None) -> None:
        assert not retain
        self.host.take(topic, payload)
        self._heard.set()

    @property
    async def messages(self) -> AsyncIterator[Any]:
        while True:
            yield await self._commands.get()

    def send(self, topic: str, payload: bytes) -> None:
        self._commands.put_nowait(SimpleNamespace(topic=aiomqtt.Topic(topic), payload=payload))

    async def until(self, so: Callable[[Host], bool]) -> None:
        async with asyncio.timeout(60):
            while not so(self.host):
                await self._heard.wait()
                self._heard.clear()


def session_of(**settings: Any) -> MqttSession:
    return MqttSession(MqttBroker(**settings), "mill")


@asynccontextmanager
async def connected(session: MqttSession) -> AsyncIterator[Broker]:
    broker = Broker()
    task = asyncio.create_task(session.run(cast(aiomqtt.Client, broker)))
    try:
        yield broker
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def is_born(host: Host) -> bool:
    return host.verbs[-1:] == ["DBIRTH/Y"]


async def test_session_publishes_births_changes_silence_recovery_and_death(tmp_path: Path) -> None:
    daemon, session = Daemon(tmp_path), session_of()
    session.node.begin_connection(NOW)
    async with connected(session) as broker:
        await asyncio.sleep(0)
        assert broker.host.verbs == []  # the daemon was not asked yet
        session.take_update(daemon.news())
        await broker.until(is_born)
        assert broker.host.verbs == ["NBIRTH", "DBIRTH/X", "DBIRTH/Y"]
        assert (broker.host.values[""]["up"], broker.host.values["X"]["K"]) == (True, None)
        session.take_update(daemon.news(*identified(), load_changed()))
        await broker.until(lambda host: host.values["X"]["K"] == 0.8)
        x = broker.host.values["X"]
        assert x["K_low"] < 0.8 < x["K_high"]
        assert x["windows_accepted"] == 1
        assert broker.host.units["X"]["K"] == "N.m/A"
        await broker.until(lambda host: host.values["X"]["notice"] == "LoadChanged: Jt rose")
        session.take_update(daemon.silence())
        await broker.until(lambda host: set(host.values) == {""})
        assert broker.host.verbs[-2:] == ["DDEATH/X", "DDEATH/Y"]
        assert broker.host.values[""]["up"] is False
        assert broker.host.values[""]["state"] is None
        session.take_update(daemon.news())
        await broker.until(is_born)
        assert broker.host.values["X"]["K"] == 0.8
    assert broker.host.verbs[-1] == "NDEATH"
    assert not broker.host.alive


async def test_every_notice_is_published_even_when_repeated(tmp_path: Path) -> None:
    daemon, session = Daemon(tmp_path), session_of()
    session.node.begin_connection(NOW)
    async with connected(session) as broker:
        session.take_update(daemon.news())
        await broker.until(is_born)
        before = broker.host.verbs.count("DDATA/X")
        session.take_update(daemon.news(load_changed("one"), load_changed("two")))
        await broker.until(lambda host: host.values["X"]["notice"] == "LoadChanged: two")
        session.take_update(daemon.news(load_changed("two")))
        await broker.until(lambda host: host.verbs.count("DDATA/X") >= before + 3)


async def test_slow_broker_receives_the_newest_state_and_a_bounded_number_of_notices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mqtt_publisher, "MOST_EVENTS", 3)
    daemon, session = Daemon(tmp_path), session_of()
    session.node.begin_connection(NOW)
    async with connected(session) as broker:
        session.take_update(daemon.news())
        await broker.until(is_born)
        before = len(broker.host.verbs)
        for _ in range(100):  # while the broker takes nothing
            session.take_update(daemon.news())
        for number in range(10):
            session.take_update(daemon.news(load_changed(f"{number}")))
        newest = daemon.news(*identified())
        session.take_update(newest)
        await broker.until(lambda host: host.values["X"]["notice"] == "LoadChanged: 9")
        result = broker.host.verbs[before:]
        assert (result.count("DDATA/X"), result.count("NDATA")) == (3, 1)
        assert (broker.host.values["X"]["K"], broker.host.values["X"]["windows_accepted"]) == (0.8, 1)
    output = capsys.readouterr().err
    assert output.count("the oldest of 3 queued notices are dropped for newer ones") == 1
    assert output.count("7 notices were not sent one by one: the broker was too slow") == 1


async def test_problem_is_an_alarm_until_it_ends(tmp_path: Path) -> None:
    daemon, session = Daemon(tmp_path), session_of()
    session.node.begin_connection(NOW)
    async with connected(session) as broker:
        daemon.changes = {"troubles": [trouble("NoSamples", "X", text="sends no samples")]}
        session.take_update(daemon.news())
        await broker.until(is_born)
        assert broker.host.values["X"]["alarms"] == "NoSamples: sends no samples"
        daemon.changes = {}
        session.take_update(daemon.news())
        await broker.until(lambda host: host.values["X"]["alarms"] == "")


async def test_births_are_sent_again_on_request_and_other_commands_ignored(tmp_path: Path) -> None:
    daemon, session = Daemon(tmp_path), session_of()
    session.node.begin_connection(NOW)
    async with connected(session) as broker:
        session.take_update(daemon.news())
        await broker.until(is_born)
        for name in ("arm", "Node Control/Reboot", "Node Control/Next Server"):
            broker.send(NCMD, command(name, True))
        broker.send(NCMD, b"\xff\x00 no protobuf")
        broker.send(NCMD, command("Node Control/Rebirth", True))
        await broker.until(lambda host: host.verbs.count("DBIRTH/Y") == 2)
        assert broker.host.verbs == ["NBIRTH", "DBIRTH/X", "DBIRTH/Y"] * 2
        assert broker.subscribed == [NCMD]  # no device takes commands


async def test_silent_daemon_at_start_has_no_axes(tmp_path: Path) -> None:
    daemon, session = Daemon(tmp_path), session_of()
    session.node.begin_connection(NOW)
    async with connected(session) as broker:
        session.take_update(daemon.silence())
        await broker.until(lambda host: host.verbs == ["NBIRTH"])
        assert broker.host.values[""]["up"] is False
        session.take_update(daemon.news())
        await broker.until(is_born)


def host_says(online: bool, stamp_ms: int) -> bytes:
    return json.dumps({"online": online, "timestamp": stamp_ms}).encode()


async def test_session_waits_for_the_primary_host_and_ends_with_it(tmp_path: Path) -> None:
    daemon, session = Daemon(tmp_path), session_of(primary_host="scada")
    session.node.begin_connection(NOW)
    broker, state = Broker(), "spBv1.0/STATE/scada"
    serving = asyncio.create_task(session.run(cast(aiomqtt.Client, broker)))
    session.take_update(daemon.news())
    broker.send(state, host_says(False, NOW))
    broker.send("spBv1.0/STATE/another", host_says(True, NOW + 1))
    for _ in range(20):
        await asyncio.sleep(0)
    assert broker.host.verbs == []
    assert broker.subscribed == [NCMD, state]
    broker.send(state, host_says(True, NOW + 2))
    await broker.until(is_born)
    broker.send(state, host_says(False, NOW + 1))  # the death of a connection before
    broker.send(NCMD, command("Node Control/Rebirth", True))
    await broker.until(lambda host: host.verbs.count("DBIRTH/Y") == 2)
    broker.send(state, host_says(False, NOW + 3))
    with pytest.raises(ExceptionGroup) as gone:
        await serving
    assert gone.group_contains(HostGone)
    assert broker.host.verbs[-1] == "NDEATH"


async def test_host_state_in_the_future_does_not_silence_the_publisher(tmp_path: Path) -> None:
    daemon, session = Daemon(tmp_path), session_of(primary_host="scada")
    session.node.begin_connection(NOW)
    broker, state = Broker(), "spBv1.0/STATE/scada"
    serving = asyncio.create_task(session.run(cast(aiomqtt.Client, broker)))
    session.take_update(daemon.news())
    broker.send(state, host_says(False, 4_000_000_000_000))
    broker.send(state, host_says(True, NOW))
    await broker.until(is_born)
    broker.send(state, host_says(True, 10**400))
    broker.send(state, host_says(False, NOW + 1))
    with pytest.raises(ExceptionGroup) as gone:
        await serving
    assert gone.group_contains(HostGone)


async def test_absent_broker_is_logged_once_and_retried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mqtt_publisher, "FIRST_RETRY_S", 0.001)
    tried = asyncio.Queue[None]()
    monkeypatch.setattr(mqtt_publisher, "_make_client", _counted(tried, mqtt_publisher._make_client))
    async with publishing("mqtt", config_of(tmp_path, publish={"mqtt": {"port": 1}})):
        for _ in range(4):
            await tried.get()
    output = capsys.readouterr().err
    assert output.count("Connection refused; check host and port, and whether it runs; retrying") == 1


async def test_publisher_stops_when_polling_the_daemon_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def broken(config: Any, period_s: float) -> AsyncIterator[Any]:
        for fault in (RuntimeError("a fault of fdhil itself"),):
            raise fault
        yield

    monkeypatch.setattr(mqtt_publisher, "poll_status", broken)
    with pytest.raises(RuntimeError, match="a fault of fdhil itself"):
        await mqtt_publisher.publish(config_of(tmp_path, publish={"mqtt": {"port": 1}}))


def _counted(tried: asyncio.Queue[None], client: Callable[..., Any]) -> Callable[..., Any]:
    def counted(*arguments: Any) -> Any:
        tried.put_nowait(None)
        return client(*arguments)

    return counted


def test_unusable_credentials_are_named(tmp_path: Path) -> None:
    missing = tmp_path / "missing"
    with pytest.raises(ConnectError, match=r"password_file .*missing cannot be used: No such file"):
        read_password(MqttBroker(user="fdhil", password_file=missing), *mqtt_publisher.BROKER)
    with pytest.raises(ConnectError, match=r"tls_ca_file .*missing cannot be used: No such file"):
        create_tls_context(MqttBroker(tls_ca_file=missing), *mqtt_publisher.BROKER)
    certify(tmp_path)
    ca, empty = tmp_path / "ca.pem", tmp_path / "empty"
    empty.touch()
    with pytest.raises(ConnectError, match=r"tls_certificate_file .*empty cannot be used"):
        create_tls_context(
            MqttBroker(tls_ca_file=ca, tls_certificate_file=empty, tls_key_file=empty), *mqtt_publisher.BROKER
        )


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"host": "broker", "user": "u", "password_file": "p"}, "it needs a tls_ca_file"),
        ({"user": "u"}, "user and password_file must be given together"),
        ({"tls_certificate_file": "c", "tls_key_file": "k"}, "it needs a tls_ca_file"),
        ({"tls_ca_file": "ca", "tls_key_file": "k"}, "tls_key_file must be given together"),
        ({"group": "a/b"}, "pattern"),
        ({"node": "mill+"}, "pattern"),
    ],
)
def test_invalid_settings_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MqttBroker(**settings)


def test_node_name_is_the_machine_name_without_topic_characters() -> None:
    assert MqttBroker().get_node_name("mill #3 / hall +1") == "mill _3 _ hall _1"
    assert MqttBroker(node="m3").get_node_name("mill") == "m3"
