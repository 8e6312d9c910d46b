"""Every documented command exists, and those without a machine run unchanged."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from fdhil import config
from fdhil.cli.guard import guard
from fdhil.cli.main import cli, iterate_commands
from fdhil.config.fleet_config import Fleet
from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.fleet.rollout import ChangeFile
from fdhil.fleet.signed_offer import ProposedChange
from fdhil.store.column_map import ColumnMap
from fdhil.store.window_file import encode_window
from studies import bench
from tests.bench import bench_document
from tests.daemon.machine_rig import fdhil
from tests.store.sample_records import make_published

ROOT = Path(__file__).parents[1]
PAGES = [
    path
    for path in sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md")])
    if path.parent.name not in ("studies", "reference")
]
LEAVES = dict(iterate_commands(cli))
NEEDS_A_MACHINE = {"sim", "run", "status", "demo", "web", "web-user", "publish"}
WINDOW = "configs/fdhil-data/windows/w00000001-X.parquet"


def find_blocks(page: Path, language: str) -> Iterator[str]:
    for found, body in re.findall(r"^```(\w+)\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
        if found == language:
            yield body


def list_commands(page: Path) -> list[str]:
    """Return the commands of the page's shell blocks, fenced or indented, in order, without comments."""
    text = page.read_text("utf-8")
    indented = re.findall(r"^    (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    shown = "\n".join([*find_blocks(page, "sh"), *find_blocks(page, "bash"), *indented])
    return [line.partition("  #")[0].strip() for line in shown.splitlines() if re.match(r"fdhil(-guard)? ", line)]


def list_mentions(page: Path) -> list[str]:
    found = re.findall(r"`(fdhil(?:-guard)? [^`]*)`", " ".join(page.read_text("utf-8").split()))
    return [line for line in found if not line.startswith("fdhil --")]


def find_command(line: str) -> tuple[click.Command, list[str]]:
    program, *words = shlex.split(line)
    if program == "fdhil-guard":
        return guard, words
    for count in (1, 2):
        if " ".join(words[:count]) in LEAVES:
            return LEAVES[" ".join(words[:count])], words[count:]
    raise click.UsageError(f"there is no command {words[0]}")


def find_faults(line: str, whole: bool) -> str:
    """Return the fault of a command line: options and, if ``whole``, the number of arguments."""
    try:
        command, words = find_command(line)
        context = click.Context(command)
        values, rest, _ = command.make_parser(context).parse_args(list(words))
    except click.UsageError as error:
        return f"{line}: {error}"
    for parameter in command.params:
        value = values.get(parameter.name or "")
        if isinstance(parameter.type, click.Choice) and isinstance(value, str) and value not in parameter.type.choices:
            return f"{line}: {value} is none of {', '.join(parameter.type.choices)}"
        missing = (
            isinstance(parameter, click.Argument)
            and parameter.required
            and not (isinstance(value, str | tuple) and value)
        )
        if whole and (missing or rest):
            return f"{line}: {parameter.name} is missing, or {rest} is too much"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_documented_command_exists(page: Path) -> None:
    assert [wrong for line in list_commands(page) if (wrong := find_faults(line, whole=True))] == []
    assert [wrong for line in list_mentions(page) if (wrong := find_faults(line, whole=False))] == []


def test_unknown_documented_command_is_detected() -> None:
    assert find_faults("fdhil predict part.ngc --config machine.toml", whole=True) == ""
    assert "foretell" in find_faults("fdhil foretell part.ngc", whole=True)
    assert "--colour" in find_faults("fdhil predict part.ngc --colour red", whole=False)
    assert "rain" in find_faults("fdhil correct part.ngc --method rain", whole=False)
    assert "missing" in find_faults("fdhil predict --config machine.toml", whole=True)


@pytest.mark.parametrize("name", LEAVES)
def test_help_ends_with_valid_example_and_exit_codes(name: str) -> None:
    text = LEAVES[name].get_help(click.Context(LEAVES[name], info_name=name))
    example = re.findall(r"Example:\n\s+(.*)", text)
    assert example[0].startswith(f"fdhil {name}")
    assert find_faults(example[0], whole=True) == ""
    assert "Exit codes:\n    0  " in text


# blocks that other tests run unchanged
RUN = {
    ("README.md", "python"): "tests/api/test_command_line.py",
    ("an-hour.md", "sh"): "tests/cli/test_tutorial.py",
    ("an-hour.md", "text"): "tests/cli/test_tutorial.py",
    ("extend.md", "python"): "tests/test_extend.py",
    ("test-your-master.md", "python"): "tests/test_pytest_plugin.py",
    ("rehearse-a-fault.md", "python"): "tests/sim/test_bus_faults.py",
}
GENERATED = ("benchmarks.md", "index.md")


def find_untried_blocks(page: Path) -> Iterator[str]:
    """Yield the first line of each block without a test and without a reason."""
    for before, language, body in re.findall(r"([^\n]*)\n```(\w*)\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
        commands = language in ("sh", "bash") and re.search(r"^fdhil(-guard)? ", body, re.MULTILINE)
        reported = re.fullmatch(r"<!-- not run: \S.* -->", before)
        if not (commands or reported or language == "toml" or (page.name, language) in RUN):
            yield body.partition("\n")[0]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_code_block_is_tried_or_marked(page: Path) -> None:
    if page.name not in GENERATED:
        assert list(find_untried_blocks(page)) == []


def test_untried_block_is_detected(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "text\n```text\nnot tried\n```\n<!-- not run: a drawing -->\n```text\nmarked\n```\n```toml\na = 1\n```\n"
    )
    assert list(find_untried_blocks(page)) == ["not tried"]
    assert all((ROOT / test).is_file() and name in (ROOT / test).read_text("utf-8") for (name, _), test in RUN.items())


@pytest.fixture
def configs_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of configs/ with a store of one rapid and one parameter set, as after ``fdhil run``."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    machine = config.load_config(tmp_path / "configs" / "sim.toml")
    store = OutcomeStore(machine)
    store.open()
    store.store_outcomes([make_published(1), make_published(1, "Y")])
    store.close()
    rapid = encode_window(simulate_nominal_rapid("X", machine.axis["X"], machine.machine.sync_period_s), machine.digest)
    (tmp_path / WINDOW).parent.mkdir(exist_ok=True)
    (tmp_path / WINDOW).write_bytes(rapid)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("page", ["README.md", "docs/tutorial/first-identification.md"])
def test_first_commands_run_unchanged(page: str, configs_copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ran = 0
    for line in list_commands(ROOT / page):
        line = line.replace("*.parquet", Path(WINDOW).name).replace("FILE.parquet", Path(WINDOW).name)
        name = shlex.split(line)[1]
        if line.startswith("fdhil ") and name not in NEEDS_A_MACHINE and "machine.toml" not in line:
            code, out, err = fdhil(*shlex.split(line)[1:], capsys=capsys)
            assert code == 0, f"{line}: {out}{err}"
            ran += 1
    assert ran >= 6
    assert [path.name for path in configs_copy.glob("*.csv")] != []


def change_rows(text: str, change: Callable[[list[list[str]]], list[list[str]]]) -> str:
    head, _, body = text.partition("time_s")
    names, *rows = [line.split(",") for line in f"time_s{body}".splitlines()]
    return head + "\n".join(",".join(row) for row in [names, *change(rows)]) + "\n"


def scale_column(column: int) -> Callable[[list[list[str]]], list[list[str]]]:
    return lambda rows: [[*row[:column], f"{1.2 * float(row[column]):.6f}", *row[column + 1 :]] for row in rows]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda rows: rows[:350] + rows[390:], "StaleData"),
        (lambda rows: [[*row[:2], rows[300][2], *row[3:]] if 300 <= k < 360 else row for k, row in enumerate(rows)],
         "StuckValue"),
        (scale_column(3), "CalibrationSuspect"),
        (scale_column(2), ""),
    ],
    ids=["rows deleted", "value repeated", "speed x 1.2", "current x 1.2"],
)  # fmt: skip
def test_tutorial_names_refusal_of_corrupted_rapid(
    change: Callable[[list[list[str]]], list[list[str]]], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a data sheet a constant gain error looks like another drive; every other damage is refused by code."""
    text = bench.format_as_csv(bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand()), 0.001)
    assert text.partition("time_s")[2].startswith(",voltage_V,current_A,speed_rad_per_s,")
    (tmp_path / "rapid.csv").write_text(change_rows(text, change))
    code, out, _ = fdhil("identify", tmp_path / "rapid.csv", capsys=capsys)
    assert (code, told in out) == (1 if told else 0, True), out
    assert not told or told in (ROOT / "docs/tutorial/first-identification.md").read_text("utf-8")


def merge_documents(document: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    for key, value in changes.items():
        document[key] = merge_documents(document.get(key, {}), value) if isinstance(value, dict) else value
    return document


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_configuration_fragment_is_valid(page: Path) -> None:
    for text in find_blocks(page, "toml"):
        piece = tomllib.loads(text)
        if "columns" in piece:
            ColumnMap.model_validate(piece)
        # neither a fault script nor a drive profile
        elif {"database", "retention"} & set(piece):
            Fleet.model_validate(piece)
        elif "set" in piece:
            ProposedChange.model_validate(ChangeFile.model_validate(piece).proposed_fields)
        elif not {"fault", "tpdos", "base"} & set(piece):
            assert config.parse_config(merge_documents(bench_document(), piece)).axis
    for text in find_blocks(page, "python"):
        compile(text, str(page), "exec")
