"""Evaluates what an offer would change on this machine, and records the operator's answer.

Nothing is changed automatically: an offer stays in its folder until an operator accepts or rejects it by name. It is
evaluated again on acceptance; the new configuration replaces the old one atomically, and the old one is kept as a
backup next to it. A running daemon continues with the configuration that it has loaded.
"""

import copy
import fcntl
import hashlib
import os
import stat
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from fdhil import config as machine_config
from fdhil.config import (
    MachineConfig,
    NotEditable,
    edit_toml,
    find_unlikely_values,
    is_loosening,
    parse_config,
    parse_toml,
)
from fdhil.errors import ConfigError, OutputError, StoreError
from fdhil.fleet.guard_limits import derive_guard_limits
from fdhil.fleet.signed_offer import LARGEST, Offer, OfferRefused, read_offer
from fdhil.store import OfferDecision, add_decision, find_newest_accepted, list_offers, read_decisions, write_file

CAUSES = {
    "DiskFull": "the disk is full; free some space",
    "ReadOnlyStore": "its folder is not writable, or the disk is read-only; try with sudo",
}
AHEAD_S = 86_400.0  # tolerated lead of the fleet server's clock


@dataclass(frozen=True, slots=True)
class ValueChange:
    """One value that an offer changes on this machine."""

    path: str
    old: Any
    new: Any
    loosens: bool


@dataclass(frozen=True, slots=True)
class ReviewedOffer:
    """A document evaluated on this machine: ``wrong`` says why it cannot be accepted, empty: it can.

    ``text`` and ``config`` are the configuration after the change; without changes, the present one.
    """

    place: Path
    document: str
    offer: Offer | None
    wrong: str
    answers: Sequence[OfferDecision] = ()
    changes: Sequence[ValueChange] = ()
    text: str = ""
    config: MachineConfig | None = None
    doubts: Sequence[str] = ()
    of_guard: Sequence[ValueChange] = ()

    @property
    def loosened_values(self) -> Sequence[ValueChange]:
        """Changes that relax a limit: keys, and the resulting limits of the guard."""
        return [each for each in (*self.changes, *self.of_guard) if each.loosens]


@dataclass(frozen=True, slots=True)
class CurrentMachine:
    """The machine at present: its configuration file and content, its answers, the newest version of each offer."""

    file: Path
    raw: bytes
    config: MachineConfig
    answers: Sequence[OfferDecision]
    newest: Mapping[str, int]
    now_s: float

    @property
    def labels(self) -> Mapping[str, str]:
        """The labels by which the machine is compared with others."""
        return self.config.uplink.labels if self.config.uplink else {}

    def select_axes(self, labels: Mapping[str, str]) -> list[str]:
        """Return the axes that have all these labels."""
        own = self.config.uplink.axis_labels if self.config.uplink else {}
        return [axis for axis in self.config.axis if labels.items() <= dict(own.get(axis, {})).items()]


def load_current_machine(file: Path, now_s: float | None = None) -> CurrentMachine:
    """Load the machine of a configuration; ConfigError, StoreError where its answers cannot be read."""
    config = machine_config.load_config(file)
    raw, answers = file.read_bytes(), read_decisions(config.store.directory)
    return CurrentMachine(
        file, raw, config, answers, _find_newest_versions(config), time.time() if now_s is None else now_s
    )


def _find_newest_versions(config: MachineConfig) -> Mapping[str, int]:
    newest: dict[str, int] = {}
    for place in list_offers(config.offers_directory):
        with suppress(OfferRefused, OSError):
            offer = read_offer(_read_document(place), config.offers.trust)
            newest[offer.name] = max(offer.version, newest.get(offer.name, 0))
    return newest


