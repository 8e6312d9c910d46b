"""Logins, tokens and throttling, without HTTP."""

from __future__ import annotations

import asyncio
import hashlib
from pathlib import Path
from typing import Any

import pytest

from fdhil.config.user_file import Role, User, read_users, verify_password, write_users
from fdhil.errors import ConfigError
from fdhil.web.access import (
    FREE_GUESSES,
    IDLE_S,
    LIFE_S,
    LONGEST_WAIT_S,
    MOST_TOKENS,
    Access,
    Asker,
    Turns,
    place_of,
)
from fdhil.web.answers import Refused
from tests.web.clients import PASSWORD, user


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def access(tmp_path: Path, clock: Clock) -> Access:
    write_users(tmp_path / "users", {"ann": user("watch"), "op": user("operate")})
    return Access(tmp_path / "users", clock)


def test_a_password_fits_its_user_and_nobody_else() -> None:
    assert verify_password(user("operate"), PASSWORD)
    assert not verify_password(user("operate"), PASSWORD + "x")
    assert not verify_password(None, PASSWORD)


def test_the_users_file_holds_no_password_and_is_closed_to_others(tmp_path: Path) -> None:
    path = tmp_path / "users"
    write_users(path, {"op": user("operate")})
    assert path.stat().st_mode & 0o777 == 0o600
    assert PASSWORD.encode() not in path.read_bytes()
    path.chmod(0o640)
    write_users(path, {"op": user("operate"), "ann": user("watch")})
    assert path.stat().st_mode & 0o777 == 0o640  # the group of fdhil web may read it
    assert sorted(read_users(path)) == ["ann", "op"]
    assert [p.name for p in tmp_path.iterdir()] == ["users"]
    path.chmod(0o644)
    with pytest.raises(ConfigError, match=r"open to every user of this computer \(chmod 0640"):
        read_users(path)


@pytest.mark.parametrize("text", ["", "{", '{"users": {"op": {"role": "root", "salt": "c2VjcmV0", "scrypt": "x"}}}'])
def test_a_faulty_users_file_is_told_without_its_content(tmp_path: Path, text: str) -> None:
    path = tmp_path / "users"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="is not a users file") as told:
        Access(path)
    assert "c2VjcmV0" not in str(told.value)


async def test_a_login_ends_by_its_time_by_idleness_and_by_logging_out(access: Access, clock: Clock) -> None:
    token, session = await access.log_in("op", PASSWORD, "127.0.0.1")
    assert session.asker == access.asker(token) == Asker("op", "operate")
    for _ in range(int(LIFE_S / IDLE_S) + 1):
        clock.now_s += IDLE_S - 1
        if clock.now_s - 1000.0 < LIFE_S:
            assert access.asker(token) is not None
    assert access.asker(token) is None  # used all the time, and over all the same
    token, _ = access.begin("op", user("operate"))
    clock.now_s += IDLE_S
    assert access.asker(token) is None
    token, _ = access.begin("op", user("operate"))
    access.log_out(token)
    assert access.asker(token) is None


def test_a_user_who_is_taken_out_or_given_another_role_has_no_old_rights(access: Access, tmp_path: Path) -> None:
    tokens = [access.begin("op", user("operate"))[0], access.begin("ann", user("watch"))[0]]
    write_users(tmp_path / "users", {"op": user("watch")})
    assert [access.asker(token) for token in tokens] == [None, None]
    assert access.asker(access.begin("op", user("watch"))[0]) == Asker("op", "watch")
    (tmp_path / "users").unlink()
    assert access.asker(access.begin("op", user("watch"))[0]) is None


@pytest.mark.parametrize("role", ["operate", "watch"])  # of whom is asked for, the same as at the login or not
def test_a_logout_ends_a_login_that_is_just_being_used(
    access: Access, role: Role, monkeypatch: pytest.MonkeyPatch
) -> None:
    token, _ = access.begin("op", user("operate"))

    def logged_out_meanwhile(_: str) -> User:
        access.log_out(token)
        return user(role)

    with monkeypatch.context() as patch:
        patch.setattr(access, "_user", logged_out_meanwhile)
        access.asker(token)
    assert access.asker(token) is None


@pytest.mark.parametrize("token", [None, "", "x", "é", "a" * 100_000])
def test_what_is_no_token_is_nobody(access: Access, token: str | None) -> None:
    assert access.asker(token) is None


def test_tokens_are_kept_as_digests_and_only_so_many(access: Access) -> None:
    tokens = [access.begin("ann", user("watch"))[0] for _ in range(MOST_TOKENS + 1)]
    assert access.asker(tokens[0]) is None
    assert access.asker(tokens[-1]) is not None
    kept = repr(vars(access))
    assert tokens[-1] not in kept
    assert hashlib.sha256(tokens[-1].encode()).hexdigest() in kept


def test_who_logs_in_again_and_again_ends_nobody_elses_login(access: Access) -> None:
    token, _ = access.begin("op", user("operate"))
    tokens = [access.begin("ann", user("watch"))[0] for _ in range(2 * MOST_TOKENS)]
    assert access.asker(token) is not None
    assert [access.asker(each) is not None for each in (tokens[0], tokens[-1])] == [False, True]


