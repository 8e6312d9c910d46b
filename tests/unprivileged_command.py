"""A command prefix that makes its program respect file modes, also when root runs the tests."""

from __future__ import annotations

import os
from collections.abc import Sequence

_LACKS = "-dac_override,-dac_read_search"
UNPRIVILEGED: Sequence[str] = (
    ("setpriv", f"--bounding-set={_LACKS}", f"--inh-caps={_LACKS}") if os.geteuid() == 0 else ()
)
