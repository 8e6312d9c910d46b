"""Examines what the works offers: what waits for the operator, and what keeps it from being looked at."""

import os
from collections.abc import Iterator

from fdhil.cli.doctor.trouble import Trouble
from fdhil.config import MachineConfig
from fdhil.errors import StoreError
from fdhil.store.offers import lying, waiting

PLACE = "offers"
MEANS = "what the works offers cannot be looked at or accepted; the machine goes on as it is"


def examine_offers(config: MachineConfig) -> Iterator[Trouble]:
    """Tell of offers that nobody answered, or can read; nothing where no works is trusted."""
    if not config.offers.trust:
        return
    folder = config.offers_directory
    if folder.exists() and not os.access(folder, os.R_OK | os.X_OK):
        mend = "give this user the right to read it, or correct [offers] directory"
        yield Trouble("OffersUnread", PLACE, f"{folder} cannot be read", MEANS, mend)
        return
    for path in lying(folder):
        if not os.access(path, os.R_OK):
            mend = "give this user the right to read it"
            yield Trouble("OffersUnread", PLACE, f"{path} cannot be read", MEANS, mend)
    try:
        offers = waiting(folder, config.store.directory)
    except StoreError as error:
        what, _, mend = str(error).partition("; ")
        yield Trouble("OffersUnread", PLACE, what, MEANS, mend)
        return
    for offer in offers:
        means = "nothing is changed until somebody answers, and the works waits for it"
        mend = "look with fdhil offers list, then accept or reject it"
        yield Trouble("OfferWaits", PLACE, f"the works offers a change: {offer}", means, mend, False)
