"""Generated documents are current, and links resolve."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder

from fdhil import config, tables

ROOT = Path(__file__).parents[1]
TEMPLATE = ROOT / "configs" / "machine-template.toml"
PAGES = sorted(path for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


def test_code_overview_names_existing_files() -> None:
    page = (ROOT / "docs" / "explanation" / "code-overview.md").read_text("utf-8")
    named = set(re.findall(r"`((?:fdhil|studies)/[\w/.]*)`", page))
    assert len(named) > 40
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


@pytest.mark.usefixtures("processes")
def test_generated_files_are_current() -> None:
    """In a separate process, because click caches the help option."""
    command = [sys.executable, str(ROOT / "docs" / "generate.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def uncomment_lines(text: str, *chosen: str) -> str:
    """Return the template with the chosen settings and sections uncommented."""
    lines, section = [], ""
    for line in text.splitlines():
        bare = line[1:] if re.match(r"#[A-Za-z\[]", line) else line
        section = bare if bare.startswith("[") else section
        lines.append(bare if bare in chosen or section in chosen else line)
    return "\n".join(lines)


def load_template(tmp_path: Path, text: str) -> config.MachineConfig:
    path = tmp_path / "machine.toml"
    path.write_text(text, "utf-8")
    return config.load_config(path)


def test_unchanged_template_sends_nothing() -> None:
    machine = config.load_config(TEMPLATE)
    assert list(machine.axis) == ["X"]
    assert machine.axis["X"].correction is None
    assert machine.axis["X"].feedforward is None
    assert machine.axis["X"].temperature is None


def test_each_optional_template_block_can_be_uncommented(tmp_path: Path) -> None:
    text = TEMPLATE.read_text("utf-8")
    blocks = re.findall(r"^#(\[.*\])$", text, re.MULTILINE)
    assert {"[axis.X.correction]", "[axis.X.feedforward]", "[axis.X.temperature]", "[sim]"} <= set(blocks)
    for block in blocks:
        assert load_template(tmp_path, uncomment_lines(text, block)).digest, block
    machine = load_template(tmp_path, uncomment_lines(text, "[axis.X.feedforward]"))
    assert machine.axis["X"].feedforward == config.FeedforwardLimits()


def test_each_template_section_can_be_uncommented_and_shows_defaults(tmp_path: Path) -> None:
    text = TEMPLATE.read_text("utf-8")
    sections = re.findall(r"^#?(\[.*\])$", text, re.MULTILINE)
    everything, as_it_stands = load_template(tmp_path, uncomment_lines(text, *sections)), config.load_config(TEMPLATE)
    assert everything.nc == as_it_stands.nc
    examples = {"run_directory": None, "daemon_user": None}  # keys without a default
    assert everything.guard.model_copy(update=examples) == as_it_stands.guard
    for section in sections:
        assert load_template(tmp_path, uncomment_lines(text, section)).digest, section


@pytest.mark.parametrize(
    "model", [config.Thermometer, config.FeedforwardLimits, config.CanBus, config.SimAxis, config.Reality]
)
def test_comments_are_directly_above_their_keys(model: type[config.Section]) -> None:
    text = TEMPLATE.read_text("utf-8")
    header, _, words = (model.__doc__ or "").partition(": ")
    name = header.replace("NAME", "can0")
    assert f"\n\n# {words[0].upper()}{words[1:]}\n{name}\n" in text.replace(f"#{name}", name)
    block = text.split(f"{name}\n")[1].split("\n\n")[0]
    keys = [f"# {field.description}\n#{key} = " for key, field in model.model_fields.items() if field.description]
    assert [key for key in keys if key not in block] == []


def test_error_reference_has_complete_sentences() -> None:
    rows = re.findall(
        r"^\| `\w+` \| \d \| (.*) \|$", (ROOT / "docs/reference/errors.md").read_text("utf-8"), re.MULTILINE
    )
    assert len(rows) > 10
    assert [row for row in rows if not row.endswith(".")] == []


@pytest.mark.parametrize("path", sorted(ROOT.glob("configs/*.toml")), ids=lambda path: path.name)
def test_every_shipped_config_is_valid(path: Path) -> None:
    assert config.load_config(path).axis


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_document_link_resolves(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text("utf-8")):
        assert (page.parent / target).exists(), f"{page}: {target}"


@pytest.mark.parametrize(
    "table", [name for name, value in vars(tables).items() if isinstance(value, dict) and name.isupper()]
)
def test_every_registered_entry_is_tested(table: str) -> None:
    """The suite of each table runs over all its entries."""
    runs_over_all = re.compile(rf"(parametrize\(.*|params=list\(|for name in )tables\.{table}\b")
    assert any(runs_over_all.search(path.read_text("utf-8")) for path in (ROOT / "tests").glob("**/test_*.py"))


def test_license_security_and_contributing_files_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    shipped = project["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert [name for name in shipped if not (ROOT / name[1:]).exists()] == []
    assert project["project"]["license-files"] == ["LICENSE"]
    assert "MIT License" in (ROOT / "LICENSE").read_text("utf-8")
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"\nversion: {project['project']['version']}\n" in citation
    assert "\ncff-version: 1.2.0\n" in f"\n{citation}"


def test_decision_index_lists_every_page_once_in_order() -> None:
    folder = ROOT / "docs" / "decisions"
    listed = re.findall(r"^(\d+)\. \[(.*)\]\((.*)\)$", (folder / "README.md").read_text("utf-8"), re.MULTILINE)
    assert [target for _, _, target in listed] == sorted(path.name for path in folder.glob("0*.md"))
    for number, title, target in listed:
        assert target.startswith(f"{int(number):04}-")
        assert (folder / target).read_text("utf-8").startswith(f"# {number}. {title}")


@pytest.mark.usefixtures("long_computation")
def test_source_archive_has_exactly_the_needed_files(tmp_path: Path) -> None:
    archive = next(iter(SdistBuilder(str(ROOT)).build(directory=str(tmp_path))))
    with tarfile.open(archive) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    needed = {"LICENSE", "CITATION.cff", "SECURITY.md", "README.md", "CHANGELOG.md", "Makefile", "requirements.lock"}
    needed |= {
        "systemd/fdhil-guard.service",
        "configs/machine-template.toml",
        "docs/studies/drift.json",
        "tests/bench.py",
    }
    assert needed <= names
    assert [name for name in names if re.search(r"__pycache__|\.venv|fdhil-data|\.parquet$|^out/|^\.git/", name)] == []


def test_every_window_refusal_is_explained() -> None:
    paths = [*ROOT.glob("fdhil/validation/*.py"), ROOT / "fdhil" / "pipeline" / "validated_pool.py"]
    sources = "".join(path.read_text("utf-8") for path in paths)
    codes = set(re.findall(r'"([A-Z][a-z]+[A-Z][A-Za-z]+)"', sources))
    codes |= set(re.findall(r'Reason\(\s*"([A-Z][A-Za-z]+)"', sources))
    assert {"NotFinite", "StaleData", "LoadDetected", "NoWindow", "Quantised"} <= codes
    page = (ROOT / "docs" / "explanation" / "verdicts.md").read_text("utf-8")
    assert [code for code in sorted(codes) if f"`{code}" not in page] == []
