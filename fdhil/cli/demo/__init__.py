"""fdhil demo: twin, guard and daemon as processes of their own, and the whole loop run through them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.child import stopping_in_order
from fdhil.cli.options import AS_JSON, FOLDER

if TYPE_CHECKING:
    from fdhil.cli.demo.realistic import Realistic
    from fdhil.cli.demo.report import Loop, Published
    from fdhil.records import Parameters


@click.command()
@click.option("--out", type=FOLDER, default=Path("out"), show_default=True,
              help="Folder for the report, the recordings and the logs.")  # fmt: skip
@click.option(
    "--realtime", is_flag=True, help="Run the twin on the host's clock instead of as fast as the bus answers."
)
@click.option("--pdf", is_flag=True, help="Print the report as report.pdf too (needs chromium).")
@AS_JSON
def demo(out: Path, realtime: bool, pdf: bool, as_json: bool) -> None:
    """Run the whole loop on the simulated machine: no hardware, no root, under a minute.

    Starts the twin (drives, sensors, NC), the guard and the daemon; commissions the drives; shuttles the axes and
    identifies them; predicts the path of the paper, cuts it, arms, cuts it corrected; warms the slide-ways and cuts
    again. At the same time it identifies and cuts on a machine with what real ones have. Needs the extra 'report'.
    """
    from fdhil.cli.demo import realistic_page
    from fdhil.cli.demo.loop import run_loop
    from fdhil.cli.demo.realistic import running_realistic
    from fdhil.cli.demo.report import page
    from fdhil.report import deliver, find_browser, require

    require()  # said before the work, not after it

    def say(text: str) -> None:
        if not as_json or sys.stderr.isatty():
            click.echo(text, err=as_json)

    if pdf:
        find_browser()
    with stopping_in_order(), running_realistic(out / "realistic", realtime, say) as result:
        loop = run_loop(out, realtime, say)
        realistic = result()
        report = out / "report.html"
        laid_out = page(loop, [realistic_page.headline(realistic)], [realistic_page.section(realistic)])
        deliver(laid_out, report, report.with_suffix(".pdf") if pdf else None)
    if as_json:
        click.echo(json.dumps({**_document(loop, report), "realistic": _realistic(realistic)}))
    else:
        _tables(loop, realistic, report)


def _parameters(found: Published, truth: Parameters) -> dict[str, Any]:
    from fdhil.records import PARAMETERS, UNITS

    return {
        name: {
            "value": getattr(found.parameters, name),
            "std": found.std[name],
            "unit": UNITS[name],
            "true": getattr(truth, name),
        }
        for name in PARAMETERS
    }


def _realistic(realistic: Realistic) -> dict[str, Any]:
    axes = {
        axis: {
            "rapids": told.rapids,
            "believed": told.believed,
            "reasons": dict(told.reasons),
            "parameters": told.published and _parameters(told.published, realistic.truth[axis]),
            "terms": told.published and dict(told.published.parameters.terms),
        }
        for axis, told in realistic.verdicts.items()
    }
    cuts = [{"label": cut.label, "rms_um": cut.rms_um, "max_um": cut.max_um} for cut in realistic.cuts]
    return {"axes": axes, "cuts": cuts, "refused": realistic.refused or None}


def _document(loop: Loop, report: Path) -> dict[str, Any]:
    from fdhil.cli.demo.report import rms

    identified = {axis: _parameters(sets[0], loop.truth[axis]) for axis, sets in loop.published.items()}
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


def _tables(loop: Loop, realistic: Realistic, report: Path) -> None:
    from rich.table import Table

    from fdhil.cli.console import PrintableConsole
    from fdhil.cli.demo import realistic_page
    from fdhil.cli.demo.report import CUT_HEAD, PARAMETER_HEAD, cut_rows, parameter_rows

    console = PrintableConsole()
    for title, head, rows in (
        ("Identified from the rapids", PARAMETER_HEAD, parameter_rows(loop)),
        ("Contour error, measured by the twin at its own table", CUT_HEAD, cut_rows(loop)),
        ("Believed of the realistic machine", realistic_page.VERDICT_HEAD, realistic_page.verdict_rows(realistic)),
        ("Contour error of the realistic machine", CUT_HEAD, realistic_page.cut_rows(realistic)),
    ):
        table = Table(title=title, title_justify="left")
        for k, name in enumerate(head):
            table.add_column(name, justify="left" if k == 0 else "right")
        for row in rows:
            table.add_row(*row)
        console.print(table)
    before, mirror, after = loop.cuts[:3]
    gains = f"mirror {before.rms_um / mirror.rms_um:.1f}, inverse {before.rms_um / after.rms_um:.1f}"
    console.print(f"RMS contour error, measured, smaller by a factor of: [bold]{gains}[/].")
    console.print(f"wrote {report}", soft_wrap=True)
