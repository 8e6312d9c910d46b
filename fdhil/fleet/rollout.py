"""Offers a change to machines stage by stage: the first few, then more, when those before them have it and stand well.

A person opens each stage, and is shown what the machines before have told. Each stage is a document of its own, signed
for its machines by name.
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

from fdhil.config.fleet import Fleet
from fdhil.config.reading import checked, checked_as, load_as
from fdhil.config.section import Section
from fdhil.config.uplink import Label, Labels
from fdhil.errors import ConfigError, ConfigFault, ConnectError
from fdhil.fleet import delivery, migrations
from fdhil.fleet.offer import Change, Offer, OfferRefused, sign
from fdhil.fleet.sets import unreachable
from fdhil.fleet.transport import ERRORS, cause_of, connected

DAY_S = 86_400
WAITS = "OfferWaits"  # the notice that an offer lies there: it speaks against none
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
    """A change as a person at the works writes it: ``set`` has the tables of a machine's configuration."""

    name: str
    version: int
    text: Label
    valid_days: int = Field(30, ge=1, le=366)
    labels: Labels = Field(default_factory=dict)
    axis_labels: Labels = Field(default_factory=dict)
    set: Mapping[str, Any]

    @property
    def change(self) -> Mapping[str, Any]:
        """The same with the values by their keys."""
        told = {name: getattr(self, name) for name in ("name", "version", "text", "labels", "axis_labels")}
        return {**told, "values": _flat(self.set)}


