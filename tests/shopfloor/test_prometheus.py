"""Prometheus metrics: names, units and access; alerts and dashboard refer only to existing metrics."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import shutil
import ssl
import subprocess
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConnectError
from fdhil.shopfloor.prometheus_endpoint import MOST_CONNECTIONS, MetricsPage, publish
from fdhil.shopfloor.prometheus_metrics import MetricsCollector
from fdhil.shopfloor.status_poller import StatusPoller, StatusUpdate
from tests.daemon.simulated_machine import SimulatedMachine, config_of, rapids
from tests.daemon.test_daemon_service import serving, status_when
from tests.free_ports import find_free_port
from tests.shopfloor.mosquitto import certify
from tests.shopfloor.status_documents import NOW_MS, notice, publishing, said, status, trouble

CONFIGS = Path(__file__).parents[2] / "configs"
ALERTS, DASHBOARD = CONFIGS / "prometheus" / "fdhil-alerts.yml", CONFIGS / "grafana" / "fdhil.json"
LOCAL = {"host": "localhost"}
PATIENCE_S = 300.0


def news_of(config: MachineConfig, *answers: dict[str, Any] | None) -> StatusUpdate:
    listener = StatusPoller(config)
    return [listener.build_update(each, NOW_MS, "" if each else "it is not running") for each in answers][-1]


def page_of(news: StatusUpdate | None, hosts: tuple[str, ...] = ("localhost",)) -> MetricsPage:
    metrics = MetricsCollector()
    if news is not None:
        metrics.take_update(news)
    return MetricsPage(metrics, hosts)


async def get(
    page: MetricsPage, path: str = "/metrics", headers: dict[str, str] = LOCAL, method: str = "GET"
) -> httpx.Response:
    transport = httpx.ASGITransport(app=page)  # type: ignore[arg-type]
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        return await client.request(method, path, headers=headers)


def samples(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.fixture
def full_update(tmp_path: Path) -> StatusUpdate:
    config = config_of(tmp_path, "XY")
    first = status(notices=[])
    return news_of(config, first, status(troubles=[trouble("BusSilent")], notices=[notice("Armed", 0.1)]))


async def test_every_value_is_a_metric_in_base_units(full_update: StatusUpdate) -> None:
    answer = await get(page_of(full_update))
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    found = samples(answer.text)
    x = (("axis", "X"),)
    assert found["fdhil_up", ()] == 1
    assert found["fdhil_coulomb_friction_newton_meters", x] == 5.0
    assert found["fdhil_inductance_low_henries", x] == pytest.approx(0.0045)
    assert found["fdhil_offset_meters", x] == pytest.approx(4.5e-6)
    assert found["fdhil_nc_feed_meters_per_second", ()] == pytest.approx(0.1)
    assert found["fdhil_last_rapid_fit_ratio", x] == pytest.approx(0.985)
    assert found["fdhil_bus_load_ratio", (("bus", "can0"),)] == pytest.approx(0.42)
    assert found["fdhil_windows_accepted_total", x] == 40
    assert found["fdhil_state", (("state", "ACTIVE"),)] == 1
    assert found["fdhil_state", (("state", "FROZEN"),)] == 0
    assert found["fdhil_offset_stands", ()] == 1
    assert found["fdhil_alarm", (("axis", ""), ("code", "BusSilent"), ("severity", "MAJOR"))] == 1
    assert found["fdhil_notices_total", (("code", "Armed"), ("severity", "info"))] == 1
    assert found["fdhil_armed_info", (("method", "inverse"), ("program", "part.ngc"))] == 1
    result = {value.item.name for value in full_update.values if value.item.kind != "text"}
    assert len({name for name, _ in found}) >= len(result)


async def test_silent_daemon_leaves_up_and_the_time_of_the_last_answer(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    page, listener = page_of(None), StatusPoller(config)
    assert set(samples((await get(page)).text)) == {("fdhil_up", ())}
    metrics = MetricsCollector()
    metrics.take_update(listener.build_update(status("X"), NOW_MS))
    metrics.take_update(listener.build_update(None, NOW_MS + 1000, "it is not running"))
    found = samples((await get(MetricsPage(metrics, ("localhost",)))).text)
    assert found == {("fdhil_up", ()): 0.0, ("fdhil_answered_timestamp_seconds", ()): NOW_MS * 1e-3}


async def test_unknown_values_are_absent(tmp_path: Path) -> None:
    answer = status("X")
    answer["axes"]["X"]["parameters"] = None
    answer["guard"]["heard_s_ago"] = 60.0
    found = {name for name, _ in samples((await get(page_of(news_of(config_of(tmp_path), answer)))).text)}
    assert not any(name.startswith(("fdhil_resistance", "fdhil_offset_meters")) for name in found)
    assert "fdhil_windows_used" in found


@pytest.mark.parametrize(
    ("host", "expected"),
    [("localhost", 200), ("LOCALHOST:9837", 200), ("evil.example", 421), ("localhost.evil.example", 421), ("", 421)],
)
async def test_only_configured_hosts_are_served(full_update: StatusUpdate, host: str, expected: int) -> None:
    answer = await get(page_of(full_update), headers={"host": host})
    assert answer.status_code == expected
    assert ("fdhil_" in answer.text) == (expected == 200)


async def test_metrics_page_is_the_only_one_and_read_only(full_update: StatusUpdate) -> None:
    assert (await get(page_of(full_update), "/")).status_code == 404
    assert (await get(page_of(full_update), method="POST")).status_code == 405
    head = await get(page_of(full_update), method="HEAD")
    assert (head.status_code, head.content) == (200, b"")


async def _nonsense_is_answered(address: httpx.URL, caplog: pytest.LogCaptureFixture) -> None:
    socket = "Connection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    socket += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nHost: localhost\r\n\r\n"
    for sent, expected in (("\x16\x03\r\n\r\n", b" 400 "), (f"GET /metrics HTTP/1.1\r\n{socket}", b" 200 ")):
        reader, writer = await asyncio.open_connection(address.host, address.port)
        writer.write(sent.encode())
        async with asyncio.timeout(60):
            assert expected in await reader.readline()
        writer.close()
    assert [record for record in caplog.records if record.name.startswith("uvicorn")] == []


async def test_metrics_of_a_real_daemon_are_served(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)
    config = config_of(tmp_path, publish={"prometheus": {"port": 0, "period_s": 0.1}})
    async with publishing("prometheus", config) as task, httpx.AsyncClient(timeout=PATIENCE_S) as client:
        address = (await said(task, capsys, "/metrics")).rsplit(" ", 1)[1]
        await _nonsense_is_answered(httpx.URL(address), caplog)
        assert ("fdhil_up", ()) in samples((await client.get(address)).text)
        async with serving(config, SimulatedMachine(rapids(config, count=1))) as path:
            await status_when(path, lambda s: s["axes"]["X"]["accepted"] == 1)
            found = await metrics_when(client, address, ("fdhil_revision", (("axis", "X"),)), 1.0)
            assert found["fdhil_windows_accepted_total", (("axis", "X"),)] == 1
        await metrics_when(client, address, ("fdhil_up", ()), 0.0)


async def test_idle_connections_are_closed_and_do_not_block_scrapes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of(tmp_path, publish={"prometheus": {"port": 0}})
    async with publishing("prometheus", config) as task, httpx.AsyncClient(timeout=PATIENCE_S) as client:
        address = httpx.URL((await said(task, capsys, "/metrics")).rsplit(" ", 1)[1])
        held = [await asyncio.open_connection(address.host, address.port) for _ in range(MOST_CONNECTIONS + 8)]
        assert (await client.get(address)).status_code == 200
        monkeypatch.setattr("fdhil.connections.QUIET_S", 0.05)
        reader, silent = await asyncio.open_connection(address.host, address.port)
        with contextlib.suppress(ConnectionError):
            assert await asyncio.wait_for(reader.read(), PATIENCE_S) == b""
        for writer in (silent, *(writer for _, writer in held)):
            writer.close()


async def test_client_without_a_certificate_reads_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    certify(tmp_path)
    files = {"tls_certificate_file": "broker.pem", "tls_key_file": "broker.key", "tls_client_ca_file": "ca.pem"}
    keys = {"host": "0.0.0.0", "port": 0, "allowed_hosts": ["127.0.0.1"], **files}
    known, stranger = (ssl.create_default_context(cafile=str(tmp_path / "ca.pem")) for _ in range(2))
    known.load_cert_chain(tmp_path / "client.pem", tmp_path / "client.key")
    async with publishing("prometheus", config_of(tmp_path, publish={"prometheus": keys})) as task:
        address = (await said(task, capsys, "/metrics")).rsplit(" ", 1)[1].replace("0.0.0.0", "127.0.0.1")
        async with httpx.AsyncClient(verify=known, timeout=PATIENCE_S) as client:
            assert ("fdhil_up", ()) in samples((await client.get(address)).text)
        for context, at in ((stranger, address), (known, address.replace("https", "http"))):
            async with httpx.AsyncClient(verify=context, timeout=PATIENCE_S) as client:
                with pytest.raises(httpx.TransportError):
                    await client.get(at)


async def metrics_when(client: httpx.AsyncClient, address: str, key: Any, value: float) -> dict[Any, float]:
    async with asyncio.timeout(120.0):
        while True:
            found = samples((await client.get(address)).text)
            if found.get(key) == value:
                return found
            await asyncio.sleep(0.05)


@pytest.mark.parametrize(
    ("keys", "word"),
    [
        ({"host": "0.0.0.0"}, "unprotected"),
        ({"host": "192.0.2.1", "tls_certificate_file": "a", "tls_key_file": "b"}, "tls_client_ca_file"),
        ({"tls_key_file": "b"}, "tls_certificate_file"),
        ({"tls_client_ca_file": "c"}, "tls_certificate_file"),
    ],
)
def test_remote_access_needs_an_explicit_setting(keys: dict[str, Any], word: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=word):
        config_of(tmp_path, publish={"prometheus": keys})
    config_of(tmp_path, publish={"prometheus": {"host": "0.0.0.0", "unprotected": True}})


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"port": 0, "tls_certificate_file": "none.crt", "tls_key_file": "none.key"}, "TLS files cannot be used"),
        ({"host": "203.0.113.1", "unprotected": True}, "cannot listen"),  # TEST-NET-3: no computer has it
    ],
)
async def test_unusable_settings_are_reported_in_one_sentence(keys: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ConnectError, match=words):
        await publish(config_of(tmp_path, publish={"prometheus": keys}))


def named(expression: str) -> set[str]:
    return set(re.findall(r"\bfdhil_[a-z_]+\b", expression))


def expressions_of(dashboard: Any) -> list[str]:
    if isinstance(dashboard, dict):
        own = [value for key, value in dashboard.items() if key in ("expr", "query", "definition") and value]
        return [text for text in own if isinstance(text, str)] + expressions_of(list(dashboard.values()))
    return [text for each in dashboard for text in expressions_of(each)] if isinstance(dashboard, list) else []


async def test_every_metric_of_the_dashboard_and_of_the_alerts_exists(full_update: StatusUpdate) -> None:
    there = {name for name, _ in samples((await get(page_of(full_update))).text)}
    of_dashboard = set().union(*map(named, expressions_of(json.loads(DASHBOARD.read_text()))))
    of_alerts = set().union(*map(named, re.findall(r"^ +expr: (.*(?:\n {10}.*)*)", ALERTS.read_text(), re.MULTILINE)))
    assert len(of_dashboard) > 40
    assert len(of_alerts) > 10
    assert (of_dashboard - there, of_alerts - there) == (set(), set())


def test_each_alert_has_a_promtool_test() -> None:
    alerts = re.findall(r"- alert: (\w+)", ALERTS.read_text())
    tests = "".join(path.read_text() for path in Path(__file__).parent.glob("*.test.yml"))
    seen = set(re.findall(r"alertname: (\w+)\n +exp_alerts:\n", tests))
    assert len(alerts) == len(set(alerts)) > 8
    assert set(alerts) - seen == set()


@pytest.mark.debian
def test_promtool_accepts_the_rules_and_their_tests(tmp_path: Path) -> None:
    for path in (*CONFIGS.glob("prometheus/*.yml"), *Path(__file__).parent.glob("*.test.yml")):
        shutil.copy(path, tmp_path)
    for words in (
        ["check", "rules", "fdhil-alerts.yml"],
        ["check", "config", "prometheus.yml"],
        ["test", "rules", "alerts.test.yml", "alerts-of-weeks.test.yml"],
    ):
        done = subprocess.run(["promtool", *words], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.debian
async def test_real_prometheus_scrapes_and_raises_an_alert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = config_of(tmp_path, publish={"prometheus": {"port": 0}})
    async with publishing("prometheus", config) as task:
        address = (await said(task, capsys, "/metrics")).rsplit(" ", 1)[1]
        target = address.removeprefix("http://").removesuffix("/metrics")
        text = (CONFIGS / "prometheus" / "prometheus.yml").read_text()
        text = text.replace("127.0.0.1:9837", target).replace("15s", "1s")
        (tmp_path / "prometheus.yml").write_text(text)
        (tmp_path / "fdhil-alerts.yml").write_text(ALERTS.read_text().replace("for: 1m", "for: 0s"))
        port = find_free_port()
        command = [
            "prometheus", f"--config.file={tmp_path / 'prometheus.yml'}", f"--storage.tsdb.path={tmp_path / 'data'}",
            f"--web.listen-address=127.0.0.1:{port}", "--log.level=error",
        ]  # fmt: skip
        quiet = asyncio.subprocess.DEVNULL
        prometheus = await asyncio.create_subprocess_exec(*command, stdout=quiet, stderr=quiet)
        try:
            firing = await alerts_of(f"http://127.0.0.1:{port}", prometheus)
        finally:
            prometheus.terminate()
            await prometheus.wait()
    assert firing == {"FdhilDaemonSilent"}


async def alerts_of(address: str, prometheus: asyncio.subprocess.Process) -> set[str]:
    deadline_s = time.monotonic() + PATIENCE_S
    async with httpx.AsyncClient() as client:
        while time.monotonic() < deadline_s and prometheus.returncode is None:
            try:
                expected = (await client.get(f"{address}/api/v1/alerts")).json()["data"]["alerts"]
            except (httpx.TransportError, ValueError, KeyError):
                expected = []
            if firing := {alert["labels"]["alertname"] for alert in expected if alert["state"] == "firing"}:
                return firing
            await asyncio.sleep(0.2)
    raise TimeoutError("no alert fired")
