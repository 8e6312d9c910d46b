"""Reports proposed configuration changes that wait for an answer, without reading them."""

from fdhil.config import MachineConfig
from fdhil.errors import StoreError
from fdhil.records import Notice
from fdhil.store import list_undecided

MOST = 20  # that are examined: the folder is another user's


class OfferWatch:
    """Reports each waiting proposal once; nothing without [offers] trust."""

    def __init__(self, config: MachineConfig) -> None:
        self._folder = config.offers_directory if config.offers.trust else None
        self._store = config.store.directory
        self._reported: set[str] = set()

    def find_new_offers(self) -> list[Notice]:
        """Return a notice for each proposal that has arrived since the last call."""
        try:
            found = list_undecided(self._folder, self._store) if self._folder is not None else []
        except StoreError as error:
            found = [str(error)]
        before, self._reported = self._reported, set(found[:MOST])
        new = [offer for offer in found[:MOST] if offer not in before]
        return [Notice("OfferWaits", "minor", f"a configuration change is proposed: {offer}") for offer in new]
