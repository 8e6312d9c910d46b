"""``fdhil publish mqtt`` as a process, with a real daemon and a real broker."""

from __future__ import annotations

import asyncio
import json
import signal
import ssl
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import aiomqtt
import pytest

from fdhil import config as machine_config
from tests.daemon.machine_rig import BENCH
from tests.daemon.simulated_machine import SimulatedMachine, rapids
from tests.daemon.test_daemon_service import serving, status_when
from tests.free_ports import find_free_port
from tests.shopfloor.mosquitto import broker, certify, guarded, open_to_all
from tests.shopfloor.sparkplug_host import Host, command

pytestmark = pytest.mark.debian
SECRET = "canary-7f3a9"


@pytest.fixture(autouse=True)
def _skip_kernel_warmup(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)


def written(folder: Path, port: int, more: str = "") -> Path:
    file = folder / "machine.toml"
    file.write_text(f"{BENCH}[publish.mqtt]\nport = {port}\nperiod_s = 0.1\n{more}")
    return file


@asynccontextmanager
async def publisher(file: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    with (file.parent / "publish.log").open("ab") as log:
        arguments = ("-m", "fdhil", "publish", "mqtt", file)
        process = await asyncio.create_subprocess_exec(sys.executable, *arguments, stdout=log, stderr=log)
    try:
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
            assert await process.wait() == 0


class Listening:
    def __init__(self, client: aiomqtt.Client) -> None:
        self.client, self.host = client, Host()

    async def until(self, so: Callable[[Host], object]) -> None:
        async with asyncio.timeout(120):
            while not so(self.host):
                message = await anext(aiter(self.client.messages))
                if "/STATE/" not in message.topic.value and "/NCMD/" not in message.topic.value:
                    assert not message.retain
                    assert isinstance(message.payload, bytes)
                    self.host.take(message.topic.value, message.payload)

    async def command(self, name: str) -> None:
        await self.client.publish("spBv1.0/fdhil/NCMD/bench", command(name, True))


@asynccontextmanager
async def host_application(port: int, **more: object) -> AsyncIterator[Listening]:
    async with aiomqtt.Client("127.0.0.1", port, timeout=120.0, **more) as client:  # type: ignore[arg-type]
        await client.subscribe("spBv1.0/#", qos=1)
        yield Listening(client)


async def test_real_broker_receives_birth_data_and_death(tmp_path: Path) -> None:
    port = find_free_port()
    file = written(tmp_path, port)
    config = machine_config.load_config(file)
    machine = SimulatedMachine()
    async with broker(tmp_path, open_to_all(port), port), host_application(port) as listening:
        async with publisher(file) as first:
            await listening.until(lambda host: host.verbs == ["NBIRTH"])
            assert listening.host.values[""]["up"] is False
            async with serving(config, machine) as path:
                await listening.until(lambda host: {"X", "Y"} <= set(host.values))
                assert listening.host.values[""]["config_digest"] == config.digest
                machine.give(*rapids(config, count=2))
                await listening.until(lambda host: host.values["X"]["revision"] == 2.0)
                x = listening.host.values["X"]
                status = await status_when(path, lambda status: status["ok"])
                shown_status = status["axes"]["X"]["parameters"]["K"]
                assert (x["K"], x["K_low"], x["K_high"]) == (
                    shown_status["value"],
                    shown_status["low"],
                    shown_status["high"],
                )
                await listening.command("arm")
                await listening.command("Node Control/Rebirth")
                await listening.until(lambda host: host.verbs.count("NBIRTH") == 2)
                await listening.until(lambda host: {"X", "Y"} <= set(host.values))
                assert listening.host.values["X"]["K"] == shown_status["value"]
                assert (await status_when(path, lambda status: status["ok"]))["armed"] is None
            await listening.until(lambda host: set(host.values) == {""})
            assert listening.host.values[""]["up"] is False
            first.kill()
            assert await first.wait() == -signal.SIGKILL
            await listening.until(lambda host: not host.alive)  # the broker tells of it, by the will
        async with publisher(file):
            await listening.until(lambda host: host.alive)
        await listening.until(lambda host: not host.alive)  # it tells of it itself
        assert listening.host.verbs[-1] == "NDEATH"


async def test_publisher_reconnects_after_a_broker_restart(tmp_path: Path) -> None:
    port = find_free_port()
    async with publisher(written(tmp_path, port)):
        await _said(tmp_path, "check host and port, and whether it runs")
        for _ in range(2):
            async with broker(tmp_path, open_to_all(port), port), host_application(port) as listening:
                await listening.command("Node Control/Rebirth")  # its birth may have come before anybody listened
                await listening.until(lambda host: host.alive)
    assert (tmp_path / "publish.log").read_text().count("Traceback") == 0


async def test_publisher_connects_over_tls_with_a_private_password(tmp_path: Path) -> None:
    port = find_free_port()
    own = f'tls_certificate_file = "{tmp_path}/client.pem"\ntls_key_file = "{tmp_path}/client.key"\n'
    user = f'user = "mill"\npassword_file = "{tmp_path}/secret"\n'
    file, secret = written(tmp_path, port, f'tls_ca_file = "{tmp_path}/ca.pem"\n{own}{user}'), tmp_path / "secret"
    secret.write_text("wrong\n")
    async with broker(tmp_path, guarded(tmp_path, port, "mill", SECRET), port):
        async with publisher(file):
            await _said(tmp_path, "it refuses ([code:135] Not authorized); check user")
        secret.write_text(f"{SECRET}\n")
        context = ssl.create_default_context(cafile=str(tmp_path / "ca.pem"))
        context.load_cert_chain(tmp_path / "client.pem", tmp_path / "client.key")
        as_host = {"tls_context": context, "username": "mill", "password": SECRET}
        async with host_application(port, **as_host) as listening, publisher(file) as process:
            await listening.until(lambda host: host.alive)
            seen = Path(f"/proc/{process.pid}/cmdline").read_bytes() + Path(f"/proc/{process.pid}/environ").read_bytes()
            assert SECRET.encode() not in seen
    assert SECRET not in (tmp_path / "publish.log").read_text()


async def test_broker_with_a_wrong_certificate_receives_nothing(tmp_path: Path) -> None:
    port = find_free_port()
    (another := tmp_path / "another").mkdir()
    certify(another)
    tls = f'tls_ca_file = "{another}/ca.pem"\nuser = "mill"\npassword_file = "{tmp_path}/secret"\n'
    (tmp_path / "secret").write_text(SECRET)
    async with broker(tmp_path, guarded(tmp_path, port, "mill", SECRET), port), publisher(written(tmp_path, port, tls)):
        await _said(tmp_path, "CERTIFICATE_VERIFY_FAILED")


async def test_publisher_waits_for_the_primary_host(tmp_path: Path) -> None:
    port = find_free_port()
    file = written(tmp_path, port, 'primary_host = "scada"\n')
    async with broker(tmp_path, open_to_all(port), port), host_application(port) as listening, publisher(file):
        await _said(tmp_path, "connected to the broker")
        await _state(listening.client, True, 1)
        await listening.until(lambda host: host.alive)
        await _state(listening.client, False, 2)
        await listening.until(lambda host: not host.alive)
        await _state(listening.client, True, 3)
        await listening.until(lambda host: host.alive)
        assert listening.host.verbs == ["NBIRTH", "NDEATH", "NBIRTH"]


async def _state(client: aiomqtt.Client, online: bool, stamp_ms: int) -> None:
    result = json.dumps({"online": online, "timestamp": stamp_ms})
    await client.publish("spBv1.0/STATE/scada", result, qos=1, retain=True)


async def _said(folder: Path, words: str) -> None:
    log = folder / "publish.log"
    for _ in range(2400):
        if log.exists() and words in log.read_text():
            return
        await asyncio.sleep(0.05)
    raise TimeoutError(log.read_text())
