"""The page of many machines: their state, due maintenance, axes that differ from their peers, parameter trends.

It reads the fleet's database through the given query function and reaches no machine.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, FastAPI, Query, Request

from fdhil.config import Web
from fdhil.records import PARAMETERS
from fdhil.web.application import make_application
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.pages import session_page

router = APIRouter(prefix="/api/fleet")
KEPT_S = 30.0  # lifetime of an answer: a hundred browsers load the database like one
MOST_KEPT = 64
MOST_SETS = 2000
Ask = Callable[..., Mapping[str, Any]]
Label = Annotated[str, Query(min_length=1, max_length=32)]
Machine = Annotated[str, Query(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
Axis = Annotated[str, Query(pattern=r"^[A-Z]2?$")]


class AnswerCache:
    """Runs one query at a time, and caches the newest answers for a while."""

    def __init__(self, ask: Ask, now_s: Callable[[], float] = time.monotonic) -> None:
        self._ask, self._now_s = ask, now_s
        self._kept: OrderedDict[tuple[object, ...], tuple[float, Mapping[str, Any]]] = OrderedDict()
        self._one = threading.Lock()

    def __call__(self, question: str, **given: str | None) -> Mapping[str, Any]:
        key = (question, *given.values())
        with self._one:
            at_s, answer = self._kept.pop(key, (-KEPT_S, {}))
            if self._now_s() - at_s >= KEPT_S:
                at_s, answer = self._now_s(), self._ask(question, **given)
            self._kept[key] = at_s, answer
            if len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        return answer


async def _get_answers(request: Request) -> AnswerCache:
    answers = request.app.state.answers
    assert isinstance(answers, AnswerCache)
    return answers


CacheDependency = Annotated[AnswerCache, Depends(_get_answers)]


def make_fleet_app(web: Web, ask: Ask) -> FastAPI:
    """Return the application; ``ask(question, **given)`` answers. Raises ConfigError for a faulty users file."""
    app = make_application(web, (session_page.router, router), ("fleet",), ("fleet",), "fdhil fleet status FLEET")
    app.state.answers = AnswerCache(ask)
    return app


@router.get("")
def machines(cache: CacheDependency) -> Mapping[str, Any]:
    """Return all machines, and what is due."""
    return cache("status")


@router.get("/outliers")
def outliers(cache: CacheDependency, by: Label = "type") -> Mapping[str, Any]:
    """Return the axes that differ from their peers: those of machines with the same label ``by``."""
    return cache("outliers", by=by, axis=None)


@router.get("/compare")
def compare(
    cache: CacheDependency,
    parameter: Literal["R", "L", "K", "Jt", "ft", "Cd"],
    by: Label = "type",
    axis: Axis | None = None,
) -> Mapping[str, Any]:
    """Return one parameter of all machines side by side."""
    return cache("compare", parameter=parameter, by=by, axis=axis)


@router.get("/services")
def services(cache: CacheDependency, machine: Machine | None = None) -> Mapping[str, Any]:
    """Return the services, and what each changed."""
    return cache("services", machine=machine)


@router.get("/axis")
def axis(cache: CacheDependency, machine: Machine, axis: Axis) -> dict[str, Any]:
    """Return the trend of each parameter of an axis, with its newest sets."""
    courses = [cache("trend", machine=machine, axis=axis, parameter=name) for name in PARAMETERS]
    if not courses[0]["sets"]:
        raise RequestRefused(
            404,
            "NoSuchAxis",
            f"no parameters of axis {axis} of {machine} were collected",
            "choose a machine and axis of /fleet",
        )
    return {"machine": machine, "axis": axis, "courses": [{**c, "sets": c["sets"][-MOST_SETS:]} for c in courses]}
