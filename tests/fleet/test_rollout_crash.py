"""An acceptance is atomic at any failing call: the configuration is the complete old or new one."""

from __future__ import annotations

import contextlib
import io
import tempfile
from functools import partial
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.cli.main import cli, run_safely
from fdhil.config.toml_editing import edit_toml
from fdhil.errors import ConfigError, FdhilError, StoreError
from fdhil.store.atomic_file import write_file
from fdhil.store.change_offers import read_decisions
from tests.crash import call_faults, disks
from tests.crash.loops import KINDS, Kind, tried
from tests.crash.stored_records import Plain
from tests.fleet.offer_signing import OfferSigner, create_machine

KEY = "axis.X.nominal.ft"
VERSIONS = (1, 2, 3, 4, 9)
STATES = (0, *VERSIONS)


class RefusedAcceptance(FdhilError): ...


class AcceptanceScenario(Plain):
    """A machine that accepts successive versions, each by the command itself; a record is a version."""

    offers: Path
    first: str  # the configuration before any

    @classmethod
    def prepare(cls, folder: Path) -> None:
        works = OfferSigner(folder)
        cls.first = create_machine(works, folder / "first").read_text()
        for version in VERSIONS:
            values = {KEY: cls.value(version)}
            (folder / f"{version}.offer").write_bytes(works.sign_document(version=version, values=values))
        cls.offers = folder

    @staticmethod
    def value(version: int) -> float:
        return 0.05 + version * 0.001

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.file = folder / "machine.toml"
        if not self.file.exists():
            write_file(self.file, self.first.encode())

    def keep(self, number: int) -> None:
        words = ["offers", "accept", self.file, self.offers / f"{number}.offer", "--by", "Bert"]
        message = io.StringIO()
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(message):
            patch.setattr("sys.argv", ["fdhil", *map(str, words)])
            with contextlib.redirect_stdout(io.StringIO()):
                code = run_safely(cli)
        if code:
            raise RefusedAcceptance(message.getvalue().replace(" (check", "; check"))

    def found(self) -> set[int]:
        """Return the recorded accepted versions; AssertionError for a file that never existed in this form.

        A kernel that falsely confirms a write leaves an invalid file, which is detected when read: StoreError.
        """
        try:
            machine_config.load_config(self.file)
        except ConfigError as error:
            raise StoreError(f"{error}; bring the old one back") from None
        texts = [self._text(version) for version in STATES]
        for kept in self.folder.glob("machine.toml.before-*"):
            assert kept.read_text() in texts, f"{kept.name} is half"
        assert self.file.read_text() in texts, "the configuration is half"
        now = STATES[texts.index(self.file.read_text())]
        accepted = {each.version for each in read_decisions(self.folder / "fdhil-data")}
        assert now >= max(accepted, default=0), f"version {now} is in force"
        return accepted

    def _text(self, version: int) -> str:
        note = f"friction version {version}"
        return edit_toml(self.first, {KEY: self.value(version)}, note) if version else self.first


@pytest.fixture
def offers(tmp_path: Path) -> Path:
    folder = Path(tempfile.mkdtemp(dir=tmp_path))
    AcceptanceScenario.prepare(folder)
    return folder


@pytest.mark.debian
def test_acceptance_is_atomic_at_any_failing_call(
    offers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(
        KINDS, "acceptances", Kind(AcceptanceScenario, partial(call_faults.keep_some, AcceptanceScenario))
    )
    found = tried("acceptances", tmp_path / "tried", most=16)
    assert found.wrong == []
    assert found.acknowledged > 0
    assert sum(found.runs.values()) > 8


@pytest.mark.usefixtures("processes")
def test_full_disk_undoes_no_acceptance(offers: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    reported = disks.filled(AcceptanceScenario, tmp_path / "disk", free_bytes=0)
    assert (reported.wrong, reported.ended) == ([], True)
    assert set(reported.kept) - {9} <= set(reported.found)
    assert 1 in reported.found
    assert reported.refused
    assert all("the disk is full" in text or "No space left" in text for text in reported.refused)
