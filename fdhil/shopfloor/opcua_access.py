"""Limits who may connect to the OPC UA server, and to what: reading, browsing, subscribing.

Without a certificate the server accepts local clients only, without a login. With one, everything is signed and
encrypted. No client can write, call more than ConditionRefresh, or add a node.
"""

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import USER_TYPES, SimpleRoleRuleset, User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.uacrypto import x509
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.user_managers import UserManager

from fdhil.config import OpcUaServer, UsersFile, verify_password
from fdhil.config import User as KnownUser
from fdhil.errors import ConnectError
from fdhil.shopfloor.opcua_subscriptions import ReportedValues

NAME = "OPC UA server"
ANYONE = User(role=UserRole.Anonymous)
MOST_CONNECTIONS, MOST_AT_ONCE = 16, 64  # those beyond sixteen are being closed
ACTIVATION_S = 10.0  # for a client to log in
MOST_SUBSCRIPTIONS = 64
MOST_FAILURES, FAILURES_S = 10, 60.0
REFUSED = {ua.ObjectIds.WriteRequest_Encoding_DefaultBinary, ua.ObjectIds.HistoryReadRequest_Encoding_DefaultBinary}
POLICIES = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]
CHECKED = (
    CertificateValidatorOptions.TIME_RANGE
    | CertificateValidatorOptions.URI
    | CertificateValidatorOptions.TRUSTED
    | CertificateValidatorOptions.PEER_CLIENT
)


@dataclass
class OpcUaReader(User):
    """A logged-in user, with the users file's entry at that time."""

    known: KnownUser | None = None


class ReadOnlyRuleset(SimpleRoleRuleset):
    """Lets every user read, browse and subscribe, until the file removes or changes the user; nothing more."""

    def __init__(self, users: UsersFile | None = None) -> None:
        self._users = users
        self._permitted = {ua.NodeId(ua.Int32(kind)) for kind in USER_TYPES if kind not in REFUSED}

    def check_validity(self, user: User, action_type_id: ua.NodeId, body: Any) -> bool:
        """Return whether a request of that type is served."""
        if (
            self._users is not None
            and isinstance(user, OpcUaReader)
            and self._users.find_user(user.name or "") != user.known
        ):
            return False
        return action_type_id in self._permitted


class OpcUaUserManager(UserManager):
    """Checks passwords; without a users file everybody is accepted, because then only local clients can connect.

    After ten wrong passwords in a minute from one address all logins from there are refused for the rest of it:
    guessing is slow, cheap to refuse, and locks out no other user.
    """

    def __init__(self, users: UsersFile | None) -> None:
        self.users = users
        self._failures: list[tuple[str, float]] = []  # address and time
        self.address = ""
        """Address of the client that logs in next."""

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
    ) -> User | None:
        """Return the user of a session; None: refused."""
        if self.users is None:
            return User(role=UserRole.User)
        now_s = time.monotonic()
        self._failures = [(address, at_s) for address, at_s in self._failures if now_s - at_s < FAILURES_S]
        failures = sum(address == self.address for address, _ in self._failures)
        if failures >= MOST_FAILURES or username is None or password is None:
            return None
        known = self.users.find_user(username)
        if verify_password(known, password):
            return OpcUaReader(role=UserRole.User, name=username, known=known)
        self._failures.append((self.address, now_s))
        return None


class ReadSession(InternalSession):
    """A client's session, which passes its address to the user manager, and each change to its client."""

    async def create_subscription(self, *given: Any, **named: Any) -> ua.CreateSubscriptionResult:
        """Create a subscription without items."""
        made = await super().create_subscription(*given, **named)
        subscription = self.subscription_service.subscriptions[made.SubscriptionId]
        subscription.monitored_item_srv = ReportedValues(subscription, self.aspace)
        return made

    def activate_session(self, *given: Any) -> Any:
        """Log the client in; no other session can interfere meanwhile."""
        peer: Any = self.name  # a client's address and port
        users = self.iserver.user_manager
        assert isinstance(users, OpcUaUserManager)
        users.address = str(peer[0]) if isinstance(peer, tuple) else ""
        return super().activate_session(*given)


