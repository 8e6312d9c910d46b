"""A zoo of machines by an independent hand, and what fdhil makes of them (``python -m studies.zoo``).

The plants, drives and controllers share nothing with fdhil's simulator or model. Each machine gives recordings in
fdhil's own format, a configuration and the demand of a program; ``identify`` and ``correct`` are run as a user runs
them, and the program is cut at the machine's own table with and without the offsets. The page goes to
``docs/studies/zoo.md``.
"""

from __future__ import annotations

import argparse

from studies import pages
from studies.zoo.page import page

__all__ = ["main", "page"]


def main() -> None:
    """Run the study."""
    from studies.zoo.examination import measure

    parser = argparse.ArgumentParser(description="Examine the machines of the zoo.")
    parser.add_argument("--draws", type=int, default=2, help="machines of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", default="", help="only kinds whose name contains this")
    pages.run_study("zoo", parser, lambda o: f"{o.seed} to {o.seed + o.draws - 1}", measure)
