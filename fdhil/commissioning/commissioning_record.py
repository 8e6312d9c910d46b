"""Store the signed-off record of a commissioned drive as JSON; a modified record is refused.

It is sealed with a key that only its owner can read (mode 0600): without the key no record can be made. See
docs/decisions/0009-records-are-sealed.md for the limits of this protection.
"""

import contextlib
import hashlib
import hmac
import json
import os
import secrets
import stat
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from fdhil import tables
from fdhil.commissioning.void_mark import clear_void_mark, is_record_void, read_void_mark
from fdhil.config import Drive, MachineConfig
from fdhil.drivers import load_profile
from fdhil.errors import StoreError
from fdhil.store import make_folder, make_store_error, sync_folder, write_file

SCHEMA = "fdhil-commissioning-2"
UNSEALED = "fdhil-commissioning-1"
MAX_RECORD_BYTES = 64 * 1024
KEY_NAME = "commissioning.key"
KEY_BYTES = 32
SOFTWARE_LIMIT_KEYS = ("607D01", "607D02")


@dataclass(frozen=True, slots=True)
class CommissioningRecord:
    """Findings and proofs of one drive.

    ``config_digest`` is :func:`axis_digest`. ``options`` holds 0x6007, 0x605A, 0x605E, 0x6065, 0x6085 and 0x1017 by
    their hexadecimal index, if the drive has them, its software limits, and the COB-IDs of its RPDOs, see
    :attr:`rpdos`. ``offset_in_feedforward`` None: undetermined. ``watchdog`` is ``proven`` if the drive stopped after
    fdhil's heartbeat did.
    """

    axis: str
    vendor_id: int
    product_code: int
    revision: int
    serial: int
    config_digest: str
    mapping_fingerprint: str
    options: Mapping[str, int]
    following_error_window_um: float
    offset_in_feedforward: bool | None
    sign_test_um: float
    readback_ok: bool
    watchdog: str
    created_utc: str

    @property
    def travel(self) -> tuple[int, int] | None:
        """The drive's software limits in its own increments; None without limits."""
        low, high = (self.options.get(key) for key in SOFTWARE_LIMIT_KEYS)
        return None if low is None or high is None else (low, high)

    @property
    def rpdos(self) -> tuple[int, ...]:
        """COB-ID words of the RPDOs that the profile lacks, and of the feed-forward's."""
        return tuple(cob_id for key, cob_id in self.options.items() if is_rpdo_option(key))

    @property
    def fingerprint(self) -> str:
        """16 hexadecimal digits of the signed-off drive, which a comparison must reproduce."""
        who = (self.vendor_id, self.product_code, self.revision, self.serial)
        return compute_fingerprint(who, self.mapping_fingerprint, self.options)

    @property
    def digest(self) -> str:
        """SHA-256 of the record's content."""
        return hashlib.sha256(self._serialise_content()).hexdigest()

    def compute_seal(self, key: bytes) -> str:
        """Return the HMAC-SHA-256 of the record's content."""
        return hmac.new(key, self._serialise_content(), hashlib.sha256).hexdigest()

    def _serialise_content(self) -> bytes:
        return json.dumps({"schema": SCHEMA, **asdict(self)}, sort_keys=True).encode()


def is_rpdo_option(option: str) -> bool:
    """Return whether an option of a record is the COB-ID of one of a drive's 512 possible RPDOs (0x1400 to 0x15FF)."""
    return option[:2] in ("14", "15")