def _flat(tables: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in tables.items():
        found |= _flat(value, f"{place}{key}.") if isinstance(value, dict) else {f"{place}{key}": value}
    return found


@dataclass(frozen=True, slots=True)
class Told:
    """What a machine to which a change was offered has told of it; ``against`` is why no further stage is opened."""

    machine: str
    stage: int
    answer: str
    answered_by: str
    reason: str
    in_use: bool
    notices: int

    @property
    def against(self) -> str:
        """Why others should not be offered it yet; empty: nothing."""
        if self.answer == "rejected":
            return f"rejected by {self.answered_by}: {self.reason}"
        if self.answer != "accepted":
            return "no answer yet"
        if self.notices:
            return f"{self.notices} notices since it was accepted"
        return "" if self.in_use else "accepted, but nothing was identified with it yet"


@dataclass(frozen=True, slots=True)
class Standing:
    """How far a change is rolled out: the machines that it was offered to, and those that are left."""

    offered: Sequence[Told]
    left: Sequence[str]

    @property
    def stage(self) -> int:
        """The newest stage that was opened; 0: none."""
        return max((each.stage for each in self.offered), default=0)


def read_change(path: Path) -> tuple[Change, int]:
    """Return the change that a file says, and how many days it is valid; ConfigError."""
    file = load_as(ChangeFile, path, "a change to offer")
    return checked_as(Change, file.change, str(path)), file.valid_days


def offer_of(change: Change, days: int, by: str, stage: int, machines: Sequence[str]) -> Offer:
    """Return the offer of a change to these machines; ConfigError."""
    now_s = int(time.time())
    told = {**change.model_dump(), "stage": stage, "machines": machines, "by": by}
    return checked(Offer, {**told, "made_s": now_s, "expires_s": now_s + days * DAY_S}, change.name)


@asynccontextmanager
async def entered(fleet: Fleet) -> AsyncIterator[Db]:
    """Enter the database, its tables up to date; ConnectError where it cannot be entered."""
    try:
        way = fleet.database.connection
        async with await psycopg.AsyncConnection.connect(way, row_factory=dict_row, autocommit=True) as db:
            await migrations.bring_up(db)
            yield db
    except psycopg.Error as error:
        raise unreachable(error) from None


async def standing(db: Db, change: Change) -> Standing:
    """Return how far a change is; OfferRefused where its version is another change's, or an old one."""
    of = {"name": change.name, "version": change.version, "waits": WAITS}
    query = "SELECT version, change FROM fleet.offers WHERE name = %(name)s ORDER BY version DESC LIMIT 1"
    newest = await (await db.execute(query, of)).fetchone()
    if newest is not None:
        _require_new(change, newest["version"], newest["change"])
    rows = await (await db.execute(_OFFERED, of)).fetchall()
    offered = [
        Told(
            row["machine"], row["stage"], row["answer"] or "", row["answered_by"] or "", row["reason"] or "",
            row["in_use"], row["notices"],
        )
        for row in rows
    ]  # fmt: skip
    known = {each.machine for each in offered}
    query = "SELECT machine, about FROM fleet.machines ORDER BY machine"
    machines = [row for row in await (await db.execute(query)).fetchall() if _has(row["about"], change.labels)]
    return Standing(offered, [row["machine"] for row in machines if row["machine"] not in known])


def _require_new(change: Change, version: int, digest: str) -> None:
    if change.version < version:
        text = f"version {version} of {change.name} was offered already, and machines take no older one"
        raise OfferRefused(f"{text}; give the file version {version + 1}")
    if change.version == version and change.digest != digest:
        text = f"version {version} of {change.name} was offered with other values, labels or words"
        raise OfferRefused(f"{text}; give the file version {version + 1}")


def _has(about: Mapping[str, Any] | None, labels: Mapping[str, str]) -> bool:
    return labels.items() <= ((about or {}).get("labels") or {}).items()


def chosen(found: Standing, count: int | None, names: Sequence[str], despite: str) -> list[str]:
    """Return the machines of the next stage; OfferRefused where a machine before speaks against it."""
    against = [f"{each.machine}: {each.against}" for each in found.offered if each.against]
    if against and not despite:
        text = "the machines of the stages before do not all have it and stand well"
        raise OfferRefused(
            f"{text} ({'; '.join(against[:5])}); wait, or give the reason to go on all the same: --despite"
        )
    unknown = sorted(set(names) - set(found.left))
    if unknown:
        raise OfferRefused(f"{', '.join(unknown)}: not known with these labels, or offered it already; see the list")
    machines = list(dict.fromkeys(names)) or list(found.left[:count])
    if not machines:
        raise OfferRefused("there is no machine left with these labels")
    return machines


async def open_stage(fleet: Fleet, db: Db, offer: Offer, change: Change, key: Path, despite: str) -> bytes:
    """Sign an offer, keep it, and publish it to its machines; nothing is kept where that fails. ConnectError."""
    document = sign(offer, key)
    values = (offer.name, offer.version, offer.stage, change.digest, list(offer.machines), offer.by, despite, document)
    try:
        async with db.transaction(), connected(fleet.server, "fdhil-offers", "server") as client:
            await db.execute(
                "INSERT INTO fleet.offers (name, version, stage, change, machines, opened_by, despite, document)"
                " VALUES (%s, %s, %s, %s, %s, %s, %s, %s)",
                values,
            )
            stream = client.jetstream()
            await delivery.prepare(stream, fleet.stream.replicas)
            for machine in offer.machines:
                await delivery.publish(stream, machine, document, offer)
    except psycopg.errors.UniqueViolation:
        fault = ConfigFault(str(offer), f"stage {offer.stage} was opened by somebody else just now", "look again")
        raise ConfigError("fleet", [fault]) from None
    except ERRORS as error:
        raise ConnectError("NATS server", f"{cause_of(error)}; the stage was not opened, try again") from None
    return document


async def take_back(fleet: Fleet, found: Standing, name: str) -> list[str]:
    """Withdraw a change from the machines that have not accepted it, and return them. ConnectError."""
    machines = [each.machine for each in found.offered if each.answer != "accepted"]
    try:
        async with connected(fleet.server, "fdhil-offers", "server") as client:
            for machine in machines:
                await delivery.withdraw(client.jetstream(), machine, name)
    except ERRORS as error:
        raise ConnectError("NATS server", f"{cause_of(error)}; try again, it may lie at some machines yet") from None
    return machines
