"""``fdhil demo``: run the whole loop with simulator, guard and daemon as separate processes."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.child_process import interrupt_on_stop_signals
from fdhil.cli.options import AS_JSON, FOLDER

if TYPE_CHECKING:
    from fdhil.cli.demo.demo_page import DemoResult, Published
    from fdhil.cli.demo.realistic_machine import RealisticResult
    from fdhil.records import Parameters


@click.command()
@click.option("--out", type=FOLDER, default=Path("out"), show_default=True,
              help="Folder for report, recordings and logs.")  # fmt: skip
@click.option("--realtime", is_flag=True, help="Run the simulator in real time instead of as fast as possible.")
@click.option("--pdf", is_flag=True, help="Write the report as report.pdf as well (needs chromium).")
@AS_JSON
def demo(out: Path, realtime: bool, pdf: bool, as_json: bool) -> None:
    """Run the whole loop on a simulated machine, without hardware or root, in less than a minute.

    Starts simulator (drives, sensors, NC), guard and daemon, commissions the drives, identifies them from shuttle
    moves, predicts the paper's path, executes it without and with the correction, then warms the slide-ways and
    repeats. In parallel it does the same on a machine with realistic imperfections. Needs the extra 'report'.
    """
    from fdhil.cli.demo import realistic_page
    from fdhil.cli.demo.demo_page import build_demo_page
    from fdhil.cli.demo.loop import run_loop
    from fdhil.cli.demo.realistic_machine import run_realistic_in_process
    from fdhil.report import find_browser, require_libraries, write_page_or_pdf

    require_libraries()  # before the computation

    def show_progress(text: str) -> None:
        if not as_json or sys.stderr.isatty():
            click.echo(text, err=as_json)

    if pdf:
        find_browser()
    with interrupt_on_stop_signals(), run_realistic_in_process(out / "realistic", realtime, show_progress) as result:
        loop = run_loop(out, realtime, show_progress)
        realistic = result()
        report = out / "report.html"
        laid_out = build_demo_page(
            loop, [realistic_page.build_headline(realistic)], [realistic_page.build_section(realistic)]
        )
        write_page_or_pdf(laid_out, report, report.with_suffix(".pdf") if pdf else None)
    if as_json:
        click.echo(json.dumps({**_build_demo_document(loop, report), "realistic": _describe_realistic(realistic)}))
    else:
        _print_tables(loop, realistic, report)


def _describe_parameters(found: Published, truth: Parameters) -> dict[str, Any]:
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


def _describe_realistic(realistic: RealisticResult) -> dict[str, Any]:
    axes = {
        axis: {
            "rapids": found.rapids,
            "believed": found.accepted,
            "reasons": dict(found.reasons),
            "parameters": found.published and _describe_parameters(found.published, realistic.truth[axis]),
            "terms": found.published and dict(found.published.parameters.terms),
        }
        for axis, found in realistic.verdicts.items()
    }
    cuts = [{"label": cut.label, "rms_um": cut.rms_um, "max_um": cut.max_um} for cut in realistic.cuts]
    return {"axes": axes, "cuts": cuts, "refused": realistic.refused or None}


def _build_demo_document(loop: DemoResult, report: Path) -> dict[str, Any]:
    from fdhil.cli.demo.demo_page import compute_rms

    identified = {axis: _describe_parameters(sets[0], loop.truth[axis]) for axis, sets in loop.published.items()}
    before, mirror, after, *rest = loop.cuts
    contour = loop.predicted.contour_um
    return {
        "schema": "fdhil-demo-1",
        "identified": identified,
        "predicted": {"rms_um": compute_rms(contour), "max_um": float(contour.max())},
        "before": {"rms_um": before.rms_um, "max_um": before.max_um},
        "mirror": {"rms_um": mirror.rms_um, "max_um": mirror.max_um, "late_offsets": mirror.late_offsets},
        "after": {"rms_um": after.rms_um, "max_um": after.max_um, "late_offsets": after.late_offsets},
        "warm": [{"label": cut.label, "rms_um": cut.rms_um, "max_um": cut.max_um} for cut in rest],
        "frames": {"received": loop.frames[0], "lost": loop.frames[1]},
        "report": str(report),
    }


def _print_tables(loop: DemoResult, realistic: RealisticResult, report: Path) -> None:
    from rich.table import Table

    from fdhil.cli.demo import realistic_page
    from fdhil.cli.demo.demo_page import CUT_HEAD, PARAMETER_HEAD, list_cut_rows, list_parameter_rows
    from fdhil.cli.printable_console import PrintableConsole

    console = PrintableConsole()
    for title, head, rows in (
        ("Identified from the rapids", PARAMETER_HEAD, list_parameter_rows(loop)),
        ("Contour error, measured at the simulated table", CUT_HEAD, list_cut_rows(loop)),
        ("Results of the realistic machine", realistic_page.VERDICT_HEAD, realistic_page.list_verdict_rows(realistic)),
        ("Contour error of the realistic machine", CUT_HEAD, realistic_page.list_cut_rows(realistic)),
    ):
        table = Table(title=title, title_justify="left")
        for k, name in enumerate(head):
            table.add_column(name, justify="left" if k == 0 else "right")
        for row in rows:
            table.add_row(*row)
        console.print(table)
    before, mirror, after = loop.cuts[:3]
    gains = f"mirror {before.rms_um / mirror.rms_um:.1f}, inverse {before.rms_um / after.rms_um:.1f}"
    console.print(f"Measured RMS contour error reduced by a factor of: [bold]{gains}[/].")
    console.print(f"wrote {report}", soft_wrap=True)
