"""Units of the OPC UA server, and the clients that its settings accept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fdhil.config.user_file import UsersFile, hash_password, write_users
from fdhil.errors import ConfigError
from fdhil.shopfloor.opcua_access import MOST_FAILURES, OpcUaUserManager
from fdhil.shopfloor.opcua_values import UNITS, make_unit
from fdhil.shopfloor.published_items import AXIS, BUS, MACHINE
from tests.daemon.simulated_machine import config_of

PASSWORD = "canary-of-the-shop-floor"


def test_every_unit_has_a_common_code() -> None:
    assert {item.unit for item in (*MACHINE, *AXIS, *BUS)} - {""} <= set(UNITS)
    assert make_unit("N.m/A").UnitId == 4602160  # as OPC Foundation's table of UNECE codes has F90


def test_password_guessing_is_blocked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("fdhil.shopfloor.opcua_access.verify_password", lambda user, password: password == PASSWORD)
    write_users(tmp_path / "users.json", {"scada": hash_password(PASSWORD, "watch")})
    door = OpcUaUserManager(UsersFile(tmp_path / "users.json"))
    assert door.get_user(None, "scada", PASSWORD) is not None
    for _ in range(MOST_FAILURES):
        assert door.get_user(None, "scada", "wrong") is None
    assert door.get_user(None, "scada", PASSWORD) is None  # not even the right one, for a while
    door.address = "192.0.2.7"
    assert door.get_user(None, "scada", PASSWORD) is not None  # from elsewhere


@pytest.mark.parametrize(
    ("keys", "word"),
    [
        ({"host": "0.0.0.0"}, "users_file and a certificate_file"),
        ({"certificate_file": "a.der"}, "private_key_file"),
        ({"users_file": "u.json"}, "certificate_file"),
        ({"trusted_clients": "folder"}, "certificate_file"),
    ],
)
def test_remote_access_needs_users_and_encryption(keys: dict[str, Any], word: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=word):
        config_of(tmp_path, publish={"opcua": keys})
