"""Examines proposed configuration changes: pending ones, and unreadable ones."""

import os
from collections.abc import Iterator

from fdhil.cli.doctor.trouble import Trouble
from fdhil.config import MachineConfig
from fdhil.errors import StoreError
from fdhil.store import list_offers, list_undecided

PLACE = "offers"
MEANS = "proposed changes cannot be shown or accepted; the machine keeps its configuration"


def examine_offers(config: MachineConfig) -> Iterator[Trouble]:
    """Report unanswered and unreadable proposed changes, if [offers] trusts a key."""
    if not config.offers.trust:
        return
    folder = config.offers_directory
    if folder.exists() and not os.access(folder, os.R_OK | os.X_OK):
        mend = "give this user read permission, or correct [offers] directory"
        yield Trouble("OffersUnread", PLACE, f"{folder} cannot be read", MEANS, mend)
        return
    for path in list_offers(folder):
        if not os.access(path, os.R_OK):
            mend = "give this user read permission"
            yield Trouble("OffersUnread", PLACE, f"{path} cannot be read", MEANS, mend)
    try:
        offers = list_undecided(folder, config.store.directory)
    except StoreError as error:
        yield Trouble.create_from_error("OffersUnread", PLACE, error, MEANS)
        return
    for offer in offers:
        means = "nothing changes until an operator answers"
        mend = "show it with fdhil offers list, then accept or reject it"
        yield Trouble("OfferWaits", PLACE, f"a configuration change is proposed: {offer}", means, mend, False)
