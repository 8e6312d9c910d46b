"""Generate what can be generated: configs/machine-template.toml and docs/reference/ (config, commands, python, errors,
faults, guard, notices).

``python docs/generate.py`` writes them; a test fails when they are not what the code says.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import click

from fdhil import errors
from fdhil.cli.main import cli, iterate_commands
from fdhil.config.config_template import format_toml, get_default, list_tables, write_template
from fdhil.daemon.alarms import CONDITIONS
from fdhil.daemon.notice_texts import WORDS
from fdhil.guard.guard_protocol import HOLD_CYCLES
from fdhil.guard.guard_step import FEED_HOLD_S, SETTLED_CYCLES
from fdhil.guard.interlocks import INTERLOCK_CATALOGUE, REACTION_EFFECTS
from fdhil.guard.state_transitions import FEED_SENT, FEED_TRANSITIONS, SENT, TRANSITIONS, Event
from fdhil.sim.fault_kinds import FAULTS

ROOT = Path(__file__).resolve().parent.parent


PYTHON_HEAD = """# Python interface

Generated from `fdhil/api/`; the examples are run by the tests. `import fdhil` loads nothing else until one of these
names is used. The command line uses the same functions. Arrays are (n,), units SI. Errors are those of the
[table](errors.md): each says what happened, what it means and what to do. The names follow semantic versioning: within
one major version they keep their meaning."""


def python_reference() -> str:
    """Return every name of the Python interface with its signature and docstring as Markdown."""
    import fdhil

    lines = [PYTHON_HEAD]
    for name in fdhil.__all__:
        item = getattr(fdhil, name)
        lines += ["", f"## fdhil.{name}", "", _documented(item)]
        if inspect.isclass(item):
            members = [(m, getattr(item, m)) for m in vars(item) if not m.startswith("_")]
            told = [(m, v) for m, v in members if callable(v) or isinstance(v, property | cached_property)]
            lines += [f"- `{m}`: {_first_sentences(v.__doc__)}" for m, v in told]
    return "\n".join(lines) + "\n"


def _documented(item: Any) -> str:
    """Return signature, text, and examples as code."""
    text, examples = [], []
    for paragraph in (inspect.getdoc(item) or "").split("\n\n"):
        (examples if paragraph.startswith(">>>") else text).append(
            _plain(paragraph) if not paragraph.startswith(">>>") else paragraph
        )
    signature = inspect.signature(item)
    plain = [p.replace(annotation=inspect.Parameter.empty) for p in signature.parameters.values()]
    signature = inspect.Signature(plain)
    shown = ["```python", f"{item.__name__}{signature}", "```", "", "\n\n".join(text), ""]
    return "\n".join([*shown, *(["```pycon", "\n\n".join(examples), "```", ""] if examples else [])])


def _first_sentences(text: str | None) -> str:
    return _plain(" ".join((text or "").split("\n\n")[0].split()))


def _plain(text: str) -> str:
    """Return a docstring's markup as Markdown."""
    return re.sub(r":(?:class|func):`~?([\w.]+)`", r"`\1`", text.replace("``", "`"))


def config_reference() -> str:
    """Return the table of every configuration key as Markdown."""
    lines = ["# Configuration keys", "", "Generated from `fdhil/config/`. Unknown keys are refused."]
    for table in list_tables():
        lines += ["", f"## [{table.path}]", ""]
        if table.meaning:
            lines += [table.meaning, ""]
        lines += ["| key | default | meaning |", "|---|---|---|"]
        for key, field in table.keys:
            value = get_default(field)
            shown = (
                "required" if field.is_required() else f"`{format_toml(value)}`" if value is not None else "left out"
            )
            lines.append(f"| `{key}` | {shown} | {field.description or ''} |")
    return "\n".join(lines) + "\n"


def command_reference() -> str:
    """Return every command's help as Markdown."""
    lines = ["# Commands", "", "Generated from the command line's own help.", ""]
    top = click.Context(cli, info_name="fdhil", help_option_names=["-h", "--help"])
    for name, command in iterate_commands(cli):
        help_text = command.get_help(click.Context(command, info_name=name, parent=top))
        lines += [f"## fdhil {name}", "", "```text", help_text, "```", ""]
    return "\n".join(lines)


def error_reference() -> str:
    """Return the error tree as Markdown."""
    lines = [
        "# Errors",
        "",
        "Generated from `fdhil/errors.py`. Beside these a command ends with 0 when it did what was asked and the",
        "answer is a yes, with 1 when the answer is a no, and with 3 when a yes reached nobody: its output was",
        "closed, as in `fdhil disarm CONFIG | true`.",
        "",
        "| class | exit code | meaning |",
        "|---|---|---|",
    ]
    for name, item in vars(errors).items():
        if inspect.isclass(item) and issubclass(item, errors.FdhilError):
            meaning = " ".join((inspect.getdoc(item) or "").partition("\n\n")[0].split())
            lines.append(f"| `{name}` | {item.exit_code} | {meaning} |")
    return "\n".join(lines) + "\n"


