"""fdhil demo: twin, guard and daemon as processes of their own, and the whole loop run through them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from fdhil.cli.demo.report import Loop


@click.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out"), show_default=True,
              help="Folder for the report, the recordings and the logs.")  # fmt: skip
@click.option(
    "--realtime", is_flag=True, help="Run the twin on the host's clock instead of as fast as the bus answers."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of tables.")
def demo(out: Path, realtime: bool, as_json: bool) -> int:
    """Run the whole loop on the simulated machine: no hardware, no root, under a minute.

    Starts the twin (drives, sensors, NC), the guard and the daemon; commissions the drives; shuttles the axes and
    identifies them; predicts the path of the paper, cuts it, arms, cuts it corrected; warms the slide-ways and cuts
    again.
    """
    from fdhil.cli.demo.loop import run_loop
    from fdhil.cli.demo.report import page
    from fdhil.report import write

    def say(text: str) -> None:
        if not as_json or sys.stderr.isatty():
            click.echo(text, err=as_json)

    loop = run_loop(out, realtime, say)
    report = out / "report.html"
    write(page(loop), report)
    if as_json:
        click.echo(json.dumps(_document(loop, report)))
    else:
        _tables(loop, report)
    return 0


def _document(loop: Loop, report: Path) -> dict[str, Any]:
    from fdhil.cli.demo.report import rms
    from fdhil.records import PARAMETERS, UNITS

    identified = {
        axis: {
            name: {
                "value": getattr(sets[0].parameters, name),
                "std": sets[0].std[name],
                "unit": UNITS[name],
                "true": getattr(loop.truth[axis], name),
            }
            for name in PARAMETERS
        }
        for axis, sets in loop.published.items()
    }
    before, mirror, after, *rest = loop.cuts
    contour = loop.predicted.contour_um
    return {
        "schema": "fdhil-demo-1",
        "identified": identified,
        "predicted": {"rms_um": rms(contour), "max_um": float(contour.max())},
        "before": {"rms_um": before.rms_um, "max_um": before.max_um},
        "mirror": {"rms_um": mirror.rms_um, "max_um": mirror.max_um, "late_offsets": mirror.late_offsets},
        "after": {"rms_um": after.rms_um, "max_um": after.max_um, "late_offsets": after.late_offsets},
        "warm": [{"label": cut.label, "rms_um": cut.rms_um, "max_um": cut.max_um} for cut in rest],
        "frames": {"received": loop.frames[0], "lost": loop.frames[1]},
        "report": str(report),
    }


def _tables(loop: Loop, report: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from fdhil.cli.demo.report import CUT_HEAD, PARAMETER_HEAD, cut_rows, parameter_rows

    console = Console()
    for title, head, rows in (
        ("Identified from the rapids", PARAMETER_HEAD, parameter_rows(loop)),
        ("Contour error, measured by the twin at its own table", CUT_HEAD, cut_rows(loop)),
    ):
        table = Table(title=title, title_justify="left")
        for k, name in enumerate(head):
            table.add_column(name, justify="left" if k == 0 else "right")
        for row in rows:
            table.add_row(*row)
        console.print(table)
    before, mirror, after = loop.cuts[:3]
    gains = f"mirror {before.rms_um / mirror.rms_um:.1f}, inverse {before.rms_um / after.rms_um:.1f}"
    console.print(f"RMS contour error, measured, smaller by a factor of: [bold]{gains}[/]. Report: {report}")
