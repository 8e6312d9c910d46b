"""A roll-out from the fleet server to machines and their answers back, stage by stage, with real servers."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import nats.errors
import nats.js.errors
import pytest

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.config import fleet_config as fleet_config
from fdhil.config.fleet_config import Stream
from fdhil.fleet import offer_delivery
from fdhil.fleet.nats_transport import connect_to_server, prepare_record_stream
from fdhil.fleet.offer_delivery import OfferFetcher
from fdhil.fleet.signed_offer import Offer
from fdhil.records import Notice
from fdhil.store.change_offers import list_offers
from tests.daemon.machine_rig import fdhil
from tests.fleet import servers
from tests.fleet.fleet_database import collect_messages, list_messages
from tests.fleet.offer_signing import TOLD, OfferSigner, create_machine
from tests.fleet.recording_machine import RecordingMachine
from tests.fleet.servers import NatsServer, Postgres, wait_until
from tests.fleet.test_server_permissions import SECRET, expect_login
from tests.fleet.test_uplink_to_database import build_fleet_settings, run_process
from tests.shopfloor.mosquitto import certify
from tests.store.sample_records import make_published

pytestmark = pytest.mark.debian
CHANGE = """
name = "friction"
version = 3
text = "Friction of the X axis, from twelve machines"
[labels]
type = "V-800"
[set.axis.X.nominal]
ft = 0.061
"""
MACHINES = ("mill-1", "mill-2", "mill-3")


class FleetRig:
    """A fleet server with its processes and machines, each with its uplink."""

    def __init__(self, folder: Path, database: Postgres, server: NatsServer, capsys: Any) -> None:
        self._folder, self._capsys = folder, capsys
        self.works = OfferSigner(folder)
        self.database = database
        self.fleet = build_fleet_settings(folder, server, database)
        self.change = folder / "change.toml"
        self.change.write_text(CHANGE)
        reported = {"server": server.url}
        self.files = {name: create_machine(self.works, folder / name, machine=name, **reported) for name in MACHINES}

    def config(self, name: str) -> MachineConfig:
        return machine_config.load_config(self.files[name])

    def fdhil(self, code: int, *words: object) -> Any:
        """Run a command with --json and return its document."""
        done = fdhil(*map(str, words), "--json", capsys=self._capsys)
        assert done[0] == code, done
        return json.loads(done[1])

    def uplink(self, name: str) -> None:
        """Run a machine's uplink until everything is fetched and sent."""
        log = self._folder / f"{name}.log"
        for _ in range(3):  # on a busy host an answer may come too late, and it looks again after a minute only
            log.unlink(missing_ok=True)
            with run_process(log, "uplink", self.files[name]) as process:
                wait_until(lambda: "all records are sent" in process.said, "it has sent all")
            if "offers cannot be fetched" not in log.read_text():
                break

    def list_offers(self, name: str) -> list[str]:
        return [path.name for path in list_offers(self.config(name).offers_directory)]

    def open_stage(self, code: int, *options: object) -> Any:
        """Show the roll-out, or open a stage with the options."""
        return self.fdhil(code, "fleet", "stage", self.fleet, self.change, *options)

    def expect_stage(self, code: int, *options: object) -> Any:
        return self.open_stage(code, "--key", self.works.key, "--by", "Anna", *options)

    def query(self, query: str) -> Any:
        return self.database.execute_query(query)


@pytest.fixture
async def fleet_rig(tmp_path: Path, database: Postgres, capsys: Any) -> AsyncIterator[FleetRig]:
    with servers.run_nats(tmp_path) as server:
        shop = FleetRig(tmp_path, database, server, capsys)
        for file in shop.files.values():
            machine = RecordingMachine(file)
            await collect_messages(fleet_config.load_fleet_config(shop.fleet), list_messages(machine))
            machine.close_store()
        yield shop


@pytest.fixture
def collected(fleet_rig: FleetRig, tmp_path: Path) -> Iterator[FleetRig]:
    """The fleet server while its collector runs."""
    with run_process(tmp_path / "collect.log", "fleet", "collect", fleet_rig.fleet) as collector:
        wait_until(lambda: "connected to the server and the database" in collector.said, "it collects")
        yield fleet_rig


