"""Takes a table from its descriptor and checks a few rows per turn, so that no SYNC waits for it."""

from typing import Any, Literal

from fdhil.guard import correction_table
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.event_journal import EventJournal
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_socket import GuardSocketClient
from fdhil.guard.guard_state import GuardState
from fdhil.guard.interlocks import Alarm
from fdhil.guard.request_parsing import Document

ROWS_PER_TURN = 64
ROWS_PER_IDLE_TURN = 1024
MAX_RUNNING_PIECE_BYTES = 1 << 18
Kind = Literal["whole", "piece", "renewal"]


class TableIntake:
    """Holds the table in force, ``path``, and at most one more that is being checked."""

    def __init__(self, settings: GuardSettings, journal: EventJournal) -> None:
        self.path: CorrectedPath | None = None
        self._settings = settings
        self._journal = journal
        self._loading: tuple[correction_table.TableLoading, GuardSocketClient, Document] | None = None
        self._kind: Kind = "whole"
        self._taken = 0
        self._refused = ""

    @property
    def busy(self) -> bool:
        """Whether a table is being checked."""
        return self._loading is not None

    def begin_table(self, client: GuardSocketClient, document: Document, state: GuardState) -> None:
        """Take the table that came with a request; the answer follows once its rows are checked.

        A request with ``renew`` replaces the offsets of the first rows, as long as the machine has not started.
        """
        running = state.sending or state.mode is not Mode.OFF
        renews = state.mode is Mode.ARMED and document.get("renew") is True
        try:
            if self._loading is not None:
                raise correction_table.TableRefused("TableBusy", "another table is being checked; wait for its answer")
            most_bytes = MAX_RUNNING_PIECE_BYTES if running else correction_table.MAX_TABLE_BYTES
            loading = self._join_table(
                correction_table.read_sealed_memory(client.descriptor, most_bytes), state, running, renews
            )
            kind = _classify_table(loading, renews)
            _require_table_allowed(kind, state)
        except correction_table.TableRefused as refusal:
            self._refuse_table(client, document, refusal)
        else:
            self._taken += 1
            self._loading, self._kind = (loading, client, document), kind
        client.release_descriptor()

    def _join_table(self, body: bytes, state: GuardState, running: bool, renews: bool) -> correction_table.TableLoading:
        axes = self._settings.axes
        keep = state.places[0].row - 2 if running and state.places else 0
        limits, travel = tuple(axis.limits for axis in axes), tuple(axis.travel for axis in axes)
        names = [axis.name for axis in axes]
        if renews:
            return correction_table.begin_renewal(body, self._taken + 1, names, limits, self.path, travel)
        return correction_table.begin_table(body, self._taken + 1, names, limits, self.path, keep, travel)

    def check_next_rows(self, state: GuardState) -> None:
        """Check the next rows of the new table; only a few at a time while frames have to leave in time."""
        if self._loading is None:
            return
        loading, client, document = self._loading
        try:
            _require_table_allowed(self._kind, state)  # the guard may have been armed since the table came
            loading.check_next_rows(ROWS_PER_TURN if state.sending else ROWS_PER_IDLE_TURN)
        except correction_table.TableRefused as refusal:
            self._loading = None
            self._refuse_table(client, document, refusal)
            return
        if loading.done:
            self._loading, self.path = None, loading.joined
            rows = [loading.joined.first, loading.joined.end]
            client.queue_reply(document, ok=True, sequence=loading.joined.sequence, rows=rows)

    def _refuse_table(
        self, client: GuardSocketClient, document: dict[str, Any], refusal: correction_table.TableRefused
    ) -> None:
        if str(refusal) != self._refused:  # a repeated refusal is journaled once
            self._journal.write("table_refused", code=refusal.code, text=str(refusal))
        self._refused = str(refusal)
        advice = Alarm(refusal.code).action
        client.queue_reply(document, ok=False, code=refusal.code, text=str(refusal), advice=advice)


def _classify_table(loading: correction_table.TableLoading, renews: bool) -> Kind:
    if renews:
        return "renewal"
    return "whole" if loading.joined.first == 0 and loading.next_row == 0 else "piece"


def _require_table_allowed(kind: Kind, state: GuardState) -> None:
    """Raise TableRefused where such a table must not take force: an armed table is replaced only by its own renewal."""
    standing = state.mode is Mode.OFF and not state.sending
    if not {"piece": True, "renewal": state.mode is Mode.ARMED, "whole": standing}[kind]:
        raise correction_table.TableRefused("TableBusy", Alarm("TableBusy").cause)
