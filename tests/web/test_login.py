"""Logins, tokens and throttling, without HTTP."""

from __future__ import annotations

import asyncio
import hashlib
from pathlib import Path
from typing import Any

import pytest

from fdhil.config.user_file import Role, User, read_users, verify_password, write_users
from fdhil.errors import ConfigError
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.login import (
    FREE_GUESSES,
    IDLE_S,
    LIFE_S,
    LONGEST_WAIT_S,
    MOST_TOKENS,
    LoginManager,
    PasswordQueue,
    Principal,
    find_client_network,
)
from tests.web.http_clients import PASSWORD, make_user


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def logins(tmp_path: Path, clock: Clock) -> LoginManager:
    write_users(tmp_path / "users", {"ann": make_user("watch"), "op": make_user("operate")})
    return LoginManager(tmp_path / "users", clock)


def test_password_matches_only_its_user() -> None:
    assert verify_password(make_user("operate"), PASSWORD)
    assert not verify_password(make_user("operate"), PASSWORD + "x")
    assert not verify_password(None, PASSWORD)


def test_users_file_has_no_passwords_and_is_private(tmp_path: Path) -> None:
    path = tmp_path / "users"
    write_users(path, {"op": make_user("operate")})
    assert path.stat().st_mode & 0o777 == 0o600
    assert PASSWORD.encode() not in path.read_bytes()
    path.chmod(0o640)
    write_users(path, {"op": make_user("operate"), "ann": make_user("watch")})
    assert path.stat().st_mode & 0o777 == 0o640  # the group of fdhil web may read it
    assert sorted(read_users(path)) == ["ann", "op"]
    assert [p.name for p in tmp_path.iterdir()] == ["users"]
    path.chmod(0o644)
    with pytest.raises(ConfigError, match=r"open to every user of this computer \(chmod 0640"):
        read_users(path)


@pytest.mark.parametrize("text", ["", "{", '{"users": {"op": {"role": "root", "salt": "c2VjcmV0", "scrypt": "x"}}}'])
def test_faulty_users_file_is_reported_without_content(tmp_path: Path, text: str) -> None:
    path = tmp_path / "users"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="is not a users file") as reported:
        LoginManager(path)
    assert "c2VjcmV0" not in str(reported.value)


async def test_login_ends_by_lifetime_idleness_and_logout(logins: LoginManager, clock: Clock) -> None:
    token, session = await logins.log_in("op", PASSWORD, "127.0.0.1")
    assert session.principal == logins.find_principal(token) == Principal("op", "operate")
    for _ in range(int(LIFE_S / IDLE_S) + 1):
        clock.now_s += IDLE_S - 1
        if clock.now_s - 1000.0 < LIFE_S:
            assert logins.find_principal(token) is not None
    assert logins.find_principal(token) is None  # used all the time, and over all the same
    token, _ = logins.start_session("op", make_user("operate"))
    clock.now_s += IDLE_S
    assert logins.find_principal(token) is None
    token, _ = logins.start_session("op", make_user("operate"))
    logins.log_out(token)
    assert logins.find_principal(token) is None


def test_removed_or_changed_user_loses_old_rights(logins: LoginManager, tmp_path: Path) -> None:
    tokens = [logins.start_session("op", make_user("operate"))[0], logins.start_session("ann", make_user("watch"))[0]]
    write_users(tmp_path / "users", {"op": make_user("watch")})
    assert [logins.find_principal(token) for token in tokens] == [None, None]
    assert logins.find_principal(logins.start_session("op", make_user("watch"))[0]) == Principal("op", "watch")
    (tmp_path / "users").unlink()
    assert logins.find_principal(logins.start_session("op", make_user("watch"))[0]) is None


@pytest.mark.parametrize("role", ["operate", "watch"])  # of whom is asked for, the same as at the login or not
def test_logout_ends_login_in_use(logins: LoginManager, role: Role, monkeypatch: pytest.MonkeyPatch) -> None:
    token, _ = logins.start_session("op", make_user("operate"))

    def logged_out_meanwhile(_: str) -> User:
        logins.log_out(token)
        return make_user(role)

    with monkeypatch.context() as patch:
        patch.setattr(logins, "_find_user", logged_out_meanwhile)
        logins.find_principal(token)
    assert logins.find_principal(token) is None


@pytest.mark.parametrize("token", [None, "", "x", "é", "a" * 100_000])
def test_invalid_token_has_no_principal(logins: LoginManager, token: str | None) -> None:
    assert logins.find_principal(token) is None


def test_tokens_are_stored_as_digests_and_limited(logins: LoginManager) -> None:
    tokens = [logins.start_session("ann", make_user("watch"))[0] for _ in range(MOST_TOKENS + 1)]
    assert logins.find_principal(tokens[0]) is None
    assert logins.find_principal(tokens[-1]) is not None
    kept = repr(vars(logins))
    assert tokens[-1] not in kept
    assert hashlib.sha256(tokens[-1].encode()).hexdigest() in kept


def test_repeated_logins_do_not_end_other_users_logins(logins: LoginManager) -> None:
    token, _ = logins.start_session("op", make_user("operate"))
    tokens = [logins.start_session("ann", make_user("watch"))[0] for _ in range(2 * MOST_TOKENS)]
    assert logins.find_principal(token) is not None
    assert [logins.find_principal(each) is not None for each in (tokens[0], tokens[-1])] == [False, True]


