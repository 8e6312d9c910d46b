"""The dependencies of fdhil: each package is pinned by its hash, and nothing else is installed."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LOCK = (ROOT / "requirements.lock").read_text("utf-8")
WHEEL = "harmless-1.0-py3-none-any.whl"


def read_lock() -> dict[str, list[str]]:
    """Return the hashes of each package of the lock."""
    entries = re.split(r"\n(?=[A-Za-z0-9])", LOCK.replace("\\\n", " "))
    named = {match[1].lower(): entry for entry in entries if (match := re.match(r"([A-Za-z0-9._-]+)==", entry.strip()))}
    return {name: re.findall(r"--hash=sha256:([0-9a-f]{64})", entry) for name, entry in named.items()}


@pytest.mark.fault("G14")
def test_every_package_is_pinned_by_hash() -> None:
    packages = read_lock()
    assert len(packages) > 100
    assert [name for name, hashes in packages.items() if not hashes] == []


def test_every_dependency_is_in_the_lock() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    wanted = [*project["project"]["dependencies"], *project["dependency-groups"]["dev"]]
    wanted += [each for extra in project["project"]["optional-dependencies"].values() for each in extra]
    names = {re.split(r"[\[<>=~! ]", each)[0].lower().replace("_", "-") for each in wanted}
    assert names - set(read_lock()) == set()


def make_wheel(folder: Path, says: str) -> str:
    path = folder / WHEEL
    about = {"METADATA": "Metadata-Version: 2.1\nName: harmless\nVersion: 1.0\n", "RECORD": ""}
    about["WHEEL"] = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("harmless.py", says)
        for name, text in about.items():
            archive.writestr(f"harmless-1.0.dist-info/{name}", text)
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.usefixtures("processes")
@pytest.mark.fault("G14")
def test_package_with_wrong_hash_is_not_installed(tmp_path: Path) -> None:
    """With the options of the Makefile and of the unit's instructions."""
    honest = make_wheel(tmp_path, "print('good')")
    (tmp_path / "requirements.lock").write_text(f"harmless==1.0 --hash=sha256:{honest}\n")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index"]
    command += [
        "--find-links",
        str(tmp_path),
        "--no-deps",
        "--require-hashes",
        "-r",
        str(tmp_path / "requirements.lock"),
    ]
    assert subprocess.run([*command, "--target", str(tmp_path / "a")], capture_output=True, check=False).returncode == 0
    make_wheel(tmp_path, "import os; os.system('evil')")
    reported = subprocess.run([*command, "--target", str(tmp_path / "b")], capture_output=True, text=True, check=False)
    assert reported.returncode != 0
    assert "DO NOT MATCH THE HASHES" in reported.stderr
    assert not (tmp_path / "b").exists()


def test_makefile_and_instructions_install_by_hash() -> None:
    for name in ("Makefile", "docs/how-to/service.md"):
        text = (ROOT / name).read_text("utf-8")
        assert "--require-hashes -r requirements.lock" in text, name
