"""Delivers offers from the fleet server to the machines, and the machines' answers back, by JetStream.

A stream keeps one message per machine with all offers that are open for it. ``fdhil uplink`` fetches that message once
a minute (a direct get; its user needs permission for its own subject only), stores the offers signed by a trusted key
in its folder, and removes those that were withdrawn. It never accepts an offer.
"""

import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import nats.js.errors
from nats.js import JetStreamContext
from nats.js.api import DiscardPolicy, Header, StorageType, StreamConfig

from fdhil.config import MachineConfig
from fdhil.daemon import write_line
from fdhil.errors import StoreError
from fdhil.fleet.nats_transport import ERRORS, describe_cause
from fdhil.fleet.record_message import Message, encode_answer
from fdhil.fleet.signed_offer import LARGEST, Offer, OfferRefused, read_offer
from fdhil.store import (
    OfferDecision,
    list_offers,
    make_file_name,
    make_folder,
    make_store_error,
    read_decisions,
    write_file,
)

STREAM = "fdhil-offers"
PREFIX = "fdhil.offers.v1"
FETCH_S = 60.0
MOST_OPEN = 20  # offers for one machine
MOST_BYTES = 1 << 30
TRIES = 5  # attempts when others publish at the same time


def build_subject(machine: str) -> str:
    """Return the subject whose last message contains the offers for a machine."""
    return f"{PREFIX}.{machine}"


def split_documents(message: bytes) -> Iterator[bytes]:
    """Yield the documents of a message: two lines each."""
    lines = message[: MOST_OPEN * LARGEST].split(b"\n")
    for first, second in zip(lines[0::2], lines[1::2], strict=False):
        yield first + b"\n" + second + b"\n"


# fleet server --------------------------------------------------------------------------------------------------


async def prepare_offer_stream(stream: JetStreamContext, replicas: int) -> None:
    """Create the stream of the offers if it does not exist; ERRORS."""
    wanted = StreamConfig(
        name=STREAM,
        subjects=[f"{PREFIX}.*"],
        max_msgs_per_subject=1,
        discard=DiscardPolicy.NEW,
        storage=StorageType.FILE,
        max_bytes=MOST_BYTES,
        num_replicas=replicas,
        allow_direct=True,
    )
    try:
        await stream.stream_info(STREAM)
    except nats.js.errors.NotFoundError:
        await stream.add_stream(wanted)


async def publish_offer(stream: JetStreamContext, machine: str, document: bytes, offer: Offer) -> None:
    """Add an offer to those open for a machine, replacing an older one of the same name; ERRORS."""
    await _replace_open_offers(stream, machine, offer.name, [document])


async def withdraw_offer(stream: JetStreamContext, machine: str, name: str) -> None:
    """Remove the named offer from those open for a machine; ERRORS."""
    await _replace_open_offers(stream, machine, name, [])


async def _replace_open_offers(stream: JetStreamContext, machine: str, name: str, new: list[bytes]) -> None:
    for _ in range(TRIES):
        sequence, before = await _fetch_open_offers(stream, machine)
        kept = [each for each in split_documents(before) if _is_still_open(each, name)][: MOST_OPEN - 1]
        headers = {Header.EXPECTED_LAST_SUBJECT_SEQUENCE.value: str(sequence)}
        try:
            await stream.publish(build_subject(machine), b"".join([*kept, *new]), headers=headers)
            return
        except nats.js.errors.APIError as error:
            if error.err_code != 10071:  # another publisher was faster
                raise
    raise nats.js.errors.Error(
        "other publishers keep changing this machine's offers; the offer was not published, try again"
    )


def _is_still_open(document: bytes, name: str) -> bool:
    """Whether an open offer is kept: expired ones, and those of this name, are dropped, whatever key signed them."""
    try:
        other = read_offer(document, {_read_signer(document)})
    except OfferRefused:
        return False
    return other.name != name and other.expires_s > time.time()


def _read_signer(document: bytes) -> str:
    words = document.partition(b"\n")[2].split(b" ")
    return words[1].decode("ascii", "replace") if len(words) > 1 else ""


async def _fetch_open_offers(stream: JetStreamContext, machine: str) -> tuple[int, bytes]:
    """Return the stream sequence and content of the offers open for a machine; ERRORS."""
    try:
        message = await stream.get_last_msg(STREAM, build_subject(machine), direct=True)
    except nats.js.errors.NotFoundError:
        return 0, b""
    return message.seq or 0, message.data or b""


# machine -------------------------------------------------------------------------------------------------------


class OfferFetcher:
    """Fetches the offers for a machine and returns its operator's answers; does nothing without [offers] trust."""

    def __init__(self, config: MachineConfig) -> None:
        self._config = config
        self._machine = config.plant_name
        self._next_s = 0.0
        self._reported = 0
        self._last_complaint = ""

    async def fetch_offers(self, stream: JetStreamContext, store: str) -> list[Message]:
        """Fetch the offers, once a minute, and return the answers not reported yet, as messages."""
        if not self._config.offers.trust or time.monotonic() < self._next_s:
            return []
        self._next_s = time.monotonic() + FETCH_S
        complaint = ""
        try:
            _, message = await _fetch_open_offers(stream, self._machine)
            self._update_folder(list(split_documents(message)))
        except ERRORS as error:
            complaint = f"offers cannot be fetched: {describe_cause(error)}; those already here are kept"
        except StoreError as error:
            complaint = str(error)
        if complaint and complaint != self._last_complaint:
            write_line(complaint, "minor")
        self._last_complaint = complaint
        return [encode_answer(asdict(each), self._machine, store) for each in self._read_new_answers()]

    def count_reported_answers(self, count: int) -> None:
        self._reported += count

    def _read_new_answers(self) -> list[OfferDecision]:
        try:
            answers = read_decisions(self._config.store.directory)
            self._reported = min(self._reported, len(answers))  # the file was started again
            return answers[self._reported :]
        except StoreError as error:
            write_line(str(error), "minor")
            return []

    def _update_folder(self, documents: list[bytes]) -> None:
        """Make the folder contain exactly these documents; StoreError."""
        folder = self._config.offers_directory
        wanted: dict[Path, bytes] = {}
        for document in documents:
            try:
                offer = read_offer(document, self._config.offers.trust)
            except OfferRefused as error:
                write_line(f"an offer was ignored: {error}", "minor")
                continue
            wanted[folder / make_file_name(offer.name, offer.version)] = document
        try:
            make_folder(folder)
            for obsolete in list_offers(folder).keys() - wanted.keys():
                obsolete.unlink(missing_ok=True)
        except OSError as error:
            raise make_store_error(folder, error) from None
        for path, document in wanted.items():
            if not _has_content(path, document):
                write_file(path, document)
                write_line(f"new offer of the fleet server in {path}; review it with fdhil offers list")


def _has_content(path: Path, document: bytes) -> bool:
    try:
        return path.read_bytes() == document
    except OSError:
        return False
