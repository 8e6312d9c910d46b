"""Takes a table from its descriptor and checks a few rows per turn, so that no SYNC waits for it."""

from typing import Any, Literal

from fdhil.guard import table
from fdhil.guard.control import Client
from fdhil.guard.interlocks import Alarm
from fdhil.guard.journal import Journal
from fdhil.guard.path import CorrectedPath
from fdhil.guard.protocol import Mode
from fdhil.guard.requests import Document
from fdhil.guard.settings import Settings
from fdhil.guard.state import State

ROWS_PER_TURN = 64
ROWS_PER_IDLE_TURN = 1024
MAX_RUNNING_PIECE_BYTES = 1 << 18
Kind = Literal["whole", "piece", "renewal"]


class Intake:
    """Holds the table in force, ``path``, and at most one more that is being checked."""

    def __init__(self, settings: Settings, journal: Journal) -> None:
        self.path: CorrectedPath | None = None
        self._settings = settings
        self._journal = journal
        self._loading: tuple[table.Loading, Client, Document] | None = None
        self._kind: Kind = "whole"
        self._taken = 0
        self._refused = ""

    @property
    def busy(self) -> bool:
        """Whether a table is being checked."""
        return self._loading is not None

    def begin(self, client: Client, document: Document, state: State) -> None:
        """Take the table that came with a request; the answer follows once its rows are checked.

        A request with ``renew`` replaces the offsets of the first rows, as long as the machine has not started.
        """
        running = state.sending or state.mode is not Mode.OFF
        renews = state.mode is Mode.ARMED and document.get("renew") is True
        try:
            if self._loading is not None:
                raise table.TableRefused("TableBusy", "another table is being checked; wait for its answer")
            most_bytes = MAX_RUNNING_PIECE_BYTES if running else table.MAX_TABLE_BYTES
            loading = self._joined(table.read_sealed(client.descriptor, most_bytes), state, running, renews)
            kind = _kind(loading, renews)
            _require(kind, state)
        except table.TableRefused as refusal:
            self._refuse(client, document, refusal)
        else:
            self._taken += 1
            self._loading, self._kind = (loading, client, document), kind
        client.release()

    def _joined(self, body: bytes, state: State, running: bool, renews: bool) -> table.Loading:
        axes = self._settings.axes
        keep = state.places[0].row - 2 if running and state.places else 0
        limits, travel = tuple(axis.limits for axis in axes), tuple(axis.travel for axis in axes)
        names = [axis.name for axis in axes]
        if renews:
            return table.renew(body, self._taken + 1, names, limits, self.path, travel)
        return table.begin(body, self._taken + 1, names, limits, self.path, keep, travel)

    def check(self, state: State) -> None:
        """Check the next rows of the new table; only a few at a time while frames have to leave in time."""
        if self._loading is None:
            return
        loading, client, document = self._loading
        try:
            _require(self._kind, state)  # the guard may have been armed since the table came
            loading.check(ROWS_PER_TURN if state.sending else ROWS_PER_IDLE_TURN)
        except table.TableRefused as refusal:
            self._loading = None
            self._refuse(client, document, refusal)
            return
        if loading.done:
            self._loading, self.path = None, loading.joined
            rows = [loading.joined.first, loading.joined.end]
            client.reply(document, ok=True, sequence=loading.joined.sequence, rows=rows)

    def _refuse(self, client: Client, document: dict[str, Any], refusal: table.TableRefused) -> None:
        if str(refusal) != self._refused:  # a repeated refusal is journaled once
            self._journal.write("table_refused", code=refusal.code, text=str(refusal))
        self._refused = str(refusal)
        advice = Alarm(refusal.code).action
        client.reply(document, ok=False, code=refusal.code, text=str(refusal), advice=advice)


def _kind(loading: table.Loading, renews: bool) -> Kind:
    if renews:
        return "renewal"
    return "whole" if loading.joined.first == 0 and loading.next_row == 0 else "piece"


def _require(kind: Kind, state: State) -> None:
    """Raise TableRefused where such a table must not take force: an armed table is replaced only by its own renewal."""
    standing = state.mode is Mode.OFF and not state.sending
    if not {"piece": True, "renewal": state.mode is Mode.ARMED, "whole": standing}[kind]:
        raise table.TableRefused("TableBusy", Alarm("TableBusy").cause)