async def test_guesses_are_slowed_down_by_user_and_by_address(
    access: Access, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []

    def fits(_: User | None, password: str) -> bool:
        looked.append(password)
        return password == PASSWORD

    monkeypatch.setattr("fdhil.web.access.verify_password", fits)
    for k in range(FREE_GUESSES):
        with pytest.raises(Refused, match="wrong name or password"):
            await access.log_in("op", f"guess {k}", "192.0.2.1")
    with pytest.raises(Refused, match="too many logins failed") as told:
        await access.log_in("ann", PASSWORD, "192.0.2.1")  # the same place, another user
    assert told.value.status == 429
    assert len(looked) == FREE_GUESSES  # a refused one costs nothing
    with pytest.raises(Refused, match="wrong name or password"):
        await access.log_in("op", "guess", "192.0.2.2")  # elsewhere, the same user: one guess, and no more
    with pytest.raises(Refused, match="too many"):
        await access.log_in("op", "guess", "192.0.2.2")
    clock.now_s += LONGEST_WAIT_S
    await access.log_in("op", PASSWORD, "192.0.2.2")
    await access.log_in("op", PASSWORD, "192.0.2.2")  # and all is forgotten


async def test_a_name_that_there_is_not_costs_as_much_as_a_wrong_password(
    access: Access, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashes: list[int] = []
    real = hashlib.scrypt

    def counted(password: bytes, **settings: Any) -> bytes:
        hashes.append(settings["n"])
        return real(password, **settings)

    monkeypatch.setattr("hashlib.scrypt", counted)
    told = []
    for name in ("op", "nobody"):
        with pytest.raises(Refused) as refused:
            await access.log_in(name, "a wrong one", "127.0.0.1")
        told.append(refused.value.document)
    assert told[0] == told[1]
    assert hashes[0] == hashes[1] == 2**15


async def test_a_stranger_does_not_lock_out_who_has_logged_in_where_he_is(
    access: Access, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.access.verify_password", lambda _, password: password == PASSWORD)
    await access.log_in("op", PASSWORD, "192.0.2.1")
    for k in range(FREE_GUESSES):
        with pytest.raises(Refused, match="wrong name or password"):
            await access.log_in("op", "a guess", f"198.51.100.{k}")
    await access.log_in("op", PASSWORD, "198.51.100.77")  # where he never was, and nobody guessed
    await access.log_in("op", PASSWORD, "192.0.2.1")
    for _ in range(FREE_GUESSES):
        with pytest.raises(Refused, match="wrong name or password"):
            await access.log_in("op", "a guess", "192.0.2.1")
    with pytest.raises(Refused, match="too many"):
        await access.log_in("op", PASSWORD, "192.0.2.1")  # but where he is it is guessed no faster than elsewhere


async def test_a_guess_from_each_of_many_addresses_locks_nobody_out(
    access: Access, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.access.verify_password", lambda _, password: password == PASSWORD)

    async def guess(k: int) -> str:
        try:
            await access.log_in("op", "a guess", f"198.51.{k // 100}.{k % 100}")
        except Refused as refused:
            return str(refused.document["code"])
        return "in"

    for _ in range(6):
        guesses = [asyncio.create_task(guess(k)) for k in range(183)]
        await asyncio.sleep(0)
        await access.log_in("op", PASSWORD, "192.0.2.9")
        assert set(await asyncio.gather(*guesses)) <= {"AuthRequired", "TooMany"}
        access._places.clear()  # as after a restart


async def test_passwords_are_checked_in_order_of_wrong_ones_and_one_who_leaves_delays_nobody() -> None:
    turns, order = Turns(), list[str]()

    async def check(place: str, wrong: int) -> None:
        async with turns.turn(place, wrong):
            order.append(f"{place} {wrong}")
            await asyncio.sleep(0)

    waiting = [("a", 9), ("f", 5), ("b", 5), ("c", 3), ("d", 4), ("e", 2), ("b", 5), ("a", 0)]
    tasks = [asyncio.create_task(check(*each)) for each in waiting]
    await asyncio.sleep(0)
    tasks[5].cancel()
    results = await asyncio.gather(*tasks, return_exceptions=True)
    assert order == ["a 9", "a 0", "c 3", "d 4", "b 5", "f 5"]
    assert [type(result) for result in results if result] == [Refused, asyncio.CancelledError]  # the older one of b


async def test_one_computer_is_one_place_however_many_addresses_it_has(
    access: Access, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.access.verify_password", lambda *_: False)
    for k in range(FREE_GUESSES):
        with pytest.raises(Refused, match="wrong name or password"):
            await access.log_in(f"name{k}", "a guess", f"2001:db8::{k}")
    with pytest.raises(Refused, match="too many"):
        await access.log_in("another", "a guess", "2001:db8::ffff")
    with pytest.raises(Refused, match="wrong name or password"):
        await access.log_in("another", "a guess", "2001:db8:0:1::1")
    assert place_of("::ffff:192.0.2.1") == "192.0.2.1"