def _read_document(place: Path) -> bytes:
    """Return a file's content, limited to one byte more than an offer may have; OfferRefused for a special file."""
    descriptor = os.open(place, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # opening a pipe would block
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OfferRefused("it is not a regular file; export it again")
        return os.read(descriptor, LARGEST + 1)
    finally:
        os.close(descriptor)


def review_offer(place: Path, machine: CurrentMachine) -> ReviewedOffer:
    """Evaluate the document of a file; OSError where it cannot be read."""
    judged = ReviewedOffer(place, "", None, "")
    try:
        document = _read_document(place)
        judged = replace(judged, document=hashlib.sha256(document).hexdigest())
        offer = read_offer(document, machine.config.offers.trust)
        key = (offer.name, offer.version)
        judged = replace(
            judged, offer=offer, answers=[each for each in machine.answers if (each.name, each.version) == key]
        )
        _require_current_version(offer, machine)
        _require_addressed(offer, machine)
        evaluated = _evaluate_changes(judged, offer, machine)
        _require_same_values(evaluated)
        return evaluated
    except OfferRefused as error:
        return replace(judged, wrong=str(error))


def _require_same_values(judged: ReviewedOffer) -> None:
    """Refuse a version that was accepted with other values: a version is one change, at every stage."""
    accepted = [each for each in judged.answers if each.answer == "accepted"]
    if judged.changes and accepted and judged.document not in [each.document for each in accepted]:
        text = f"{judged.offer} was accepted with other values by {accepted[-1].by}, and a version never changes"
        raise OfferRefused(f"{text}; ask the fleet server for a newer version, and find out who signed this one")


def _require_current_version(offer: Offer, machine: CurrentMachine) -> None:
    day = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(offer.expires_s))
    if machine.now_s >= offer.expires_s:
        raise OfferRefused(f"it expired on {day}; ask the fleet server for a newer one")
    if offer.made_s > machine.now_s + AHEAD_S:
        raise OfferRefused("it is dated in the future of this PC's clock; set the clock")
    accepted = find_newest_accepted(machine.answers, offer.name)
    if offer.version < accepted:
        raise OfferRefused(f"version {accepted} was already accepted, and an older version cannot replace it")
    newest = machine.newest.get(offer.name, 0)
    if offer.version < newest:
        raise OfferRefused(f"version {newest} of the fleet server replaces it")


def _require_addressed(offer: Offer, machine: CurrentMachine) -> None:
    name = machine.config.plant_name
    if offer.machines and name not in offer.machines:
        raise OfferRefused(f"its stage {offer.stage} is not for {name}")
    for label, text in offer.labels.items():
        if machine.labels.get(label) != text:
            raise OfferRefused(
                f"it is for machines with label {label} = {text!r}; this machine's labels are in [uplink] labels"
            )


def _evaluate_changes(judged: ReviewedOffer, offer: Offer, machine: CurrentMachine) -> ReviewedOffer:
    values = dict(_resolve_values(offer, machine))
    document = copy.deepcopy(parse_toml(machine.raw, str(machine.file)))
    for path, value in values.items():
        _set_value(document, path, value)
    try:
        new = parse_config(document, str(offer), machine.file.parent)
        found = {path: (_get_value(machine.config, path), _get_value(new, path)) for path in values}
        changes = [ValueChange(p, old, now, is_loosening(p, old, now)) for p, (old, now) in found.items() if old != now]
        text = machine.raw.decode()
        if changes:
            text = edit_toml(text, {each.path: values[each.path] for each in changes}, str(offer))
    except ConfigError as error:
        raise OfferRefused(f"it would make the configuration invalid: {error}") from None
    except NotEditable as error:
        raise OfferRefused(f"{machine.file} cannot be edited by line: {error}") from None
    doubts = [text for text in find_unlikely_values(new) if text not in find_unlikely_values(machine.config)]
    of_guard = list(_find_loosened_limits(machine.config, new)) if changes else []
    return replace(judged, changes=changes, text=text, config=new, doubts=doubts, of_guard=of_guard)


def _find_loosened_limits(old: MachineConfig, new: MachineConfig) -> Iterator[ValueChange]:
    before = derive_guard_limits(old)
    for name, value in derive_guard_limits(new).items():
        if name not in before or value > before[name]:
            yield ValueChange(f"the guard: {name}", before.get(name), value, True)


def _resolve_values(offer: Offer, machine: CurrentMachine) -> Iterator[tuple[str, Any]]:
    for path, value in offer.values.items():
        top, _, rest = path.partition(".*.")
        paths = [f"{top}.{axis}.{rest}" for axis in machine.select_axes(offer.axis_labels)] if rest else [path]
        if not paths:
            raise OfferRefused("no axis of this machine has its labels; the labels are in [uplink] axis_labels")
        for each in paths:
            table = each.rpartition(".")[0]
            if _get_value(machine.config, table) is None:
                raise OfferRefused(f"this machine has no [{table}], which can only be enabled at the machine")
            yield each, value


