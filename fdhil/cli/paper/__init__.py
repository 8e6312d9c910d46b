"""``fdhil paper``: test every equation, figure and claim of the reference paper on simulated machines."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fdhil.child_process import interrupt_on_stop_signals
from fdhil.cli.options import AS_JSON, FOLDER
from fdhil.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from fdhil.cli.paper.claims import Claim

RUNS = 50


@click.command()
@click.option("--out", type=FOLDER, required=True,
              help="Folder for paper.html, paper.json and pictures.")  # fmt: skip
@click.option("--runs", type=click.IntRange(2, 10_000), default=RUNS, show_default=True,
              help="Number of noisy recordings per estimator and noise level.")  # fmt: skip
@click.option("--pdf", is_flag=True, help="Write the page as paper.pdf as well (needs chromium).")
@AS_JSON
def paper(out: Path, runs: int, pdf: bool, as_json: bool) -> None:
    """Test the claims of the paper behind fdhil on simulated machines.

    Each claim is tested in several scenarios, variations of configs/paper.toml. It holds, holds with a condition, or is
    not reproduced. Runs only simulations, for about half a minute.
    """
    from importlib.metadata import version

    from fdhil.cli.paper.claims_page import build_claims_document, build_claims_page, write_pictures
    from fdhil.report import find_browser, require_libraries, write_page_or_pdf
    from fdhil.store import open_output

    require_libraries()
    if pdf:
        find_browser()  # before the computation
    _create_folders(out)
    with interrupt_on_stop_signals():
        claims = gather_claims(
            runs, lambda text: click.echo(text, err=True) if sys.stderr.isatty() or not as_json else None
        )
        files = write_pictures(claims, out)
        result = build_claims_document(claims, runs, version("fdhil"), files)
        write_page_or_pdf(build_claims_page(claims), out / "paper.html", out / "paper.pdf" if pdf else None)
    with open_output(out / "paper.json") as file:
        file.write(json.dumps(result, indent=1, ensure_ascii=False).encode())
    if as_json:
        click.echo(json.dumps(result))
    else:
        _print_summary(claims, out / "paper.html")


def gather_claims(runs: int, say: Callable[[str], object]) -> list[Claim]:
    """Evaluate all claims in the order of the paper; ``say`` receives the progress."""
    from fdhil.cli.paper import (
        conclusion_claims,
        correction_claims,
        estimation_claims,
        measurement_claims,
        prediction_claims,
    )

    say(f"identifying one rapid {runs} times by every method")
    found = estimation_claims.evaluate_claims(runs)
    say("measuring the machine, cold and warm")
    found += measurement_claims.evaluate_claims()
    say("simulating the path in every scenario")
    structure, *predicted = prediction_claims.evaluate_claims()
    say("simulating the corrected path")
    corrected = correction_claims.evaluate_claims()
    return [structure, *found, *predicted, *corrected, *conclusion_claims.evaluate_claims([*predicted, *corrected])]


def _create_folders(out: Path) -> None:
    try:
        (out / "pictures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder {out} cannot be created: {error.strerror}; choose another --out") from None


def _print_summary(claims: list[Claim], report: Path) -> None:
    from rich.table import Table

    from fdhil.cli.paper.claims_page import SUMMARY_HEAD, count_verdicts, list_summary_rows
    from fdhil.cli.printable_console import PrintableConsole

    console = PrintableConsole()
    table = Table(title="The paper, claim by claim", title_justify="left")
    for name in SUMMARY_HEAD:
        table.add_column(name)
    for row in list_summary_rows(claims):
        table.add_row(*row)
    console.print(table)
    summary = ", ".join(f"{number} {verdict}" for verdict, number in count_verdicts(claims).items())
    console.print(f"{summary}.")
    console.print(f"wrote {report}", soft_wrap=True)