def test_change_is_rolled_out_stage_by_stage(collected: FleetRig) -> None:
    shop = collected
    assert shop.open_stage(0)["left"] == list(MACHINES)
    assert shop.expect_stage(0, "--machine", "mill-1")["opened"] == {"stage": 1, "machines": ["mill-1"]}
    shop.uplink("mill-1")
    assert shop.list_offers("mill-1") == ["friction-3.offer"]
    assert "no answer yet" in shop.expect_stage(1, "--count", 1)["error"]["text"]

    before = {name: file.read_bytes() for name, file in shop.files.items()}
    (listed,) = shop.fdhil(0, "offers", "list", shop.files["mill-1"])["offers"]
    assert listed["changes"] == [{"key": "axis.X.nominal.ft", "old": 0.05, "new": 0.061, "loosens": False}]
    assert shop.files["mill-1"].read_bytes() == before["mill-1"]
    shop.fdhil(0, "offers", "accept", shop.files["mill-1"], "friction", "--by", "Bert")
    shop.uplink("mill-1")
    wait_until(lambda: shop.query("SELECT count(*) FROM fleet.offer_answers") == [(1,)], "the answer has come")
    assert "no parameters were identified with it yet" in shop.expect_stage(1, "--count", 1)["error"]["text"]

    machine = RecordingMachine(shop.files["mill-1"])  # the restarted daemon
    digest = shop.config("mill-1").digest
    noticed = Notice("MaintenanceDue", "minor", "Friction rises; look at the lubrication.", "X", 1000)
    lies = Notice("OfferWaits", "minor", "a configuration change is proposed: friction version 4")
    assert machine.store.store_outcomes([replace(make_published(), config_digest=digest), noticed, lies]) == []
    machine.close_store()
    shop.uplink("mill-1")
    wait_until(
        lambda: shop.query(f"SELECT count(*) FROM fleet.parameter_sets WHERE config_digest = '{digest}'") != [(0,)],
        "a set of the new configuration has come",
    )
    (stands,) = shop.open_stage(1)["offered"]
    assert (stands["machine"], stands["in_use"], stands["notices"]) == ("mill-1", True, 1)
    assert "1 notices since" in shop.expect_stage(1, "--count", 1)["error"]["text"]
    opened = shop.expect_stage(0, "--count", 1, "--despite", "a drift that was known before")
    assert opened["opened"] == {"stage": 2, "machines": ["mill-2"]}

    shop.uplink("mill-2")
    assert shop.list_offers("mill-2") == ["friction-3.offer"]
    shop.fdhil(0, "offers", "reject", shop.files["mill-2"], "friction", "--by", "Cleo", "--reason", "another oil")
    shop.uplink("mill-2")
    wait_until(lambda: shop.query("SELECT count(*) FROM fleet.offer_answers") == [(2,)], "the answer has come")
    assert "mill-2: rejected by Cleo: another oil" in shop.expect_stage(1)["error"]["text"]
    assert shop.list_offers("mill-3") == []
    assert shop.open_stage(0, "--withdraw")["withdrawn"] == ["mill-2"]
    shop.uplink("mill-2")
    assert (shop.list_offers("mill-1"), shop.list_offers("mill-2")) == (["friction-3.offer"], [])
    assert {name: shop.files[name].read_bytes() for name in MACHINES[1:]} == {n: before[n] for n in MACHINES[1:]}
    kept = shop.query("SELECT stage, machines, opened_by, despite FROM fleet.offers ORDER BY stage")
    assert kept == [(1, ["mill-1"], "Anna", ""), (2, ["mill-2"], "Anna", "a drift that was known before")]


def test_version_is_one_change_and_only_increases(fleet_rig: FleetRig) -> None:
    fleet_rig.expect_stage(0, "--machine", "mill-1")
    assert (
        "mill-1: no machine with these labels"
        in fleet_rig.expect_stage(1, "--machine", "mill-1", "--despite", "x")["error"]["text"]
    )
    fleet_rig.change.write_text(CHANGE.replace("0.061", "0.07"))
    assert "with other values" in fleet_rig.open_stage(1)["error"]["text"]
    fleet_rig.change.write_text(CHANGE.replace("version = 3", "version = 2"))
    assert "set version = 4 in the file" in fleet_rig.open_stage(1)["error"]["text"]
    fleet_rig.change.write_text(CHANGE.replace("version = 3", "version = 4").replace("V-800", "V-900"))
    assert fleet_rig.open_stage(0)["left"] == []
    assert "no machine with these labels remains" in fleet_rig.expect_stage(1)["error"]["text"]


def test_no_stage_is_opened_while_server_is_unavailable(fleet_rig: FleetRig, tmp_path: Path) -> None:
    fleet_rig.fleet = build_fleet_settings(tmp_path, NatsServer(tmp_path), fleet_rig.database)  # which is not started
    assert "was not opened" in fleet_rig.expect_stage(3)["error"]["text"]
    assert fleet_rig.query("SELECT count(*) FROM fleet.offers") == [(0,)]


# what a machine's own user may, and the folder of the offers -------------------------------------------------------


