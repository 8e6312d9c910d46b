"""One file per estimator, each with ``estimate(windows, settings) -> Estimate``; ``fdhil.tables`` lists them."""

from collections.abc import Sequence
from typing import Protocol

from fdhil import tables
from fdhil.config import Identification
from fdhil.records import Estimate, Window


class Estimator(Protocol):
    """Estimates one window, or a pool of windows of one drive together."""

    def __call__(self, windows: Sequence[Window], settings: Identification) -> Estimate: ...


def select_estimator(settings: Identification) -> tuple[str, Estimator]:
    """Return name and function of the estimator in the settings, else of the default."""
    name = settings.method or tables.DEFAULT_ESTIMATOR
    estimator: Estimator = tables.load_entry(tables.ESTIMATORS, name)
    return name, estimator