async def test_guesses_are_throttled_by_user_and_address(
    logins: LoginManager, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []

    def fits(_: User | None, password: str) -> bool:
        looked.append(password)
        return password == PASSWORD

    monkeypatch.setattr("fdhil.web.login.verify_password", fits)
    for k in range(FREE_GUESSES):
        with pytest.raises(RequestRefused, match="wrong name or password"):
            await logins.log_in("op", f"guess {k}", "192.0.2.1")
    with pytest.raises(RequestRefused, match="too many logins failed") as reported:
        await logins.log_in("ann", PASSWORD, "192.0.2.1")  # the same place, another user
    assert reported.value.status == 429
    assert len(looked) == FREE_GUESSES  # a refused one costs nothing
    with pytest.raises(RequestRefused, match="wrong name or password"):
        await logins.log_in("op", "guess", "192.0.2.2")  # elsewhere, the same user: one guess, and no more
    with pytest.raises(RequestRefused, match="too many"):
        await logins.log_in("op", "guess", "192.0.2.2")
    clock.now_s += LONGEST_WAIT_S
    await logins.log_in("op", PASSWORD, "192.0.2.2")
    await logins.log_in("op", PASSWORD, "192.0.2.2")  # and all is forgotten


async def test_unknown_user_takes_as_long_as_wrong_password(
    logins: LoginManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashes: list[int] = []
    real = hashlib.scrypt

    def counted(password: bytes, **settings: Any) -> bytes:
        hashes.append(settings["n"])
        return real(password, **settings)

    monkeypatch.setattr("hashlib.scrypt", counted)
    reported = []
    for name in ("op", "nobody"):
        with pytest.raises(RequestRefused) as refused:
            await logins.log_in(name, "a wrong one", "127.0.0.1")
        reported.append(refused.value.document)
    assert reported[0] == reported[1]
    assert hashes[0] == hashes[1] == 2**15


async def test_foreign_guesses_do_not_lock_out_known_address(
    logins: LoginManager, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.login.verify_password", lambda _, password: password == PASSWORD)
    await logins.log_in("op", PASSWORD, "192.0.2.1")
    for k in range(FREE_GUESSES):
        with pytest.raises(RequestRefused, match="wrong name or password"):
            await logins.log_in("op", "a guess", f"198.51.100.{k}")
    await logins.log_in("op", PASSWORD, "198.51.100.77")  # where he never was, and nobody guessed
    await logins.log_in("op", PASSWORD, "192.0.2.1")
    for _ in range(FREE_GUESSES):
        with pytest.raises(RequestRefused, match="wrong name or password"):
            await logins.log_in("op", "a guess", "192.0.2.1")
    with pytest.raises(RequestRefused, match="too many"):
        await logins.log_in("op", PASSWORD, "192.0.2.1")  # but where he is it is guessed no faster than elsewhere


async def test_guesses_from_many_addresses_lock_nobody_out(
    logins: LoginManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.login.verify_password", lambda _, password: password == PASSWORD)

    async def guess(k: int) -> str:
        try:
            await logins.log_in("op", "a guess", f"198.51.{k // 100}.{k % 100}")
        except RequestRefused as refused:
            return str(refused.document["code"])
        return "in"

    for _ in range(6):
        guesses = [asyncio.create_task(guess(k)) for k in range(183)]
        await asyncio.sleep(0)
        await logins.log_in("op", PASSWORD, "192.0.2.9")
        assert set(await asyncio.gather(*guesses)) <= {"AuthRequired", "TooMany"}
        logins._places.clear()  # as after a restart


async def test_passwords_are_checked_in_order_of_failures() -> None:
    turns, order = PasswordQueue(), list[str]()

    async def check(place: str, wrong: int) -> None:
        async with turns.wait_for_turn(place, wrong):
            order.append(f"{place} {wrong}")
            await asyncio.sleep(0)

    waiting = [("a", 9), ("f", 5), ("b", 5), ("c", 3), ("d", 4), ("e", 2), ("b", 5), ("a", 0)]
    tasks = [asyncio.create_task(check(*each)) for each in waiting]
    await asyncio.sleep(0)
    tasks[5].cancel()
    results = await asyncio.gather(*tasks, return_exceptions=True)
    assert order == ["a 9", "a 0", "c 3", "d 4", "b 5", "f 5"]
    assert [type(result) for result in results if result] == [
        RequestRefused,
        asyncio.CancelledError,
    ]  # the older one of b


async def test_ipv6_addresses_of_one_network_count_as_one(
    logins: LoginManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.login.verify_password", lambda *_: False)
    for k in range(FREE_GUESSES):
        with pytest.raises(RequestRefused, match="wrong name or password"):
            await logins.log_in(f"name{k}", "a guess", f"2001:db8::{k}")
    with pytest.raises(RequestRefused, match="too many"):
        await logins.log_in("another", "a guess", "2001:db8::ffff")
    with pytest.raises(RequestRefused, match="wrong name or password"):
        await logins.log_in("another", "a guess", "2001:db8:0:1::1")
    assert find_client_network("::ffff:192.0.2.1") == "192.0.2.1"