def compute_fingerprint(identity: Sequence[int], mapping_fingerprint: str, options: Mapping[str, int]) -> str:
    """Return 16 hexadecimal digits of SHA-256 over a drive's identity, PDOs and options (without RPDO COB-IDs)."""
    own = {key: value for key, value in options.items() if not is_rpdo_option(key)}
    text = json.dumps([list(identity), mapping_fingerprint, own], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def is_record_valid(record: CommissioningRecord | None, config: MachineConfig, axis: str) -> bool:
    """Return whether there is a record of this configuration that has not been voided."""
    return is_record_of_config(record, config, axis) and not is_record_void(config.store.directory, axis)


def is_record_of_config(record: CommissioningRecord | None, config: MachineConfig, axis: str) -> bool:
    """Return whether there is a record that was made with this configuration."""
    return record is not None and record.readback_ok and record.config_digest == compute_axis_digest(config, axis)


def compute_axis_digest(config: MachineConfig, axis: str) -> str:
    """Return 16 hexadecimal digits of SHA-256 over the configuration that a commissioning depends on.

    The sensors' connections, the motor's data sheet and the travel may change without commissioning again.
    """
    settings = config.axis[axis].model_dump(
        mode="json", exclude={"voltage", "nominal", "guessed", "regulators", "setpoints"}
    )
    if settings["feedforward"] is None:
        del settings["feedforward"]
    settings["drive"] = _describe_drive(config.axis[axis].drive)
    guard = config.guard.model_dump(mode="json", include={"node_id", "heartbeat_s"})
    text = json.dumps([settings, guard, config.machine.sync_period_s, config.get_node_id(axis)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _describe_drive(drive: Drive) -> dict[str, Any]:
    """Return the drive's configuration; a file counts by its content, wherever it is."""
    described = drive.model_dump(mode="json", exclude={"eds"})
    new = {
        "source": "canopen",
        "hal": None,
        "logical_axis": 1,
        "rated_torque_nm": 1.0,
        "dc_link_v": None,
        "speed_unit": None,
    }
    described = {key: value for key, value in described.items() if key not in new or value != new[key]}
    if drive.profile not in tables.DRIVE_PROFILES or drive.eds is not None:
        described["profile"] = repr(load_profile(drive))
    return described


def build_record_path(directory: Path, axis: str) -> Path:
    """Return the file of an axis' record."""
    return directory / f"commissioning-{axis}.json"


def save_record(record: CommissioningRecord, directory: Path, key: Path | None = None) -> Path:
    """Seal and write the record atomically and return its path; StoreError.

    ``key`` is the file of the sealing key, by default ``commissioning.key`` in the directory; a missing key is created.
    """
    path = build_record_path(directory, record.axis)
    try:
        make_folder(directory)
    except OSError as error:
        raise make_store_error(path, error) from None
    seal = record.compute_seal(load_sealing_key(key or directory / KEY_NAME))
    document = {"schema": SCHEMA, **asdict(record), "digest": record.digest, "seal": seal}
    write_file(path, json.dumps(document, indent=2).encode())
    clear_void_mark(directory, record.axis, read_void_mark(directory, record.axis))
    return path


def load_record(
    directory: Path, axis: str, key: Path | None = None, *, may_lack_key: bool = False
) -> CommissioningRecord | None:
    """Read an axis' record, None without one; StoreError if it is damaged, foreign, modified or not sealed.

    ``may_lack_key``: a caller without permission to read the key accepts the record by its digest alone; a caller that
    decides about the machine must be able to read the key.
    """
    path = build_record_path(directory, axis)
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            raw = file.read(MAX_RECORD_BYTES + 1) or b""  # None: a pipe without a writer
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StoreError(f"{path} cannot be read ({error.strerror}); commission the axis again") from None
    try:
        document = json.loads(raw[:MAX_RECORD_BYTES])
        record = None if document.get("schema") == UNSEALED else _parse_record(document)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise StoreError(f"{path} is not a commissioning record; commission the axis again") from None
    if record is None:
        raise StoreError(f"{path} predates sealed records; commission the axis again")
    if document.get("schema") != SCHEMA or record.axis != axis or document.get("digest") != record.digest:
        raise StoreError(f"{path} was modified after the sign-off; commission the axis again")
    secret = _read_key(key or directory / KEY_NAME, may_lack_key)
    given = str(document.get("seal")).encode("utf-8", "replace")
    if secret is not None and not hmac.compare_digest(given, record.compute_seal(secret).encode()):
        raise StoreError(f"{path} is not sealed with this machine's key; commission the axis again")
    return record


def load_sealing_key(path: Path) -> bytes:
    """Return the key that seals records; create it if missing. StoreError."""
    if not os.path.lexists(path):
        try:
            _make_key(path)
        except OSError as error:
            text = f"{path}, the key of the records, cannot be created ({error.strerror}); check folder and free space"
            raise StoreError(text) from None
    return _read_key(path, may_lack=False) or b""


def _make_key(path: Path) -> None:
    """Create a key atomically; a key that another process creates meanwhile is kept. OSError."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.unlink(missing_ok=True)  # left by a killed process
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_hex(KEY_BYTES).encode())
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileExistsError):
            path.hardlink_to(part)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def _read_key(path: Path, may_lack: bool) -> bytes | None:
    """Return the sealing key, None if it ``may_lack`` and cannot be read; StoreError if it is not secret."""
    advice = "delete it and commission every axis again"
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except PermissionError:
        if may_lack:
            return None
        raise StoreError(f"{path}, the key of the records, may not be read by this user; run as its owner") from None
    except OSError as error:
        text = f"{path}, the key of the records, cannot be read ({error.strerror}); commission every axis again"
        raise StoreError(text) from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or stat.S_IMODE(status.st_mode) & 0o077:
            raise StoreError(f"{path}, the key of the records, can be read by others; {advice}")
        raw = os.read(descriptor, 2 * KEY_BYTES + 2).strip()
    except OSError as error:
        raise StoreError(f"{path}, the key of the records, cannot be read ({error.strerror}); {advice}") from None
    finally:
        os.close(descriptor)
    if len(raw) != 2 * KEY_BYTES:
        raise StoreError(f"{path}, the key of the records, is damaged; {advice}")
    return raw


def _parse_record(document: Any) -> CommissioningRecord:
    values = {f.name: document[f.name] for f in fields(CommissioningRecord)}
    values["options"] = {str(key): int(value) for key, value in values["options"].items()}
    return CommissioningRecord(**values)
