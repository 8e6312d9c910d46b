"""A real mosquitto broker as a process, optionally with TLS and passwords."""

from __future__ import annotations

import asyncio
import datetime
import ipaddress
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

COMMAND = shutil.which("mosquitto") or "/usr/sbin/mosquitto"


def open_to_all(port: int) -> str:
    return f"listener {port} 127.0.0.1\nallow_anonymous true\n"


def guarded(folder: Path, port: int, user: str, password: str) -> str:
    certify(folder)
    subprocess.run(["mosquitto_passwd", "-b", "-c", folder / "passwords", user, password], check=True)
    (folder / "passwords").chmod(0o700)
    files = f"cafile {folder}/ca.pem\ncertfile {folder}/broker.pem\nkeyfile {folder}/broker.key\n"
    own_user = "user root\n"  # else mosquitto cannot read the files of a test that runs as root
    who = f"require_certificate true\nallow_anonymous false\npassword_file {folder}/passwords\n"
    return f"{own_user}listener {port} 127.0.0.1\n{files}{who}"


@asynccontextmanager
async def broker(folder: Path, configuration: str, port: int) -> AsyncIterator[None]:
    file = folder / "mosquitto.conf"
    file.write_text(configuration)
    with (folder / "mosquitto.log").open("ab") as log:
        process = await asyncio.create_subprocess_exec(COMMAND, "-c", file, stdout=log, stderr=log)
    try:
        await _listening(process, port)
        yield
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()


async def _listening(process: asyncio.subprocess.Process, port: int) -> None:
    async with asyncio.timeout(60):
        while process.returncode is None:
            try:
                _, writer = await asyncio.open_connection("127.0.0.1", port)
            except OSError:
                await asyncio.sleep(0.02)
                continue
            writer.close()
            return
    raise AssertionError("mosquitto has ended")


def certify(folder: Path) -> None:
    ca_key, ca_name = ec.generate_private_key(ec.SECP256R1()), _named("test works")
    ca = _signed(ca_name, ca_name, ca_key, ca_key, x509.BasicConstraints(ca=True, path_length=None))
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    (folder / "ca.pem").write_bytes(ca.public_bytes(pem))
    local = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    for name in ("broker", "client"):
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _signed(_named(name), ca_name, key, ca_key, local)
        (folder / f"{name}.pem").write_bytes(certificate.public_bytes(pem))
        (folder / f"{name}.key").write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain))


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])


def _signed(
    name: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    issuer_key: ec.EllipticCurvePrivateKey,
    *more: x509.ExtensionType,
) -> x509.Certificate:
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
    )
    for extension in more:
        builder = builder.add_extension(extension, critical=isinstance(extension, x509.BasicConstraints))
    return builder.sign(issuer_key, hashes.SHA256())
