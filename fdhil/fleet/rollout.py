"""Rolls a change out in stages: first to few machines, then to more once the earlier ones use it without problems.

A person opens each stage and is shown the responses of the earlier machines. Each stage is a document of its own,
signed for its machines by name.
"""

import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg
from psycopg.rows import DictRow, dict_row
from pydantic import Field

from fdhil.config import Fleet, Label, Labels, Section, check_section, check_section_file, load_section_file
from fdhil.errors import ConfigError, ConfigFault, ConnectError
from fdhil.fleet import offer_delivery, schema_migrations
from fdhil.fleet.nats_transport import ERRORS, connect_to_server, describe_cause
from fdhil.fleet.parameter_sets import build_connect_error
from fdhil.fleet.signed_offer import Offer, OfferRefused, ProposedChange, sign_offer

DAY_S = 86_400
WAITS = "OfferWaits"  # the notice of a pending offer: it is no objection
Db = psycopg.AsyncConnection[DictRow]
_OFFERED = """
SELECT o.machine, o.stage, o.opened_at, a.answer, a.reason, a.answered_by, a.recorded_at AS answered_at,
  EXISTS (SELECT FROM fleet.parameter_sets p WHERE p.machine = o.machine AND p.config_digest = a.config_digest
          AND p.recorded_at > a.recorded_at) AS in_use,
  (SELECT count(*) FROM fleet.notices n WHERE n.machine = o.machine AND n.recorded_at > a.recorded_at
   AND n.severity <> 'info' AND n.code <> %(waits)s) AS notices
FROM (SELECT stage, opened_at, unnest(machines) AS machine, version FROM fleet.offers
      WHERE name = %(name)s AND version = %(version)s) o
LEFT JOIN LATERAL (SELECT * FROM fleet.offer_answers a WHERE a.machine = o.machine AND a.name = %(name)s
  AND a.version = o.version ORDER BY a.recorded_at DESC LIMIT 1) a ON true
ORDER BY o.stage, o.machine
"""


class ChangeFile(Section):
    """A change as written by a person: ``set`` has the tables of a machine's configuration."""

    name: str
    version: int
    text: Label
    valid_days: int = Field(30, ge=1, le=366)
    labels: Labels = Field(default_factory=dict)
    axis_labels: Labels = Field(default_factory=dict)
    set: Mapping[str, Any]

    @property
    def proposed_fields(self) -> Mapping[str, Any]:
        """The fields of the change, with the values by their keys."""
        fields = {name: getattr(self, name) for name in ("name", "version", "text", "labels", "axis_labels")}
        return {**fields, "values": _flatten_tables(self.set)}


