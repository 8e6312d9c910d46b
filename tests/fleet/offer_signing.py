"""A fleet server with a signing key, and a machine whose operator trusts it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from fdhil.fleet.signed_offer import Offer, create_key, sign_offer
from tests.fleet.recording_machine import write_history

NOW = int(time.time())
TOLD: dict[str, Any] = {
    "name": "friction",
    "version": 3,
    "text": "Friction of the X axis, from twelve machines",
    "labels": {"type": "V-800"},
    "axis_labels": {},
    "values": {"axis.X.nominal.ft": 0.061},
    "stage": 1,
    "machines": ("mill-1",),
    "by": "Anna",
    "made_s": NOW - 60,
    "expires_s": NOW + 86_400,
}


class OfferSigner:
    """The fleet server: its key, and the offers that it signs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.key = folder / "works.key"
        self.public = create_key(self.key)

    def sign_document(self, **changes: Any) -> bytes:
        return sign_offer(Offer(**(TOLD | changes)), self.key)

    def write_document(self, **changes: Any) -> Path:
        """Return the file of a signed offer, as carried to a machine."""
        place = self._folder / "carried.offer"
        place.write_bytes(self.sign_document(**changes))
        return place


def create_machine(works: OfferSigner, folder: Path, *more: str, **uplink: Any) -> Path:
    """Write the configuration of a machine that trusts the fleet server, with comments, and return its file."""
    reported = {"axis_labels": {"X": {"screw": "A"}, "Y": {"screw": "B"}}} | uplink
    file = write_history(folder, **reported)
    text = file.read_text().replace("ft = 0.05", "ft = 0.05  # by the data sheet", 1)
    tail = "\n".join(["", "# what follows is the operator's", "[offers]", f'trust = ["{works.public}"]', *more, ""])
    file.write_text(text + tail)
    return file
