"""``fdhil web`` and ``fdhil web-user``: addresses, refusals, and that no secret leaks."""

from __future__ import annotations

import io
import json
import ssl
from pathlib import Path
from typing import Any

import httpx
import pytest

from fdhil.cli.demo.processes import ChildProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.config.user_file import read_users, verify_password
from fdhil.config.web_section import Web, is_loopback
from fdhil.errors import ConfigError, FdhilError
from fdhil.web import serving
from tests.bench import bench_axis
from tests.daemon.machine_rig import fdhil
from tests.daemon.simulated_machine import config_of
from tests.web.certificate import write_certificate
from tests.web.http_clients import OWN

Capture = pytest.CaptureFixture[str]
TLS = {"tls_certificate_file": Path("c"), "tls_key_file": Path("k")}
USERS = {"users_file": Path("u")}
CANARY = "canary-5e7a"


def test_default_serves_only_this_computer() -> None:
    web = Web()
    assert (web.host, web.on_loopback, web.acting, web.unprotected) == ("127.0.0.1", True, False, False)
    serving.check_reach(web)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.7", "mill.example", "127.0.0.1.example"])
def test_remote_access_requires_tls_and_users_or_unprotected(host: str) -> None:
    assert not is_loopback(host)
    for given, missing in (({}, 2), (TLS, 1), (USERS, 1)):
        with pytest.raises(ConfigError) as reported:
            serving.check_reach(Web(host=host, **given))
        assert len(reported.value.faults) == missing
        assert "other computers can reach" in str(reported.value) or "users_file" in str(reported.value)
    serving.check_reach(Web(host=host, **TLS, **USERS))
    serving.check_reach(Web(host=host, unprotected=True))
    with pytest.raises(ConfigError, match="operators send passwords"):  # no word helps against that
        serving.check_reach(Web(host=host, unprotected=True, acting=True, users_file=Path("u")))


def test_incomplete_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="must be given together"):
        config_of(tmp_path, web={"tls_key_file": "k"})
    with pytest.raises(ConfigError, match="acting needs a users_file"):
        config_of(tmp_path, web={"acting": True})


def test_users_do_not_change_config_digest(tmp_path: Path) -> None:
    changed = config_of(tmp_path, web={"port": 0, "users_file": "u", "acting": True})
    assert changed.digest == config_of(tmp_path).digest
    assert changed.web.users_file == tmp_path / "u"


def test_missing_extra_is_reported_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.web.serving.find_spec", lambda name: None)
    with pytest.raises(FdhilError, match=r"needs the extra 'web': pip install 'fdhil\[web\]'"):
        serving.require_extra()


def write_config(folder: Path, **web: Any) -> Path:
    path = folder / "machine.toml"
    path.write_text(format_toml({"machine": {"name": "bench"}, "axis": {"X": bench_axis()}, "web": web}))
    return path


def run_with_password(
    password: str, *arguments: str | Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> tuple[int, str]:
    monkeypatch.setattr("sys.stdin", io.StringIO(password + "\n"))
    code, out, err = fdhil(*arguments, capsys=capsys)
    return code, out + err


def test_users_are_added_and_removed(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    path, users = write_config(tmp_path, users_file="u.json"), tmp_path / "u.json"

    def run(password: str, *more: str) -> tuple[int, str]:
        return run_with_password(password, "web-user", path, *more, capsys=capsys, monkeypatch=monkeypatch)

    code, message = run(f"{CANARY} long enough", "op", "--role", "operate")
    assert (code, CANARY in message) == (0, False)
    assert verify_password(read_users(users)["op"], f"{CANARY} long enough")
    assert read_users(users)["op"].role == "operate"
    assert run("short", "ann")[0] == 2
    assert run(f"{CANARY} of ann", "a/b")[0] == 2
    assert run(f"{CANARY} of ann", "ann")[0] == 0
    assert read_users(users)["ann"].role == "watch"
    assert run("", "op", "--remove")[0] == 0
    code, message = run("", "op", "--remove")
    assert (code, "there is no user op" in message) == (2, True)
    assert list(read_users(users)) == ["ann"]
    code, message = run_with_password(
        "x", "web-user", write_config(tmp_path), "op", capsys=capsys, monkeypatch=monkeypatch
    )
    assert (code, "add users_file" in message) == (2, True)


def test_unavailable_address_is_reported(tmp_path: Path, capsys: Capture) -> None:
    path = write_config(tmp_path)
    for arguments, code, words in (
        (("--host", "0.0.0.0"), 2, "web.users_file"),
        (("--host", "127.0.0.1", "--port", "99999"), 2, "99999"),
    ):
        found, _, err = fdhil("web", path, *arguments, capsys=capsys)
        assert (found, words in err, "Traceback" in err) == (code, True, False)


@pytest.mark.usefixtures("processes")
@pytest.mark.fault("G10")
@pytest.mark.goal("R16")
def test_tls_server_reveals_no_secret_and_ends_orderly(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_certificate(tmp_path / "web.crt", tmp_path / "web.key")
    files = {"users_file": "u.json", "tls_certificate_file": "web.crt", "tls_key_file": "web.key"}
    path = write_config(tmp_path, port=0, acting=True, **files)
    password = f"{CANARY} of the operator"
    for name, role in (("op", "operate"), ("ann", "watch")):
        run_with_password(password, "web-user", path, name, "--role", role, capsys=capsys, monkeypatch=monkeypatch)
    run_directory = tmp_path / "fdhil-data" / "run"
    run_directory.mkdir(parents=True)
    (run_directory / "token").write_text(f"{CANARY}-token")
    (run_directory / "token").chmod(0o600)
    log = tmp_path / "web.log"
    trusting = ssl.create_default_context(cafile=str(tmp_path / "web.crt"))
    with ChildProcess("web", ["fdhil", "web", str(path), "--json"], log) as web:
        url = web.await_event("ready")["url"]
        assert url.startswith("https://127.0.0.1:")
        with httpx.Client(base_url=url, verify=trusting, headers=OWN, timeout=60.0) as client:
            message = [client.get(page) for page in ("/", "/api/session", "/api/machine", "/static/app.js")]
            login = client.post("/api/session", json={"name": "op", "password": password})
            client.headers["Authorization"] = f"Bearer {login.json()['token']}"
            message += [
                client.post("/api/session", json={"name": CANARY, "password": "wrong"}),
                client.post("/api/session", json={"name": "op", "password": [password]}),
                client.get(f"/api/machine?token={CANARY}"),
                client.get("/api/openapi.json"),
                client.post("/api/machine/disarm"),
            ]
        process = Path(f"/proc/{web.pid}")
        seen = (process / "cmdline").read_bytes() + (process / "environ").read_bytes()
        assert web.stop() == 0
    reported = "".join(answer.text for answer in message)
    for place, text in (("answers", reported), ("log", log.read_text()), ("process list", seen.decode())):
        for secret in (CANARY, login.json()["token"], "PRIVATE KEY", read_users(tmp_path / "u.json")["op"].scrypt):
            assert secret not in text, (place, secret)
    assert json.loads(message[2].text)["code"] == "AuthRequired"
    assert "Traceback" not in log.read_text()


def test_invalid_certificate_is_reported(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "c").write_text("no certificate")
    path = write_config(tmp_path, tls_certificate_file="c", tls_key_file="c")
    code, _, err = fdhil("web", path, capsys=capsys)
    assert (code, "web.tls_certificate_file" in err or "cannot be used" in err) == (2, True)
