"""``check`` reports whether the TPDO of a table encoder arrives while the NC runs the bus."""

from __future__ import annotations

import pytest

from fdhil.commissioning.config_check import compare_by_traffic
from fdhil.commissioning.traffic_listener import BusTraffic
from fdhil.config import TableEncoder
from fdhil.drivers.can.frame_ring import pack_frames
from tests.drivers.frame_builder import FrameBuilder, build_machine_config


@pytest.mark.parametrize(("every", "ok"), [(1, True), (5, False), (1000, False)])
def test_table_encoder_tpdo_is_expected_with_every_sync(every: int, ok: bool) -> None:
    config = build_machine_config()
    section = config.axis["X"].model_copy(update={"table": TableEncoder(cob_id=0x2A0)})
    config = config.model_copy(update={"axis": {"X": section}})
    traffic = BusTraffic()
    rows = FrameBuilder(400).build_rows()
    traffic.add_frames(pack_frames([*rows, *((rows[0][0] + 1000 * k, 0x2A0, bytes(4)) for k in range(0, 400, every))]))
    (found,) = [finding for finding in compare_by_traffic(traffic, config, "X") if finding.point == "table encoder"]
    assert found.ok is ok
    assert "2A0" in found.cause
    if not ok:
        assert "synchronous" in found.advice
