"""The OPC UA server, read by asyncua's client: values with quality, unit and time, alarms, and rights."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from asyncua import Client, Node, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.ua.uaerrors import (
    BadIdentityTokenRejected,
    BadUserAccessDenied,
    UaError,
)

from fdhil.config import MachineConfig
from fdhil.config.user_file import hash_password, write_users
from fdhil.errors import ConnectError
from fdhil.shopfloor.opcua_access import MOST_CONNECTIONS, OpcUaUserManager
from fdhil.shopfloor.opcua_address_space import OWN
from fdhil.shopfloor.opcua_server import OpcUaPublisher, publish, serve_opcua
from fdhil.shopfloor.opcua_subscriptions import must_report
from fdhil.shopfloor.published_items import AXIS, BUS, MACHINE
from fdhil.shopfloor.status_poller import StatusPoller
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.daemon.test_daemon_service import serving as daemon_serving
from tests.drivers.nc.test_opcua import write_certificates
from tests.shopfloor.status_documents import NOW_MS, VALUES, notice, publishing, said, status, trouble

pytestmark = pytest.mark.asyncio(loop_scope="module")
PATIENCE_S = 120.0
PASSWORD = "canary-of-the-shop-floor"
MACHINE_TOOL = "http://opcfoundation.org/UA/MachineTool/"


class Stage:
    def __init__(self, config: MachineConfig, served: OpcUaPublisher) -> None:
        self.served, self.listener = served, StatusPoller(config)
        self.url = f"opc.tcp://127.0.0.1:{served.port}"

    async def say(self, answer: dict[str, Any] | None, now_ms: int = NOW_MS) -> None:
        await self.served.publish_status(
            self.listener.build_update(answer, now_ms, "" if answer else "the daemon is not running")
        )


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def server_rig(tmp_path_factory: pytest.TempPathFactory, long_computation: None) -> AsyncIterator[Stage]:
    opcua = {"port": 0, "manufacturer": "Example Maker", "serial_number": "4711"}
    config = config_of(tmp_path_factory.mktemp("opcua"), "XY", publish={"opcua": opcua})
    async with serve_opcua(config) as served:
        yield Stage(config, served)


@pytest_asyncio.fixture(loop_scope="module")
async def client(server_rig: Stage) -> AsyncIterator[Client]:
    await server_rig.say(status())
    async with Client(server_rig.url, PATIENCE_S) as connected:
        yield connected


async def own(client: Client, name: str) -> Node:
    return client.get_node(f"ns={await client.get_namespace_index(OWN)};s={name}")


async def wait_for_event(node: Node) -> Any:
    return await node.read_data_value(raise_on_bad_status=False)


class ReceivedEvents:
    def __init__(self) -> None:
        self.events: list[Any] = []
        self.values: list[Any] = []

    def event_notification(self, event: Any) -> None:
        self.events.append(event)

    def datachange_notification(self, node: Node, value: Any, data: Any) -> None:
        self.values.append(value)


async def until(done: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while True:
            if done():
                return
            await asyncio.sleep(0.01)


@pytest.mark.usefixtures("long_computation")
async def test_machine_tool_node_is_in_its_standard_place(client: Client) -> None:
    machinery = await client.get_namespace_index("http://opcfoundation.org/UA/Machinery/")
    tool, di = (
        await client.get_namespace_index(MACHINE_TOOL),
        await client.get_namespace_index("http://opcfoundation.org/UA/DI/"),
    )
    machine = (await (await client.nodes.objects.get_child(f"{machinery}:Machines")).get_children())[0]
    assert (await machine.read_browse_name()).Name == "bench"
    kind: Any = await machine.read_type_definition()
    assert kind.Identifier == 13  # MachineToolType
    place = await machine.get_child(f"{di}:Identification")
    assert (await (await place.get_child(f"{di}:Manufacturer")).read_value()).Text == "Example Maker"
    assert await (await place.get_child(f"{di}:SerialNumber")).read_value() == "4711"
    program = await machine.get_child([f"{tool}:Production", f"{tool}:ActiveProgram"])
    assert await (await program.get_child(f"{tool}:Name")).read_value() == "part.ngc"


@pytest.mark.usefixtures("long_computation")
async def test_program_state_follows_the_nc_and_no_mode_is_invented(server_rig: Stage, client: Client) -> None:
    tool, machine = await client.get_namespace_index(MACHINE_TOOL), await own(client, "machine")
    state = await machine.get_child([f"{tool}:Production", f"{tool}:ActiveProgram", f"{tool}:State", "0:CurrentState"])
    seen = []
    for motion in ("rapid", "hold", "rest"):
        answer = status()
        answer["nc"]["motion"] = motion
        await server_rig.say(answer)
        result = await wait_for_event(state)
        seen.append(result.Value.Value.Text if result.Value.Value else result.StatusCode.name)
    assert seen == ["Running", "Interrupted", "BadNoDataAvailable"]
    mode = await machine.get_child([f"{tool}:Monitoring", f"{tool}:MachineTool", f"{tool}:OperationMode"])
    assert (await wait_for_event(mode)).StatusCode.name == "BadNoDataAvailable"


async def test_parameters_have_intervals_units_and_times(client: Client) -> None:
    for name, value in VALUES.items():
        read = [await (await own(client, f"Y.{name}{end}")).read_value() for end in ("_low", "", "_high")]
        assert read == pytest.approx([0.9 * value, value, 1.1 * value])
    unit = await (await own(client, "Y.Cd.unit")).read_value()
    assert (unit.UnitId, unit.DisplayName.Text) == (20053, "N·m")  # "NU"
    result = await wait_for_event(await own(client, "nc_line"))
    assert result.Value.Value == 17.0
    assert round(result.SourceTimestamp.timestamp() * 1000) == NOW_MS - 250
    described: Any = await (await own(client, "Y.Cd_low")).read_description()
    assert "Coulomb friction" in described.Text


async def test_every_published_item_is_a_node_of_its_type(client: Client) -> None:
    python = {"measure": float, "count": int, "flag": bool, "state": str, "text": str}
    for where, items in (("", MACHINE), ("X.", AXIS), ("can0.", BUS)):
        nodes = [await own(client, where + item.name) for item in items]
        for item, value in zip(items, await client.read_values(nodes), strict=True):
            assert type(value) is python[item.kind], item.name


async def test_unknown_values_have_bad_quality_and_all_do_while_the_daemon_is_silent(
    server_rig: Stage, client: Client
) -> None:
    node, received = await own(client, "X.R"), ReceivedEvents()
    unheard = status()
    unheard["guard"]["heard_s_ago"] = 60.0
    await server_rig.say(unheard)
    offset = await wait_for_event(await own(client, "X.offset"))
    assert offset.StatusCode.name == "BadNoDataAvailable"
    subscription = await client.create_subscription(20, received)
    await subscription.subscribe_data_change(node)
    await until(lambda: received.values == [0.5])
    await server_rig.say(None)
    await until(lambda: received.values == [0.5, None])
    read = await wait_for_event(node)
    assert (read.StatusCode.name, read.Value.Value) == ("BadNoCommunication", None)
    await server_rig.say(status())
    await until(lambda: received.values == [0.5, None, 0.5])
    await subscription.delete()


async def with_offset(stage: Stage, um: float) -> None:
    answer = status()
    answer["guard"]["offset_um"] = {"X": um, "Y": 0.0}
    await stage.say(answer)


async def test_client_with_a_deadband_receives_slow_drift_and_silence(server_rig: Stage, client: Client) -> None:
    received, text = ReceivedEvents(), ReceivedEvents()
    await with_offset(server_rig, 1.0)
    subscription, other = await client.create_subscription(20, received), await client.create_subscription(20, text)
    await subscription.deadband_monitor(await own(client, "X.offset"), ua.Double(0.5))
    await other.deadband_monitor(await own(client, "state"), ua.Double(0.5))  # no number: each change
    await until(lambda: received.values == [1.0])
    for creeping in (1.2, 1.4, 1.6, 1.8, 2.0, 2.2):
        await with_offset(server_rig, creeping)
    await until(lambda: received.values == [1.0, 1.6, 2.2])
    await server_rig.say(None)
    await until(lambda: received.values == [1.0, 1.6, 2.2, None])
    await with_offset(server_rig, 2.2)
    await until(lambda: received.values == [1.0, 1.6, 2.2, None, 2.2])
    await until(lambda: text.values == ["ACTIVE", None, "ACTIVE"])
    await subscription.delete()
    await other.delete()


GOOD, BAD = ua.StatusCode(), ua.StatusCode(ua.UInt32(ua.StatusCodes.BadNoCommunication))
TRIGGER, BAND = ua.DataChangeTrigger, ua.DeadbandType


def at(value: Any, quality: ua.StatusCode | None = GOOD, second: int = 0) -> ua.DataValue:
    return ua.DataValue(ua.Variant(value), StatusCode=quality, SourceTimestamp=ua.DateTime(2026, 1, 1, 0, 0, second))


@pytest.mark.parametrize(
    ("before", "now", "trigger", "band", "expected"),
    [
        (None, at(1.0), TRIGGER.Status, None, True),
        (at(1.0), at(1.0), TRIGGER.StatusValue, None, False),
        (at(1.0), at(1.1), TRIGGER.StatusValue, None, True),
        (at(1.0), at(1.1), TRIGGER.Status, None, False),
        (at(1.0), at(None, BAD), TRIGGER.Status, None, True),
        (at(1.0), at(1.0, BAD), TRIGGER.StatusValue, 9.0, True),
        (at(1.0), ua.DataValue(StatusCode=BAD), TRIGGER.StatusValue, 9.0, True),
        (at(1.0, None), at(1.0), TRIGGER.StatusValue, None, False),
        (at(1.0), at(1.5), TRIGGER.StatusValue, 0.5, False),
        (at(1.0), at(1.6), TRIGGER.StatusValue, 0.5, True),
        (at(1.0), at(0.4), TRIGGER.StatusValue, 0.5, True),
        (at(1.0), at(float("nan")), TRIGGER.StatusValue, 0.5, True),
        (at(1), at(2), TRIGGER.StatusValue, 1.0, False),
        (at(False), at(True), TRIGGER.StatusValue, 5.0, True),
        (at("a"), at("b"), TRIGGER.StatusValue, 5.0, True),
        (at(1.0), at(1.0, second=1), TRIGGER.StatusValue, None, False),
        (at(1.0), at(1.0, second=1), TRIGGER.StatusValueTimestamp, None, True),
        (at(1.0), at(1.1, second=1), TRIGGER.StatusValueTimestamp, 0.5, False),
    ],
)
async def test_client_receives_each_change_against_the_last_reported_value(
    before: ua.DataValue | None, now: ua.DataValue, trigger: ua.DataChangeTrigger, band: float | None, expected: bool
) -> None:
    kind = BAND.None_ if band is None else BAND.Absolute
    assert must_report(before, now, ua.DataChangeFilter(trigger, kind, band or 0.0)) is expected
    if trigger is TRIGGER.StatusValue and band is None:
        assert must_report(before, now) is expected
        assert must_report(before, now, ua.DataChangeFilter(trigger, BAND.Percent, 50.0)) is expected


async def subscribed(client: Client, received: ReceivedEvents, at: str = "messages") -> Any:
    tool = await client.get_namespace_index(MACHINE_TOOL)
    subscription = await client.create_subscription(20, received)
    types = [client.get_node(f"ns={tool};i=39"), client.get_node(f"ns={tool};i=35")]
    node = client.nodes.server if at == "server" else await own(client, at)
    await subscription.subscribe_events(node, types)
    return subscription


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("at", ["messages", "server"])
async def test_alarm_is_a_condition_and_notice_an_event(at: str, server_rig: Stage, client: Client) -> None:
    received = ReceivedEvents()
    subscription = await subscribed(client, received, at)
    await server_rig.say(status(troubles=[trouble("NoSamples", "X", text="the drive sends no samples; check it")]))
    await until(lambda: len(received.events) == 1)
    began = received.events[0]
    assert (began.ErrorCode, began.SourceName, began.Severity) == ("NoSamples", "X", 800)
    assert began.Message.Text == "the drive sends no samples; check it"
    assert getattr(began, "ActiveState/Id") is True
    assert began.Retain is True
    await server_rig.say(status(troubles=[trouble("NoSamples", "X")]))  # still so: told once
    await server_rig.say(
        status(uptime_s=2000.0, notices=[notice("Armed", 1005.0), notice("OverrideChanged", 0.5, "minor")])
    )
    await until(lambda: len(received.events) == 3)
    by_code = {getattr(e, "ErrorCode", None) or e.Identifier: e for e in received.events[1:]}
    assert getattr(by_code["NoSamples"], "ActiveState/Id") is False
    assert by_code["NoSamples"].Retain is False
    assert by_code["OverrideChanged"].Severity == 400
    await subscription.delete()


async def test_late_client_gets_active_alarms_by_condition_refresh(server_rig: Stage, client: Client) -> None:
    await server_rig.say(status(troubles=[trouble("BusSilent")]))
    received = ReceivedEvents()
    subscription = await subscribed(client, received, "server")
    refresh = client.get_node(ua.ObjectIds.ConditionType_ConditionRefresh)
    kind = client.get_node(ua.ObjectIds.ConditionType)
    await kind.call_method(refresh.nodeid, ua.Variant(subscription.subscription_id, ua.VariantType.UInt32))
    await until(lambda: any(getattr(event, "ErrorCode", None) == "BusSilent" for event in received.events))
    await subscription.delete()
    await server_rig.say(status())


async def test_silent_daemon_is_an_alarm_and_ends_no_other(server_rig: Stage, client: Client) -> None:
    await server_rig.say(status(troubles=[trouble("BusSilent")]))
    received = ReceivedEvents()
    subscription = await subscribed(client, received)
    await server_rig.say(None)
    await until(lambda: len(received.events) == 1)
    assert received.events[0].ErrorCode == "DaemonSilent"
    await server_rig.say(status())
    await until(lambda: len(received.events) == 3)
    assert {getattr(event, "ActiveState/Id") for event in received.events[1:]} == {False}
    await subscription.delete()


async def test_clients_cannot_write(client: Client) -> None:
    node = await own(client, "X.R")
    with pytest.raises(BadUserAccessDenied):
        await node.write_value(1.0)
    with pytest.raises(BadUserAccessDenied):
        await client.nodes.objects.add_object(2, "intruder")
    with pytest.raises(BadUserAccessDenied):
        await client.delete_nodes([node])
    with pytest.raises(UaError):
        await client.nodes.server.call_method("0:ResendData", ua.Variant(1, ua.VariantType.UInt32))
    assert await node.read_value() == 0.5


async def test_invalid_bytes_end_only_their_own_connection(server_rig: Stage, client: Client) -> None:
    for nonsense in (b"GET / HTTP/1.1\r\n\r\n", b"HELF" + b"\xff" * 60, b"OPNF\x10\x00\x00\x00" + b"\x00" * 8):
        reader, writer = await asyncio.open_connection("127.0.0.1", server_rig.served.port)
        writer.write(nonsense)
        writer.write_eof()
        async with asyncio.timeout(PATIENCE_S):
            await reader.read()
        writer.close()
    assert await (await own(client, "state")).read_value() == "ACTIVE"


async def test_connections_of_one_address_do_not_block_others(server_rig: Stage) -> None:
    held = [await asyncio.open_connection("127.0.0.1", server_rig.served.port) for _ in range(MOST_CONNECTIONS + 4)]
    async with asyncio.timeout(PATIENCE_S):
        for reader, _ in held[MOST_CONNECTIONS:]:
            assert await reader.read() == b""
        there = [
            await asyncio.open_connection("127.0.0.1", server_rig.served.port, local_addr=("127.0.0.2", 0))
            for _ in range(2)
        ]
        for reader, _ in held[:2]:
            assert await reader.read() == b""  # they made room
    for _, writer in (*held, *there):
        writer.close()


@asynccontextmanager
async def guarded(folder: Path, **keys: Any) -> AsyncIterator[str]:
    theirs = await write_certificates(folder, "server", "urn:fdhil:bench")
    users = folder / "users.json"
    write_users(users, {"scada": hash_password(PASSWORD, "watch")})
    files = {"certificate_file": str(theirs[0]), "private_key_file": str(theirs[1]), "users_file": str(users)}
    config = config_of(folder, publish={"opcua": {"port": 0, **files, **keys}})
    async with serve_opcua(config) as served:
        yield f"opc.tcp://127.0.0.1:{served.port}"


async def entered(url: str, folder: Path, name: str, user: str | None, password: str = "") -> Any:
    ours = await write_certificates(folder, name, f"urn:{name}") if not (folder / f"{name}.der").exists() else None
    certificate, key = ours or (folder / f"{name}.der", folder / f"{name}.pem")
    client = Client(url, PATIENCE_S)
    client.application_uri = f"urn:{name}"
    await client.set_security(SecurityPolicyBasic256Sha256, str(certificate), str(key))
    if user is not None:
        client.set_user(user)
        client.set_password(password)
    async with client:
        return (await wait_for_event(await own(client, "state"))).StatusCode.name


async def refused(entering: Awaitable[Any]) -> str:
    try:
        await entering
    except (UaError, OSError, TimeoutError) as error:
        return type(error).__name__
    return "let in"


@pytest.mark.usefixtures("long_computation")
async def test_client_is_authenticated_by_certificate_and_password(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    addresses, ask = set[str](), OpcUaUserManager.get_user

    def asked(door: OpcUaUserManager, *given: Any, **named: Any) -> Any:
        addresses.add(door.address)
        return ask(door, *given, **named)

    monkeypatch.setattr(OpcUaUserManager, "get_user", asked)
    trusted = tmp_path / "trusted"
    trusted.mkdir()
    ours = await write_certificates(tmp_path, "scada", "urn:scada")
    (trusted / "scada.der").write_bytes(ours[0].read_bytes())
    async with guarded(tmp_path, trusted_clients=str(trusted)) as url:
        assert await entered(url, tmp_path, "scada", "scada", PASSWORD) == "Good"
        assert await refused(entered(url, tmp_path, "scada", "scada", "wrong")) == BadUserAccessDenied.__name__
        assert await refused(entered(url, tmp_path, "scada", "nobody", PASSWORD)) == BadUserAccessDenied.__name__
        assert await refused(entered(url, tmp_path, "scada", None)) == BadIdentityTokenRejected.__name__
        assert await refused(entered(url, tmp_path, "stranger", "scada", PASSWORD)) != "let in"
        plain = Client(url, PATIENCE_S)
        plain.set_user("scada")
        plain.set_password(PASSWORD)
        assert await refused(plain.connect()) != "let in"
    message = capfd.readouterr()
    assert PASSWORD not in message.out + message.err
    assert addresses == {"127.0.0.1"}  # by which wrong passwords are counted


@pytest.mark.usefixtures("long_computation")
async def test_removed_user_and_certificate_lose_access(tmp_path: Path) -> None:
    trusted = tmp_path / "trusted"
    trusted.mkdir()
    for name in ("scada", "mes"):
        certificate, _ = await write_certificates(tmp_path, name, f"urn:{name}")
        (trusted / f"{name}.der").write_bytes(certificate.read_bytes())
    async with guarded(tmp_path, trusted_clients=str(trusted)) as url:
        client = Client(url, PATIENCE_S)
        client.application_uri = "urn:scada"
        await client.set_security(
            SecurityPolicyBasic256Sha256, str(tmp_path / "scada.der"), str(tmp_path / "scada.pem")
        )
        client.set_user("scada")
        client.set_password(PASSWORD)
        async with client:
            state = await own(client, "state")
            assert (await wait_for_event(state)).StatusCode.name == "Good"
            write_users(tmp_path / "users.json", {})
            assert await refused(wait_for_event(state)) == BadUserAccessDenied.__name__
        write_users(tmp_path / "users.json", {"scada": hash_password(PASSWORD, "watch")})
        assert await entered(url, tmp_path, "mes", "scada", PASSWORD) == "Good"
        (trusted / "mes.der").unlink()
        assert await refused(entered(url, tmp_path, "mes", "scada", PASSWORD)) != "let in"
        (trusted / "scada.der").unlink()
        assert await refused(entered(url, tmp_path, "scada", "scada", PASSWORD)) != "let in"


@pytest.mark.parametrize(
    ("content", "words"), [(None, "cannot be read"), (b"nonsense", "cannot be used")], ids=["none", "nonsense"]
)
async def test_unusable_certificate_is_named(content: bytes | None, words: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "a.der").write_bytes(content)
    files = {"certificate_file": "a.der", "private_key_file": "a.pem"}
    with pytest.raises(ConnectError, match=words):
        await publish(config_of(tmp_path, publish={"opcua": files}))


@pytest.mark.usefixtures("long_computation")
async def test_server_publishes_a_real_daemon_and_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = config_of(tmp_path, publish={"opcua": {"port": 0, "period_s": 0.1}})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)
        async with publishing("opcua", config) as task:
            address = (await said(task, capsys, "opc.tcp://")).rsplit(" ", 1)[1]
            async with Client(address, PATIENCE_S) as client:
                state = await own(client, "state")
                async with daemon_serving(config, SimulatedMachine()):
                    await read_when(state, "OFF(SHADOW)")
                await read_when(state, None)


async def read_when(node: Node, value: Any) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while True:
            if (await wait_for_event(node)).Value.Value == value:
                return
            await asyncio.sleep(0.02)
