"""``fdhil acceptance``: what is handed over with a machine: what was proven, what it is, and how well it runs."""

import json
from pathlib import Path

import click

from fdhil.api.compiling import forewarn
from fdhil.cli.failing import verdict
from fdhil.cli.options import AS_JSON, CONFIG, FILE, OutputFile, Positive, Writing


@click.command(cls=Writing)
@CONFIG
@click.option("--out", required=True, type=OutputFile(), help="The HTML file to write.")
@click.option("--pdf", type=OutputFile(".pdf"), help="Also print it as PDF (needs chromium).")
@click.option("--by", default="", metavar="NAME", help="The operator who proved it; stands above the signature.")
@click.option("--customer", default="", metavar="NAME", help="Who receives the machine.")
@click.option("--site", default="", metavar="PLACE", help="Where the machine stands.")
@click.option("--program", type=FILE, metavar="PROGRAM", help="An NC program or demand CSV: its contour error is told.")
@click.option(
    "--radius-mm", type=Positive(0.1, 10_000.0), default=50.0, show_default=True, help="Radius of the circular test."
)
@click.option("--feed", type=Positive(1.0, 1e6), default=2000.0, show_default=True, help="Its feed, mm/min.")
@click.option(
    "--measured-circle",
    type=FILE,
    metavar="CSV",
    help="Columns X_mm,Y_mm of that circle as measured at the table, in both directions.",
)
@click.option("--contour-um", type=Positive(), help="The largest contour error of PROGRAM that is accepted.")
@click.option("--circle-um", type=Positive(), help="The largest bi-directional circular deviation that is accepted.")
@AS_JSON
@verdict
def acceptance(
    config: Path,
    out: Path,
    pdf: Path | None,
    by: str,
    customer: str,
    site: str,
    program: Path | None,
    radius_mm: float,
    feed: float,
    measured_circle: Path | None,
    contour_um: float | None,
    circle_um: float | None,
    as_json: bool,
) -> int:
    """Write the acceptance report of CONFIG's machine: what was proven of each drive, parameters, circular test.

    Nothing is sent. The circle, and PROGRAM where there is one, are predicted without and with the correction; a
    circle that was measured is evaluated beside them (ISO 230-4). Exit 1 when a point is open: a drive that is not
    commissioned or not identified, or a limit that is not kept.
    """
    from fdhil import config as machine_config
    from fdhil.cli.acceptance_findings import NO_LIMIT, Asked, document_of, find
    from fdhil.cli.acceptance_page import page_of
    from fdhil.report import deliver, require

    require()
    machine = machine_config.load(config)
    forewarn("predict", "correct")
    given = (program, radius_mm, feed, measured_circle, contour_um, circle_um)
    found = find(machine, config, Asked(by, customer, site, *given))
    document = document_of(found)
    deliver(page_of(found, document), out, pdf)
    if as_json:
        click.echo(json.dumps(document, allow_nan=False))
    else:
        for point in found.open_points:
            click.echo(f"open: {point}")
        if not found.asked.limits:
            click.echo(NO_LIMIT)
        state = "accepted" if not found.open_points else f"{len(found.open_points)} points are open"
        click.echo(f"{machine.machine.name}: {state}; SHA-256 of what the report says: {document['sha256']}")
    return 1 if found.open_points else 0