def secure_server(folder: Path) -> str:
    """Return the documented access rules of the server's configuration."""
    certify(folder)
    tls = f'tls {{ cert_file: "{folder}/broker.pem", key_file: "{folder}/broker.key" }}\n'
    rights = (
        'permissions: {{ publish: ["fdhil.v1.{0}.>", "$JS.API.DIRECT.GET.fdhil-offers.fdhil.offers.v1.{0}"], '
        'subscribe: ["_INBOX_fdhil-{0}.>"] }}'
    )
    users = [f"{{ user: {name}, password: {SECRET}, {rights.format(name)} }}" for name in ("mill-1", "mill-2")]
    return tls + f"authorization {{ users = [ {{ user: works, password: {SECRET} }}, {', '.join(users)} ] }}\n"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    (tmp_path / "password").write_text(SECRET)
    with servers.run_nats(tmp_path, secure_server(tmp_path)) as running:
        yield running


async def fetch_offers(
    config: MachineConfig, fetcher: OfferFetcher | None = None, timeout_s: float = 60.0
) -> list[str]:
    """Let a machine fetch offers, and return those present."""
    assert config.uplink is not None
    async with connect_to_server(config.uplink, f"fdhil-{config.plant_name}", "uplink") as client:
        await (fetcher or OfferFetcher(config)).fetch_offers(client.jetstream(timeout=timeout_s), "5" * 32)
    return sorted(path.name for path in list_offers(config.offers_directory))


async def test_machine_fetches_only_its_own_offers(server: NatsServer, tmp_path: Path) -> None:
    works = OfferSigner(tmp_path)
    keys = {"server": server.url, "password_file": str(tmp_path / "password"), "tls_ca_file": str(tmp_path / "ca.pem")}
    files = {name: create_machine(works, tmp_path / name, machine=name, user=name, **keys) for name in MACHINES[:2]}
    first, second = (machine_config.load_config(file) for file in files.values())
    async with connect_to_server(expect_login(server, tmp_path, "works"), "fdhil-offers", "server") as client:
        stream = client.jetstream(timeout=60.0)
        await prepare_record_stream(stream, Stream(max_bytes=1 << 26))
        await offer_delivery.prepare_offer_stream(stream, 1)
        await offer_delivery.prepare_offer_stream(stream, 1)

        async def publish(machine: str, **changes: Any) -> None:
            document = works.sign_document(**changes)
            await offer_delivery.publish_offer(stream, machine, document, Offer(**(TOLD | changes)))

        assert await fetch_offers(first) == []
        await publish("mill-1")
        await publish("mill-1", name="other")
        assert await fetch_offers(first) == ["friction-3.offer", "other-3.offer"]
        assert await fetch_offers(second) == []
        await publish("mill-1", version=4)  # takes the place of the older one
        assert await fetch_offers(first) == ["friction-4.offer", "other-3.offer"]
        forged = works.sign_document(name="forged").replace(b"0.061", b"0.099")
        await stream.publish(offer_delivery.build_subject("mill-1"), forged + works.sign_document(name="right"))
        assert await fetch_offers(first) == ["right-3.offer"]

        assert first.uplink is not None
        async with connect_to_server(first.uplink, "fdhil-mill-1", "uplink") as machine:
            assert (await offer_delivery._fetch_open_offers(machine.jetstream(timeout=60.0), "mill-1"))[1]
            own = machine.jetstream(timeout=2.0)  # it is not answered what is not its own
            with pytest.raises(nats.errors.Error):  # those of another
                await offer_delivery._fetch_open_offers(own, "mill-2")
            with pytest.raises(nats.errors.Error):  # nor does it write any
                await own.publish(offer_delivery.build_subject("mill-1"), b"", timeout=2.0)
        await stream.purge_stream(offer_delivery.STREAM)
        assert await fetch_offers(first) == []


async def test_offers_stay_without_permission_or_stream(
    server: NatsServer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    works = OfferSigner(tmp_path)
    keys = {"server": server.url, "password_file": str(tmp_path / "password"), "tls_ca_file": str(tmp_path / "ca.pem")}
    file = create_machine(works, tmp_path / "mill-1", machine="mill-1", user="mill-1", **keys)
    config = machine_config.load_config(file)
    config.offers_directory.mkdir(parents=True)
    (config.offers_directory / "friction-3.offer").write_bytes(works.sign_document())
    fetcher = OfferFetcher(config)
    for _ in range(2):
        fetcher._next_s = 0.0
        assert await fetch_offers(config, fetcher, timeout_s=1.0) == ["friction-3.offer"]  # it is never answered
    assert capfd.readouterr().err.count("offers cannot be fetched") == 1
