"""Demonstration on a machine with realistic imperfections: accepted rapids, identified models and correction."""

import multiprocessing
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from fdhil.child_process import interrupt_on_stop_signals, request_parent_death_signal
from fdhil.cli.demo.demo_page import CutPass, Published
from fdhil.cli.demo.loop import (
    DemoRig,
    Say,
    compute_true_parameters,
    cut_path,
    make_folder,
    play_shuttle,
    start_machine,
    summarise_published_set,
)
from fdhil.cli.demo.machines import REAL, load_machine_document
from fdhil.config import MachineConfig
from fdhil.errors import ConnectError, FdhilError
from fdhil.prediction import load_validated_models, predict_path, select_models
from fdhil.program import load_trajectory
from fdhil.records import Parameters, Prediction
from fdhil.store import History, read_newest_parameters

AMBIENT_C = 20.0


@dataclass(frozen=True, slots=True)
class AxisOutcome:
    """Result of one axis: published set, accepted and total rapids, and reasons of the refusals."""

    published: Published | None
    accepted: int
    rapids: int
    reasons: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class RealisticResult:
    """Results of the realistic machine; ``refused`` is the reason of a refused correction, or empty."""

    config: MachineConfig
    truth: Mapping[str, Parameters]
    verdicts: Mapping[str, AxisOutcome]
    predicted: Prediction | None
    cuts: Sequence[CutPass]
    refused: str


@contextmanager
def run_realistic_in_process(out: Path, realtime: bool, say: Say) -> Iterator[Callable[[], RealisticResult]]:
    """Run ``run_realistic`` in a separate process during a with block; yield a function that waits for the result.

    Raises FdhilError if a step fails. The process and its machine end with the block.
    """
    make_folder(out)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    arguments = (sender, os.getpid(), out, realtime, lambda text: say(f"realistic machine: {text}"))
    child = context.Process(target=_send_realistic, args=arguments, name="realistic machine")
    child.start()
    sender.close()

    def await_result() -> RealisticResult:
        try:
            outcome: RealisticResult | tuple[type[FdhilError], str] = receiver.recv()
        except EOFError:
            raise ConnectError("realistic machine", f"its process ended early; see the logs in {out}") from None
        if isinstance(outcome, RealisticResult):
            return outcome
        kind, text = outcome
        raise kind.__new__(kind, text)

    try:
        yield await_result
    finally:
        child.terminate()
        child.join()
        receiver.close()


def _send_realistic(sender: Connection, parent: int, out: Path, realtime: bool, say: Say) -> None:
    try:
        with interrupt_on_stop_signals():
            request_parent_death_signal(parent)
            sender.send(run_realistic(out, realtime, say))
    except FdhilError as error:
        sender.send((type(error), str(error)))
    except KeyboardInterrupt:  # the demonstration was interrupted
        return


def run_realistic(out: Path, realtime: bool, say: Say) -> RealisticResult:
    """Identify and execute the path in ``out``. Raises FdhilError if a step fails; a refusal is a result."""
    say("the same with realistic friction, weight, ripples, screw compliance and inverter")
    with start_machine(out, realtime, say, load_machine_document(REAL)) as stage:
        say("shuttling both axes at rapid speed")
        play_shuttle(stage)
        verdicts = {axis: _summarise_axis(stage, axis) for axis in stage.config.axis}
        cut_path(stage, "uncorrected", AMBIENT_C)
        refused = _cut_with_inverse(stage)
        plants = compute_true_parameters(stage.config)
        return RealisticResult(stage.config, plants, verdicts, _predict_path(stage), stage.cuts, refused)


def _summarise_axis(stage: DemoRig, axis: str) -> AxisOutcome:
    with History.open_read_only(stage.config.store.directory) as history:
        sets, windows = history.read_revisions(axis, limit=1), history.read_windows(axis)
    reasons = Counter(reason.partition(":")[0] for window in windows for reason in window.reasons)
    accepted = sum(window.accepted for window in windows)
    stage.show_progress(
        f"{axis}: {accepted} of {len(windows)} rapids accepted, {'a' if sets else 'no'} model published"
    )
    return AxisOutcome(summarise_published_set(sets[0].set) if sets else None, accepted, len(windows), reasons)


def _predict_path(stage: DemoRig) -> Prediction | None:
    # None unless every axis has a published model
    source, program = str(stage.config.store.directory), stage.programs["10 m/min"]
    newest = read_newest_parameters(stage.config.store.directory, stage.config.axis)
    if len(newest) < len(stage.config.axis):
        return None
    sets = {axis: revision.set for axis, revision in newest.items()}
    models, config = load_validated_models(sets, stage.config, source)
    reference = load_trajectory(program, config)
    return predict_path(reference, select_models(reference, models, config, source), config)


def _cut_with_inverse(stage: DemoRig) -> str:
    # the daemon's text if it refuses, else empty
    try:
        cut_path(stage, "inverse", AMBIENT_C, "inverse")
    except FdhilError as error:
        stage.show_progress(f"not corrected: {error}")
        return str(error)
    return ""