def _get_value(found: Any, path: str) -> Any:
    for part in path.split("."):
        found = found.get(part) if isinstance(found, Mapping) else getattr(found, part, None)
    return found


def _set_value(document: dict[str, Any], path: str, value: Any) -> None:
    *outer, key = path.split(".")
    for name in outer:
        document = document.setdefault(name, {})
    document[key] = value


def accept_offer(place: Path, file: Path, by: str, may_loosen: bool) -> ReviewedOffer:
    """Write the configuration that an offer proposes, keep the old one as a backup, and record who accepted it.

    OfferRefused; OutputError where the configuration cannot be written: it is unchanged. StoreError where the answer
    cannot be recorded; accepting again then changes nothing and records it.
    """
    with _lock_folder(file):
        judged = review_offer(place, load_current_machine(file))
        if judged.wrong or judged.offer is None or judged.config is None:
            raise OfferRefused(f"{place.name} is not accepted: {judged.wrong}")
        if judged.loosened_values and not may_loosen:
            keys = "; ".join(each.path for each in judged.loosened_values)
            raise OfferRefused(f"{judged.offer} is not accepted: it loosens {keys}; add --loosens to accept that")
        if judged.changes:
            _replace_config(file, judged)
        if judged.changes or "accepted" not in [each.answer for each in judged.answers[-1:]]:
            _record_answer(judged, judged.config, "accepted", by, "")
        return judged


def reject_offer(place: Path, file: Path, by: str, reason: str) -> ReviewedOffer:
    """Record who rejected an offer, and why.

    OfferRefused where it was not signed by a trusted fleet server, or was accepted and is in force.
    """
    with _lock_folder(file):
        machine = load_current_machine(file)
        judged = review_offer(place, machine)
        if judged.offer is None:
            raise OfferRefused(f"{place.name}: {judged.wrong}")
        accepted = [each.by for each in judged.answers[-1:] if each.answer == "accepted"]
        if accepted and _is_in_force(judged, judged.offer, machine):
            advice = f"restore the previous values first; they are in {build_backup_path(file, judged.offer)}"
            text = f"{judged.offer} was accepted by {accepted[0]} and its values are in force"
            raise OfferRefused(f"{text}: it is not rejected; {advice}")
        _record_answer(judged, machine.config, "rejected", by, reason)
        return judged


def _is_in_force(judged: ReviewedOffer, offer: Offer, machine: CurrentMachine) -> bool:
    """Whether the configuration already has the offered values, even if the offer has expired."""
    try:
        return not _evaluate_changes(judged, offer, machine).changes
    except OfferRefused:
        return False


def build_backup_path(file: Path, offer: Offer) -> Path:
    """Return the path of the backup of the configuration before an offer."""
    return file.with_name(f"{file.name}.before-{offer.name}-{offer.version}")


def _replace_config(file: Path, judged: ReviewedOffer) -> None:
    assert judged.offer is not None
    file = file.resolve()
    old, new, like = file.read_bytes(), judged.text.encode(), file.stat()
    try:
        write_file(build_backup_path(file, judged.offer), old, like)
        write_file(file, new, like)
    except StoreError as error:
        state = "is unchanged" if file.read_bytes() == old else "is the new one, but may be lost in a power cut"
        cause = CAUSES.get(error.code, str(error))
        raise OutputError(f"{file} could not be written: {cause}; the configuration {state}") from None


def _record_answer(
    judged: ReviewedOffer, config: MachineConfig, answer: Literal["accepted", "rejected"], by: str, reason: str
) -> None:
    offer = judged.offer
    assert offer is not None
    document = judged.document
    noted = OfferDecision(
        offer.name, offer.version, offer.stage, document, answer, by, reason, time.time(), config.digest
    )
    add_decision(config.store.directory, noted)


@contextmanager
def _lock_folder(file: Path) -> Iterator[None]:
    """Lock the configuration's folder, so that of two concurrent answers the second sees the result of the first."""
    descriptor = os.open(file.resolve().parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            text = f"another command is answering an offer for {file}; nothing was changed. Try again when it has ended"
            raise OutputError(text) from None
        yield
    finally:
        os.close(descriptor)