class BoundedTransports(list[Any]):
    """The transports of all clients; above the limit the oldest of an address with more is closed, or the new one."""

    def append(self, new: Any) -> None:
        """Add a connection."""
        super().append(new)
        there = [each for each in self if not each.is_closing()]
        if len(there) > MOST_CONNECTIONS:
            count = Counter(map(_get_address, there))
            greedy = [each for each in there if count[_get_address(each)] > count[_get_address(new)]]
            (greedy or [new])[0].abort()


def _get_address(transport: Any) -> str:
    return str((transport.get_extra_info("peername") or ("",))[0])


class ReadOnlyServer(InternalServer):
    """An address space that registers no other servers: unauthenticated clients could fill its memory with them."""

    def __init__(self, settings: OpcUaServer) -> None:
        users = None if settings.users_file is None else UsersFile(settings.users_file)
        super().__init__(user_manager=OpcUaUserManager(users))
        self.bind_condition_methods = True
        self.allow_remote_admin = False
        self.max_connections, self.max_pending_activation_seconds = MOST_AT_ONCE, ACTIVATION_S
        self.asyncio_transports = BoundedTransports()
        self.max_subscriptions = MOST_SUBSCRIPTIONS
        taken: Any = (ua.UserNameIdentityToken,) if users is not None else (ua.AnonymousIdentityToken,)
        self.supported_tokens = taken

    def create_session(self, name: str, user: User = ANYONE, external: bool = False) -> InternalSession:
        """Return the session of a client."""
        return ReadSession(self, self.aspace, self.subscription_service, name, user=user, external=external)

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refuse to act as a discovery server."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


async def apply_security(server: Server, settings: OpcUaServer, uri: str) -> None:
    """Configure the server's certificate and URI; ConnectError with the file that cannot be used."""
    if settings.certificate_file is None or settings.private_key_file is None:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity], ReadOnlyRuleset())
        await server.set_application_uri(uri)
        return
    users = server.iserver.user_manager
    assert isinstance(users, OpcUaUserManager)
    server.set_security_policy(POLICIES, ReadOnlyRuleset(users.users))
    for key, load in (("certificate_file", server.load_certificate), ("private_key_file", server.load_private_key)):
        content = _read_file(key, getattr(settings, key))
        try:
            await load(content, format="pem" if b"-----BEGIN" in content else "der")
        except (ValueError, TypeError):
            raise _make_file_error(
                key, f"{getattr(settings, key)} cannot be used: it is invalid, or has a password"
            ) from None
    _check_pair(server, settings)
    await server.set_application_uri(_read_application_uri(server.iserver.certificate) or uri)
    if settings.trusted_clients is not None:
        server.iserver.certificate_validator = await _load_validator(settings.trusted_clients)


def _check_pair(server: Server, settings: OpcUaServer) -> None:
    if server.iserver.certificate.public_key() != server.iserver.private_key.public_key():
        raise _make_file_error(
            "private_key_file", f"{settings.private_key_file} is not the key of the certificate_file"
        )


async def _load_validator(folder: Path) -> CertificateValidator:
    if not any(path.suffix.lower() in (".der", ".pem") for path in folder.glob("*")):
        raise _make_file_error("trusted_clients", f"{folder} has no certificate whose name ends in .der or .pem")
    trusted = TrustStore([folder], [])
    try:
        await trusted.load()
    except (OSError, ValueError) as error:
        raise _make_file_error("trusted_clients", f"{folder} cannot be used ({str(error)[:100]})") from None
    return FolderValidator(CHECKED, trusted)


class FolderValidator(CertificateValidator):
    """Trusts the certificates that are in the folder when a client connects."""

    async def validate(self, cert: Any, app_description: Any) -> None:
        """Check a client's certificate; ServiceError."""
        assert self._trust_store is not None
        try:
            await self._trust_store.load()
        except (OSError, ValueError):  # no file is left, or one is being written
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted) from None
        await super().validate(cert, app_description)


def _read_application_uri(certificate: Any) -> str | None:
    """Return the URI in the certificate: a client compares it with the server's own."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None
    uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    return str(uris[0]) if uris else None


def _read_file(key: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _make_file_error(key, f"{path} cannot be read: {error.strerror}") from None


def _make_file_error(key: str, what: str) -> ConnectError:
    return ConnectError(NAME, f"[publish.opcua] {key}: {what}; nothing is served; correct the file or its permissions")
