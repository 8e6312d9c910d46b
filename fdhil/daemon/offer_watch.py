"""Tells that an offer of the works waits for an answer; what is in it is not looked at here."""

from __future__ import annotations

from fdhil.config import MachineConfig
from fdhil.errors import StoreError
from fdhil.records import Notice
from fdhil.store.offers import waiting

MOST = 20  # that are looked at: the folder is another user's


class OfferWatch:
    """Tells of each offer once while it lies there; nothing without [offers] trust."""

    def __init__(self, config: MachineConfig) -> None:
        self._folder = config.offers_directory if config.offers.trust else None
        self._store = config.store.directory
        self._told: set[str] = set()

    def look(self) -> list[Notice]:
        """Return a notice for each offer that has come since the last look."""
        try:
            found = waiting(self._folder, self._store) if self._folder is not None else []
        except StoreError as error:
            found = [str(error)]
        before, self._told = self._told, set(found[:MOST])
        new = [offer for offer in found[:MOST] if offer not in before]
        return [Notice("OfferWaits", "minor", f"the works offers a change: {offer}") for offer in new]