def fault_reference() -> str:
    """Return the faults of the simulated machine as Markdown."""
    lines = [
        "# Faults of the simulated machine",
        "",
        "Generated from `fdhil/sim/fault_kinds.py`. How to use them is in [the how-to](../how-to/rehearse-a-fault.md).",
        "",
        "An entry has one of `at_s`, `at_sync`, `at_row`, or none for at once, and `duration_s`, or none for good.",
        "Those of the bus (`bus_...`) meet the frames of `can_id`, else those of the drive of `axis`, else all, that",
        'the machine `way = "sent"` or `"received"`, else both; `bus_inject` and `frame` need `can_id` and `data`',
        "(hexadecimal). `percent` is the share of the frames, or of a sensor's answers, that is met.",
        "",
        "| fault | value | axis |",
        "|---|---|---|",
    ]
    for name, kind in FAULTS.items():
        value = kind.value.meaning if kind.value else "none"
        lines.append(f"| `{name}` | {value} | {'needed' if kind.needs_axis else 'not needed'} |")
    return "\n".join(lines) + "\n"


def guard_reference() -> str:
    """Return the guard's states, what leads from one to another, and its interlocks, as Markdown."""
    lines = [
        "# The guard's states and interlocks",
        "",
        "Generated from `fdhil/guard/state_transitions.py` and `fdhil/guard/interlocks.py`, the tables that the guard "
        "itself",
        "goes by: no other way leads from one state to another. [Safety](../explanation/safety.md) says why.",
        *_states("States", SENT, TRANSITIONS),
        *_states("States of the on-line feed-forward", FEED_SENT, FEED_TRANSITIONS),
        "",
        "## Interlocks",
        "",
        f"All must be good for {SETTLED_CYCLES} SYNC before arming. A hold lasts {HOLD_CYCLES} SYNC at most, "
        f"a feed hold {FEED_HOLD_S:g} s.",
    ]
    for reaction, effect in sorted(REACTION_EFFECTS.items(), reverse=True):
        lines += ["", f"### {effect[:1].upper()}{effect[1:]}", "", "| class | cause | what to do |", "|---|---|---|"]
        lines += [
            f"| `{code}` | {cause} | {action} |"
            for code, (own, cause, action) in INTERLOCK_CATALOGUE.items()
            if own is reaction
        ]
    return "\n".join(lines) + "\n"


def notice_reference() -> str:
    """Return what each class of notice means and what to do, as Markdown."""
    lines = [
        "# Notices",
        "",
        "Generated from `fdhil/daemon/notice_texts.py`. A notice of severity minor or MAJOR waits until somebody",
        "acknowledges it; its own text tells the cause. Those marked * are conditions: their alarm is active until the",
        "machine reports the end. What the guard watches has its words in [the guard's table](guard.md), where",
        ", ".join(f"`{code}`" for code in sorted(CONDITIONS - set(WORDS))) + " are conditions.",
        "",
        "| class | what it means for the machine | what to do |",
        "|---|---|---|",
    ]
    return (
        "\n".join(
            [
                *lines,
                *(
                    f"| `{code}`{'*' * (code in CONDITIONS)} | {effect} | {action} |"
                    for code, (effect, action) in WORDS.items()
                ),
            ]
        )
        + "\n"
    )


def _states(
    title: str, sent: Mapping[Any, str], transitions: Iterable[tuple[Event, Collection[Any], Any]]
) -> Iterator[str]:
    """Yield two tables: what is sent in each state, and every way from one to another."""
    yield from ["", f"## {title}", "", "| state | what is sent |", "|---|---|"]
    yield from [f"| {state} | {words} |" for state, words in sent.items()]
    yield from ["", "| in | when | to |", "|---|---|---|"]
    for event, states, after in transitions:
        yield f"| {', '.join(state for state in sent if state in states)} | {event.value} | {after} |"


GENERATED = {
    ROOT / "configs" / "machine-template.toml": write_template,
    ROOT / "docs" / "reference" / "config.md": config_reference,
    ROOT / "docs" / "reference" / "commands.md": command_reference,
    ROOT / "docs" / "reference" / "python.md": python_reference,
    ROOT / "docs" / "reference" / "errors.md": error_reference,
    ROOT / "docs" / "reference" / "faults.md": fault_reference,
    ROOT / "docs" / "reference" / "guard.md": guard_reference,
    ROOT / "docs" / "reference" / "notices.md": notice_reference,
}


def main() -> int:
    """Write the files; with --check only tell which are stale."""
    stale = [path for path, text in GENERATED.items() if not path.is_file() or path.read_text("utf-8") != text()]
    for path in stale:
        click.echo(f"{path.relative_to(ROOT)} is stale: run python docs/generate.py")
        if "--check" not in sys.argv:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(GENERATED[path](), "utf-8")
            click.echo("  written")
    return int("--check" in sys.argv and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