def _flatten_tables(tables: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in tables.items():
        found |= _flatten_tables(value, f"{place}{key}.") if isinstance(value, dict) else {f"{place}{key}": value}
    return found


@dataclass(frozen=True, slots=True)
class MachineResponse:
    machine: str
    stage: int
    answer: str
    answered_by: str
    reason: str
    in_use: bool
    notices: int

    @property
    def objection(self) -> str:
        """Why no further stage should be opened; empty: no objection."""
        if self.answer == "rejected":
            return f"rejected by {self.answered_by}: {self.reason}"
        if self.answer != "accepted":
            return "no answer yet"
        if self.notices:
            return f"{self.notices} notices since it was accepted"
        return "" if self.in_use else "accepted, but no parameters were identified with it yet"


@dataclass(frozen=True, slots=True)
class RolloutStatus:
    """The progress of a roll-out: the machines it was offered to, and the remaining ones."""

    offered: Sequence[MachineResponse]
    remaining: Sequence[str]

    @property
    def stage(self) -> int:
        """The newest stage that was opened; 0: none."""
        return max((each.stage for each in self.offered), default=0)


def read_change(path: Path) -> tuple[ProposedChange, int]:
    """Return the change defined by a file, and its validity in days; ConfigError."""
    file = load_section_file(ChangeFile, path, "a change to offer")
    return check_section_file(ProposedChange, file.proposed_fields, str(path)), file.valid_days


def create_offer(change: ProposedChange, days: int, by: str, stage: int, machines: Sequence[str]) -> Offer:
    """Return the offer of a change to these machines; ConfigError."""
    now_s = int(time.time())

    fields = {**change.model_dump(), "stage": stage, "machines": machines, "by": by}
    return check_section(Offer, {**fields, "made_s": now_s, "expires_s": now_s + days * DAY_S}, change.name)


@asynccontextmanager
async def connect_database(fleet: Fleet) -> AsyncIterator[Db]:
    """Open the database with its tables up to date; ConnectError where that fails."""
    try:
        connection = fleet.database.connection
        async with await psycopg.AsyncConnection.connect(connection, row_factory=dict_row, autocommit=True) as db:
            await schema_migrations.upgrade_schema(db)
            yield db
    except psycopg.Error as error:
        raise build_connect_error(error) from None


async def read_rollout_status(db: Db, change: ProposedChange) -> RolloutStatus:
    """Return the progress of a change; OfferRefused where its version is another change's, or an old one."""

    arguments = {"name": change.name, "version": change.version, "waits": WAITS}
    query = "SELECT version, change FROM fleet.offers WHERE name = %(name)s ORDER BY version DESC LIMIT 1"
    newest = await (await db.execute(query, arguments)).fetchone()
    if newest is not None:
        _require_newer_version(change, newest["version"], newest["change"])
    rows = await (await db.execute(_OFFERED, arguments)).fetchall()
    offered = [
        MachineResponse(
            row["machine"], row["stage"], row["answer"] or "", row["answered_by"] or "", row["reason"] or "",
            row["in_use"], row["notices"],
        )
        for row in rows
    ]  # fmt: skip
    known = {each.machine for each in offered}
    query = "SELECT machine, about FROM fleet.machines ORDER BY machine"
    left = []
    for row in await (await db.execute(query)).fetchall():
        labels = (row["about"] or {}).get("labels") or {}
        if row["machine"] not in known and change.labels.items() <= labels.items():
            left.append(row["machine"])
    return RolloutStatus(offered, left)


def _require_newer_version(change: ProposedChange, version: int, digest: str) -> None:
    if change.version < version:
        text = f"version {version} of {change.name} was already offered, and machines accept no older one"
        raise OfferRefused(f"{text}; set version = {version + 1} in the file")
    if change.version == version and change.digest != digest:
        text = f"version {version} of {change.name} was offered with other values, labels or text"
        raise OfferRefused(f"{text}; set version = {version + 1} in the file")


def choose_machines(found: RolloutStatus, count: int | None, names: Sequence[str], despite: str) -> list[str]:
    """Return the machines of the next stage; OfferRefused where an earlier machine objects."""
    against = [f"{each.machine}: {each.objection}" for each in found.offered if each.objection]
    if against and not despite:
        text = "machines of earlier stages do not use it yet, or have problems"
        raise OfferRefused(f"{text} ({'; '.join(against[:5])}); wait, or give a reason to proceed: --despite")
    unknown = sorted(set(names) - set(found.remaining))
    if unknown:
        raise OfferRefused(f"{', '.join(unknown)}: no machine with these labels, or already offered; see the list")
    machines = list(dict.fromkeys(names)) or list(found.remaining[:count])
    if not machines:
        raise OfferRefused("no machine with these labels remains")
    return machines


async def open_stage(fleet: Fleet, db: Db, offer: Offer, change: ProposedChange, key: Path, despite: str) -> bytes:
    """Sign an offer, store it and publish it to its machines; nothing is stored where that fails. ConnectError."""
    document = sign_offer(offer, key)
    values = (offer.name, offer.version, offer.stage, change.digest, list(offer.machines), offer.by, despite, document)
    try:
        async with db.transaction(), connect_to_server(fleet.server, "fdhil-offers", "server") as client:
            await db.execute(
                "INSERT INTO fleet.offers (name, version, stage, change, machines, opened_by, despite, document)"
                " VALUES (%s, %s, %s, %s, %s, %s, %s, %s)",
                values,
            )
            stream = client.jetstream()
            await offer_delivery.prepare_offer_stream(stream, fleet.stream.replicas)
            for machine in offer.machines:
                await offer_delivery.publish_offer(stream, machine, document, offer)
    except psycopg.errors.UniqueViolation:
        fault = ConfigFault(
            str(offer), f"stage {offer.stage} was just opened by another user", "check the roll-out again"
        )
        raise ConfigError("fleet", [fault]) from None
    except ERRORS as error:
        raise ConnectError("NATS server", f"{describe_cause(error)}; the stage was not opened, try again") from None
    return document


async def withdraw_change(fleet: Fleet, found: RolloutStatus, name: str) -> list[str]:
    """Withdraw a change from the machines that have not accepted it, and return them. ConnectError."""
    machines = [each.machine for each in found.offered if each.answer != "accepted"]
    try:
        async with connect_to_server(fleet.server, "fdhil-offers", "server") as client:
            for machine in machines:
                await offer_delivery.withdraw_offer(client.jetstream(), machine, name)
    except ERRORS as error:
        raise ConnectError(
            "NATS server", f"{describe_cause(error)}; some machines may still have the offer, try again"
        ) from None
    return machines
