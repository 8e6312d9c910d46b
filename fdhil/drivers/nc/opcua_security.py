"""Makes a connection to an OPC UA server one that is signed and encrypted, and one of a user, where the config says so.

The key and the password are read each time the server is entered, and are in no message.
"""

from pathlib import Path

from asyncua import Client
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties, load_certificate, x509

from fdhil.config.nc_clients import OpcUaNc
from fdhil.errors import ConnectError

SECTION = "nc_source.opcua"


async def secure(client: Client, settings: OpcUaNc, name: str) -> None:
    """Give the client its user and its certificate; ConnectError with the file that cannot be used."""
    if settings.user is not None and settings.password_file is not None:
        client.set_user(settings.user)
        client.set_password(_read("password_file", settings.password_file, name).decode("utf-8", "replace").strip())
    if settings.certificate is None or settings.private_key is None:
        return
    files = {key: getattr(settings, key) for key in ("certificate", "private_key", "server_certificate")}
    own = {key: _held(_read(key, path, name)) for key, path in files.items() if path is not None}
    try:
        client.application_uri = await _application_uri(own["certificate"]) or client.application_uri
        await client.set_security(
            SecurityPolicyBasic256Sha256,
            own["certificate"],
            own["private_key"],
            server_certificate=own.get("server_certificate"),
        )
    except (ValueError, TypeError) as error:
        raise _fault(name, "certificate", f"cannot be used with its key: {str(error)[:100]}") from None


def _read(key: str, path: Path, name: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _fault(name, key, f"{path} cannot be read: {error.strerror}") from None


def _held(content: bytes) -> CertProperties:
    """Return a certificate or a key with what it is written in: asyncua tells by the ending of a name alone."""
    return CertProperties(content, "pem" if b"-----BEGIN" in content else "der")


async def _application_uri(certificate: CertProperties) -> str | None:
    """Return the URI that the certificate is for: a server compares it with what the client calls itself."""
    try:
        extensions = (await load_certificate(certificate.path_or_content, certificate.extension)).extensions
        names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None
    uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    return str(uris[0]) if uris else None


def _fault(name: str, key: str, what: str) -> ConnectError:
    return ConnectError(name, f"{SECTION}.{key} {what}; fdhil's user must be able to read it")
