"""Foreign text, such as names of machines, programs and files, cannot control the terminal."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fdhil import config
from fdhil.cli.printable_console import PrintableConsole
from fdhil.cli.terminal_text import replace_controls
from fdhil.errors import ConfigError
from tests.bench import bench_toml
from tests.daemon.machine_rig import fdhil

HOSTILE = ("\x1b[2J\x1b]0;owned\x07", "\x9b31m", "a\rb", "\b\b", "\x00", "\u202eexe")


def print_to_console(*renderables: object, colours: bool = False) -> str:
    file = io.StringIO()
    console = PrintableConsole(file=file, force_terminal=colours, width=60)
    for each in renderables:
        console.print(each)
    return file.getvalue()


@pytest.mark.parametrize("hostile", HOSTILE)
def test_console_replaces_control_characters(hostile: str) -> None:
    table = Table(hostile, title=hostile)
    table.add_row(escape(hostile))
    table.add_row(Text(hostile))
    shown = print_to_console(escape(hostile), Text(hostile), table)
    assert replace_controls(shown) == shown
    assert "\N{REPLACEMENT CHARACTER}" in shown or hostile in ("a\rb", "\b\b")  # removed by rich itself


def test_console_keeps_its_own_colours() -> None:
    assert "\x1b[1m" in print_to_console("[bold]X[/bold] \x1b[31m", colours=True)
    assert "\x1b[31m" not in print_to_console("[bold]X[/bold] \x1b[31m", colours=True)


@given(st.text())
def test_replaced_text_keeps_length_and_printable_characters(text: str) -> None:
    shown = replace_controls(text)
    assert len(shown) == len(text)
    assert all(a == b or b == "\N{REPLACEMENT CHARACTER}" for a, b in zip(text, shown, strict=True))
    assert replace_controls("Fräse 5 µm\n\tX") == "Fräse 5 µm\n\tX"


@pytest.mark.parametrize("name", ["Mill\x1b[2J", "Mill\nX", "Mill\x7f", "Mill\u2028"])
def test_machine_name_with_control_characters_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"machine\.name: must be one line without control characters"):
        config.parse_config({"machine": {"name": name}})


def test_error_with_control_characters_in_file_name_is_printable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hostile = tmp_path / "a\x1b[2J.toml"
    hostile.write_text(bench_toml("X").replace('name = "bench"', 'name = ""'))
    code, out, err = fdhil("status", hostile, capsys=capsys)
    assert code == 2
    assert "\x1b" not in out + err
    assert "\N{REPLACEMENT CHARACTER}[2J.toml" in err
