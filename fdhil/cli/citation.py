"""``fdhil --cite``: the BibTeX entries of fdhil and of its reference paper, as in CITATION.cff."""

from importlib.metadata import version

import click

PAPER = "Trajectory shortcoming prediction from physical parameter estimation"
TITLE = "fdhil: identify feed drives during rapid moves, predict the path error and correct it"


def print_citation(context: click.Context, _: click.Parameter, is_wanted: bool) -> None:
    """Print both BibTeX entries and exit."""
    if not is_wanted or context.resilient_parsing:
        return
    click.echo(f"@software{{fdhil,\n  title = {{{TITLE}}},\n  author = {{{{fdhil developers}}}},")
    click.echo(f"  version = {{{version('fdhil')}}},\n  license = {{MIT}}\n}}\n")
    click.echo(f"@misc{{desforges,\n  title = {{{PAPER}}},")
    click.echo("  author = {Desforges, Xavier and Habbadi, Abdallah and Dessein, Gilles},")
    click.echo("  note = {Ecole Nationale d'Ing{\\'e}nieurs de Tarbes; journal, year and DOI are not known here}\n}")
    context.exit()
