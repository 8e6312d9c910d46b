"""Sets certificates and user of an OPC UA client, where they are configured.

Key and password are read at every connection, and appear in no message.
"""

from pathlib import Path

from asyncua import Client
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties, load_certificate, x509

from fdhil.config import OpcUaNc
from fdhil.errors import ConnectError

SECTION = "nc_source.opcua"


async def set_up_security(client: Client, settings: OpcUaNc, name: str) -> None:
    """Set the client's user and certificate; ConnectError names an unusable file."""
    if settings.user is not None and settings.password_file is not None:
        client.set_user(settings.user)
        client.set_password(
            _read_file("password_file", settings.password_file, name).decode("utf-8", "replace").strip()
        )
    if settings.certificate is None or settings.private_key is None:
        return
    files = {key: getattr(settings, key) for key in ("certificate", "private_key", "server_certificate")}
    own = {key: _describe_certificate(_read_file(key, path, name)) for key, path in files.items() if path is not None}
    try:
        client.application_uri = await _read_application_uri(own["certificate"]) or client.application_uri
        await client.set_security(
            SecurityPolicyBasic256Sha256,
            own["certificate"],
            own["private_key"],
            server_certificate=own.get("server_certificate"),
        )
    except (ValueError, TypeError) as error:
        raise _make_file_error(name, "certificate", f"cannot be used with its key: {str(error)[:100]}") from None


def _read_file(key: str, path: Path, name: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _make_file_error(name, key, f"{path} cannot be read: {error.strerror}") from None


def _describe_certificate(content: bytes) -> CertProperties:
    """Return a certificate or a key with its encoding, which asyncua only derives from a file name."""
    return CertProperties(content, "pem" if b"-----BEGIN" in content else "der")


async def _read_application_uri(certificate: CertProperties) -> str | None:
    """Return the certificate's URI: a server compares it with the client's own."""
    try:
        extensions = (await load_certificate(certificate.path_or_content, certificate.extension)).extensions
        names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None
    uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    return str(uris[0]) if uris else None


def _make_file_error(name: str, key: str, what: str) -> ConnectError:
    return ConnectError(name, f"{SECTION}.{key} {what}; fdhil's user must be able to read it")
