"""Builds frame filters for the kernel or an adapter, and applies them to a block."""

from collections.abc import Iterable, Sequence

import numpy as np

from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, Frames
from fdhil.drivers.can.receive_port import Filter

_NODE = 0x07F
_COB_ID = 0x7FF


def build_drive_filters(node_ids: Iterable[int], cob_ids: Iterable[int]) -> list[Filter]:
    """Return filters for NMT, SYNC and TIME, for the whole predefined connection set of these nodes (SDO and EMCY
    included, for the black box), and for ``cob_ids``.

    >>> [(hex(wanted), hex(mask)) for wanted, mask in build_drive_filters([5], [0x185, 0x33])]
    [('0x0', '0x8000007f'), ('0x5', '0x8000007f'), ('0x33', '0x800007ff')]
    """
    nodes = sorted({0, *node_ids})
    others = sorted({cob_id for cob_id in cob_ids if cob_id & _NODE not in nodes})
    return [(node, EXTENDED_FLAG | _NODE) for node in nodes] + [(i, EXTENDED_FLAG | _COB_ID) for i in others]


def filter_frames(frames: Frames, filters: Sequence[Filter]) -> Frames:
    """Return the frames that pass a filter, and all error frames; without filters, all frames."""
    if not filters:
        return frames
    can_id = frames["id"]
    passes = can_id & ERROR_FLAG != 0
    for wanted, mask in filters:
        passes |= (can_id ^ np.uint32(wanted)) & np.uint32(mask) == 0
    return frames if passes.all() else frames[passes]
