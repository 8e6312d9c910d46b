"""The daemon's publication of names, texts and numbers from outside to a shop floor: lines stay lines."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

from fdhil.shopfloor.mqtt_publisher import MqttSession
from fdhil.shopfloor.shdr import build_adapter_state, format_notice, list_changed_lines
from fdhil.shopfloor.status_poller import StatusPoller
from tests.daemon.simulated_machine import config_of
from tests.fuzz.input_assessment import Target
from tests.shopfloor.status_documents import NOW_MS, status, trouble
from tests.shopfloor.status_documents import notice as noticed

CONFIG = config_of(Path("/nowhere"), ("X",))
HEARD, BORN = StatusPoller(CONFIG), MqttSession(CONFIG.publish.mqtt, "node")
BEFORE = HEARD.build_update(status("X", notices=[]), NOW_MS)  # only new values are published
SHOWN = build_adapter_state(BEFORE)
BORN.node.build_births(*BORN._make_metrics(BEFORE), NOW_MS)


def taste(data: bytes) -> None:
    """Use the bytes, a JSON list or texts separated by zero bytes, for all values that come from outside."""
    reported = _publish_values(data)
    text, number = [str(item) for item in reported[:4]], [x for x in reported if type(x) in (int, float)]
    message = status(
        "X",
        troubles=[trouble("StoreFault", "X", text=text[1])],
        notices=[noticed("Armed", 5.0, text=text[3])],
        armed={"program": text[0], "method": text[1]},
        may_stand={"nothing": False, "text": text[2]},
    )
    message["nc"] |= {
        "program": text[3],
        "line": number[0] if number else None,
        "feed_mm_min": number[-1] if number else 1,
    }
    news = copy.copy(HEARD).build_update(json.loads(json.dumps(message)), NOW_MS)
    for line in [*list_changed_lines(SHOWN, build_adapter_state(news)), *map(format_notice, news.events)]:
        assert line.count("|") >= 2
        assert line.isprintable(), line
        line.encode()
    _copy_session()._build_changes(news)


def _copy_session() -> MqttSession:
    """Return a copy of the session with its published values; constant parts are shared."""
    session, node = copy.copy(BORN), copy.copy(BORN.node)
    session.node, session._notices = node, {}
    node._aliases, node._sent = dict(node._aliases), {device: dict(sent) for device, sent in node._sent.items()}
    return session


def _publish_values(data: bytes) -> list[Any]:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        found = data.decode("utf-8", "surrogateescape").split("\0")
    found = found if isinstance(found, list) else [found]
    return [*found, *[""] * 4]


def target() -> Target:
    seeds = [b"part|1.ngc\0a\nb\0c|d\0\x1b[31mred", b'["part.ngc", 17, 1e3, "\\ud800", -1]', "Fräser\u2028\0µ".encode()]
    return Target(
        "status_told", seeds, taste, [b"|", b"\n", b"\\n", b"\\u2028", b"1e308", b"9" * 320, b"\xc2\x85"], 600
    )
