"""``fdhil acceptance``: the report that is handed over with a machine: proofs, parameters and accuracy."""

import json
from pathlib import Path
from typing import Any

import click

from fdhil.api import announce_compilation
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import AS_JSON, CONFIG, FILE, OutputFile, PositiveFloat, WritingCommand


@click.command(cls=WritingCommand)
@CONFIG
@click.option("--out", required=True, type=OutputFile(), help="HTML file to write.")
@click.option("--pdf", type=OutputFile(".pdf"), help="PDF file to write as well (needs chromium).")
@click.option("--by", default="", metavar="NAME", help="Operator who ran the tests; printed above the signature.")
@click.option("--customer", default="", metavar="NAME", help="Customer who receives the machine.")
@click.option("--site", default="", metavar="PLACE", help="Site of the machine.")
@click.option(
    "--program", type=FILE, metavar="PROGRAM", help="NC program or demand CSV to predict the contour error of."
)
@click.option(
    "--radius-mm",
    type=PositiveFloat(0.1, 10_000.0),
    default=50.0,
    show_default=True,
    help="Radius of the circular test.",
)
@click.option(
    "--feed",
    "feed_mm_min",
    type=PositiveFloat(1.0, 1e6),
    default=2000.0,
    show_default=True,
    help="Feed of the circular test, mm/min.",
)
@click.option(
    "--measured-circle",
    type=FILE,
    metavar="CSV",
    help="Circle measured at the table in both directions: columns X_mm,Y_mm.",
)
@click.option("--contour-um", type=PositiveFloat(), help="Largest accepted contour error of PROGRAM, um.")
@click.option("--circle-um", type=PositiveFloat(), help="Largest accepted bi-directional circular deviation, um.")
@AS_JSON
@require_delivered_answer
def acceptance(config: Path, out: Path, pdf: Path | None, as_json: bool, **options: Any) -> int:
    """Write the acceptance report of CONFIG's machine: commissioning results, parameters, circular test.

    Nothing is sent to the drives. The circle and PROGRAM are predicted without and with the correction. A measured
    circle is evaluated alongside (ISO 230-4).
    """
    from fdhil import config as machine_config
    from fdhil.cli.acceptance_findings import NO_LIMIT, AcceptanceOptions, build_acceptance_document, gather_findings
    from fdhil.cli.acceptance_page import build_acceptance_page
    from fdhil.report import require_libraries, write_page_or_pdf

    require_libraries()
    machine = machine_config.load_config(config)
    announce_compilation("predict", "correct")
    found = gather_findings(machine, config, AcceptanceOptions(**options))
    document = build_acceptance_document(found)
    write_page_or_pdf(build_acceptance_page(found, document), out, pdf)
    if as_json:
        click.echo(json.dumps(document, allow_nan=False))
    else:
        for point in found.open_points:
            click.echo(f"open: {point}")
        if not found.options.limits:
            click.echo(NO_LIMIT)
        state = f"{len(found.open_points)} points are open" if found.open_points else "accepted"
        click.echo(f"{machine.machine.name}: {state}; SHA-256 of the report's content: {document['sha256']}")
    return 1 if found.open_points else 0
