"""The API against arbitrary requests: every answer conforms to the schema, and none is an internal error."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from fastapi import FastAPI
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis import Case
from schemathesis.checks import CHECKS, load_all_checks
from schemathesis.python import asgi

from fdhil.store.history_database import History
from fdhil.web.application import make_app
from tests.store.sample_records import STAMP, make_outcome, make_published
from tests.web.http_clients import OWN, log_in_for_token, make_test_app, write_machine

load_all_checks()
EXAMPLES = 6
PATIENCE_S = 300.0  # on a busy computer
CONFORMANCE: Any = CHECKS.get_by_names(
    ["status_code_conformance", "content_type_conformance", "response_schema_conformance"]
)


def _describe_routes() -> Any:
    with tempfile.TemporaryDirectory() as folder:
        return schemathesis.openapi.from_dict(make_test_app(Path(folder)).openapi())


SCHEMA = _describe_routes()
OPERATIONS = {found.ok().label: found.ok() for found in SCHEMA.get_all_operations()}


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    config = write_machine(tmp_path_factory.mktemp("machine"), acting=True)
    with History.open(config.store.directory) as history:
        history.add_window(make_outcome(), "", STAMP)
        history.add_revision(make_published(1), (1,), STAMP)
    return make_app(config)


@pytest.fixture(scope="module")
def session(app: FastAPI) -> Iterator[Any]:
    """A client whose threads run before the first test, and after the last."""
    application: Any = app
    with asgi.get_client(application) as client:
        client.get("http://localhost/api/machine/programs", headers=make_own_request(app, "operator"))
        yield client


@pytest.fixture(scope="module")
def replaying(app: FastAPI, session: Any) -> None:
    session.get("http://localhost/api/rapids/X/1/signals", headers=make_own_request(app, "operator"))


def make_own_request(app: FastAPI, name: str) -> dict[str, str]:
    return {**OWN, **({"Authorization": f"Bearer {log_in_for_token(app, name)}"} if name else {})}


def test_every_route_is_described() -> None:
    assert {"GET /api/machine", "POST /api/machine/arm", "POST /api/session", "GET /api/machine/plan"} <= set(
        OPERATIONS
    )


@pytest.mark.usefixtures("processes", "replaying")
@pytest.mark.parametrize("label", OPERATIONS)
def test_any_request_is_answered_as_described(label: str, app: FastAPI, session: Any) -> None:
    name = "" if label.startswith("POST /api/session") else "operator"  # a login that is guessed costs its scrypt
    headers = make_own_request(app, name)

    @settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
    @given(data=st.data())
    def sent(data: st.DataObject) -> None:
        case: Case[Any] = data.draw(OPERATIONS[label].as_strategy())
        answer = case.call(base_url="http://localhost", session=session, headers=headers, timeout=PATIENCE_S)
        assert answer.status_code != 500, answer.text
        assert answer.status_code != 401 or not name
        case.validate_response(answer, checks=CONFORMANCE)

    sent()
    _end_forecasts(session, make_own_request(app, "operator"))


def _end_forecasts(session: Any, headers: dict[str, str]) -> None:
    for program in session.get("http://localhost/api/program", headers=headers).json()["programs"]:
        session.post(f"http://localhost/api/program/{program['digest']}/cancel", headers=headers)


@pytest.mark.parametrize("label", [label for label in OPERATIONS if "/api/session" not in label])
def test_client_without_login_learns_nothing(label: str, session: Any) -> None:
    @settings(max_examples=2, deadline=None, suppress_health_check=list(HealthCheck))
    @given(data=st.data())
    def sent(data: st.DataObject) -> None:
        case: Case[Any] = data.draw(OPERATIONS[label].as_strategy())
        answer = case.call(base_url="http://localhost", session=session, headers=OWN, timeout=PATIENCE_S)
        assert answer.status_code in (401, 404, 405, 413), answer.text  # a path that it leads to may be none of ours
        assert answer.status_code != 401 or answer.json()["code"] == "AuthRequired"

    sent()
