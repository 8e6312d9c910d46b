"""``make study``: run the Monte-Carlo studies and write their figures and pages to docs/studies.

python -m studies [NAME...]      measure, with the studies' own defaults
python -m studies --pages        write the pages again from the figures that are there
"""

from __future__ import annotations

import sys
from importlib import import_module

from studies.pages import FOLDER, write_page

STUDIES = (
    "estimators",
    "comparison",
    "drift",
    "sisters",
    "verdicts",
    "wrong_signals",
    "slow_sensor",
    "reality",
    "zoo",
    "guard_invariants",
    "wires",
    "crash",
    "kills",
    "swarm",
    "fuzz",
    "soak",
    "fleet",
    "mutants",
)


def main() -> None:
    """Run the named studies, or all of them, each with its own defaults."""
    if sys.argv[1:] == ["--pages"]:
        for name in STUDIES:
            write_page(FOLDER / f"{name}.json")
        return
    names = sys.argv[1:] or list(STUDIES)
    unknown = [name for name in names if name not in STUDIES]
    if unknown:
        sys.exit(f"no study is called {', '.join(unknown)}: choose from {', '.join(STUDIES)}")
    sys.argv = sys.argv[:1]
    for name in names:
        print(f"{name} ...", flush=True)
        import_module(f"studies.{name}").main()


if __name__ == "__main__":
    main()
