"""Manages logins: users, expiring tokens, and throttling of password guesses. Independent of HTTP.

A token is 256 random bits that exist in this process alone, stored as their SHA-256; a restart ends every login.
"""

import asyncio
import hashlib
import ipaddress
import itertools
import math
import secrets
import time
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

from fdhil.config import LONGEST_PASSWORD, Role, User, UsersFile, verify_password
from fdhil.web.fault_responses import RequestRefused

LIFE_S = 12 * 3600.0
IDLE_S = 3600.0
MOST_TOKENS = 256
FREE_GUESSES = 5
LONGEST_WAIT_S = 300.0
FORGET_S = 3600.0
MOST_GUESSERS = 4096
MOST_PLACES = 1024


@dataclass(frozen=True, slots=True)
class Principal:
    """A client: its user name, empty for a local one that need not log in, and its role."""

    name: str
    role: Role


@dataclass(slots=True)
class LoginSession:
    """A login: its client, and its end on the monotonic clock. ``user`` is the users file's entry at login."""

    principal: Principal
    user: User
    ends_s: float
    idle_ends_s: float


class LoginThrottle:
    """Counts wrong passwords by user and by address; each one beyond five doubles the wait."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def compute_wait_s(self, key: str) -> float:
        """Return the time until the next attempt is allowed; 0 if it is."""
        wait_s = min(LONGEST_WAIT_S, 2.0 ** min(60, self.count_failures(key) - FREE_GUESSES))
        return (
            max(0.0, self._find_last_failure_s(key) + wait_s - self._now_s())
            if self.count_failures(key) >= FREE_GUESSES
            else 0.0
        )

    def count_failures(self, key: str) -> int:
        """Return how many passwords were wrong in the last hour."""
        return self._wrong[key][0] if self._now_s() - self._find_last_failure_s(key) < FORGET_S else 0

    def _find_last_failure_s(self, key: str) -> float:
        return self._wrong.get(key, (0, -math.inf))[1]

    def add_failure(self, *keys: str) -> None:
        now_s = self._now_s()
        for key in keys:
            count = self.count_failures(key) + 1
            self._wrong.pop(key, None)
            self._wrong[key] = (count, now_s)
            while len(self._wrong) > MOST_GUESSERS:
                self._wrong.popitem(last=False)

    def clear_failures(self, *keys: str) -> None:
        for key in keys:
            self._wrong.pop(key, None)


@dataclass(eq=False, slots=True)
class WaitingLogin:
    """A login waiting for its password check: the fewest wrong passwords first, then the newest."""

    order: tuple[int, int]
    turn: asyncio.Event = field(default_factory=asyncio.Event)


class PasswordQueue:
    """Checks one password at a time, since a check takes a tenth of a second and 32 MiB.

    Addresses with the fewest wrong passwords come first, and the newest among them, so that a flood of first guesses
    delays no user. Of an address only the newest login waits: the connection of an older one may have ended.
    """

    def __init__(self) -> None:
        self._line: dict[str, WaitingLogin] = {}
        self._arrivals = itertools.count()
        self._checked: WaitingLogin | None = None

    @asynccontextmanager
    async def wait_for_turn(self, place: str, wrong: int) -> AsyncIterator[None]:
        """Wait for a turn after ``wrong`` wrong passwords from an address; Refused if a newer login came from it."""
        own, older = WaitingLogin((wrong, -next(self._arrivals))), self._line.get(place)
        if older is not None:
            older.turn.set()  # it is refused, unless already checked
        self._line[place] = own
        self._begin_next()
        try:
            await own.turn.wait()
            if self._line.get(place) is not own:
                raise _make_throttle_error(1.0)
            yield
        finally:
            if self._line.get(place) is own:
                del self._line[place]
            if self._checked is own:
                self._checked = None
            self._begin_next()

    def _begin_next(self) -> None:
        if self._checked is None and self._line:
            self._checked = min(self._line.values(), key=lambda each: each.order)
            self._checked.turn.set()


def _make_throttle_error(wait_s: float) -> RequestRefused:
    text = "too many logins failed or are waiting; this one was not checked"
    return RequestRefused(429, "TooMany", text, f"try again in {max(1.0, wait_s):.0f} s")


class LoginManager:
    """The users of one machine and their logins."""

    def __init__(self, users_file: Path | None, now_s: Callable[[], float] = time.monotonic) -> None:
        """Read the users, so that a faulty file is reported at start. Raises ConfigError."""
        self._users_file = UsersFile(users_file) if users_file else None
        self._now_s = now_s
        self._sessions: OrderedDict[str, LoginSession] = OrderedDict()
        self._guesses = LoginThrottle(now_s)
        # users by network of their logins: guesses from elsewhere do not lock them out
        self._places: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._turns = PasswordQueue()

    @property
    def needs_login(self) -> bool:
        """Whether there are users; without them every client may read, and none may act."""
        return self._users_file is not None

    def _find_user(self, name: str) -> User | None:
        return self._users_file.find_user(name) if self._users_file else None

    async def log_in(self, name: str, password: str, address: str) -> tuple[str, LoginSession]:
        """Return a new token and its session; Refused for a wrong name or password, or after too many.

        An address without a wrong password is checked, and first: guesses from elsewhere lock out no user.
        """
        place = find_client_network(address)
        of_place = f"address {place}"
        keys = (f"user {name[:64]} {place if (name, place) in self._places else ''}", of_place)
        wrong = self._guesses.count_failures(of_place)
        wait_s = max(map(self._guesses.compute_wait_s, keys)) if wrong or (name, place) in self._places else 0.0
        if wait_s > 0:
            raise _make_throttle_error(wait_s)
        async with self._turns.wait_for_turn(place, wrong):
            user = await asyncio.to_thread(self._find_user, name)
            fits = await asyncio.to_thread(verify_password, user, password[: LONGEST_PASSWORD + 1])
        if user is None or not fits:
            self._guesses.add_failure(*keys)
            raise RequestRefused(
                401, "AuthRequired", "wrong name or password", "check both; fdhil web-user sets a new password"
            )
        self._guesses.clear_failures(*keys)
        self._places[name, place] = None
        while len(self._places) > MOST_PLACES:
            self._places.popitem(last=False)
        return self.start_session(name, user)

    def start_session(self, name: str, user: User) -> tuple[str, LoginSession]:
        """Return a new token for a user; beyond the limit the user with the most logins loses the oldest."""
        token, now_s = secrets.token_urlsafe(32), self._now_s()
        session = LoginSession(Principal(name, user.role), user, now_s + LIFE_S, now_s + IDLE_S)
        self._sessions[_hash_token(token)] = session
        if len(self._sessions) > MOST_TOKENS:
            count = Counter(each.principal.name for each in self._sessions.values())
            del self._sessions[max(self._sessions, key=lambda key: count[self._sessions[key].principal.name])]
        return token, session

    def find_principal(self, token: str | None) -> Principal | None:
        """Return the client of a token; None if there is none, if it has expired, or if its user was changed.

        The lookup is by digest, so that its duration reveals nothing about the token.
        """
        if not self.needs_login:
            return Principal("", "watch")
        session = self._sessions.get(_hash_token(token)) if token else None
        now_s = self._now_s()
        if token is None or session is None:
            return None
        changed = self._find_user(session.principal.name) != session.user
        if changed or now_s >= min(session.ends_s, session.idle_ends_s):
            self.log_out(token)
            return None
        session.idle_ends_s = now_s + IDLE_S  # in place: storing it again would undo a concurrent logout
        return session.principal

    def log_out(self, token: str | None) -> None:
        """End a login; an unknown token is ignored."""
        self._sessions.pop(_hash_token(token or ""), None)


def find_client_network(address: str) -> str:
    """Return the network of an address: of IPv6 the /64, since one computer can use all of its addresses."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address):
        return str(ip.ipv4_mapped or ipaddress.IPv6Network((ip, 64), strict=False))
    return address


def _hash_token(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()
