"""Runs the demonstration on a machine with what real ones have: what fdhil believes of it, and what that is worth."""

import multiprocessing
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from fdhil.child import end_with, stopping_in_order
from fdhil.cli.demo.loop import Say, Stage, cut, make_folder, play_shuttle, published_of, running, true_plants
from fdhil.cli.demo.machines import REAL, machine_document
from fdhil.cli.demo.report import Cut, Published
from fdhil.config import MachineConfig
from fdhil.errors import ConnectError, FdhilError
from fdhil.prediction import predict
from fdhil.prediction.models import models_for, validated_models
from fdhil.program import load_trajectory
from fdhil.records import Parameters, Prediction
from fdhil.store.history import History
from fdhil.store.newest_sets import read_newest_sets

AMBIENT_C = 20.0


@dataclass(frozen=True, slots=True)
class AxisVerdict:
    """What fdhil makes of one axis: what it published, how many rapids it believed, and why not the others."""

    published: Published | None
    believed: int
    rapids: int
    reasons: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Realistic:
    """All that was measured on the realistic machine; ``refused`` is why no correction was sent, empty if one was."""

    config: MachineConfig
    truth: Mapping[str, Parameters]
    verdicts: Mapping[str, AxisVerdict]
    predicted: Prediction | None
    cuts: Sequence[Cut]
    refused: str


@contextmanager
def running_realistic(out: Path, realtime: bool, say: Say) -> Iterator[Callable[[], Realistic]]:
    """Run ``run_realistic`` in a process of its own during a with block; what it gives waits for the result.

    FdhilError when a step fails. The process, and its machine, end with the block.
    """
    make_folder(out)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    arguments = (sender, os.getpid(), out, realtime, lambda text: say(f"realistic machine: {text}"))
    child = context.Process(target=_send_realistic, args=arguments, name="realistic machine")
    child.start()
    sender.close()

    def result() -> Realistic:
        try:
            outcome: Realistic | tuple[type[FdhilError], str] = receiver.recv()
        except EOFError:
            raise ConnectError("realistic machine", f"its process ended early; see the logs in {out}") from None
        if isinstance(outcome, Realistic):
            return outcome
        kind, text = outcome
        raise kind.__new__(kind, text)

    try:
        yield result
    finally:
        child.terminate()
        child.join()
        receiver.close()


def _send_realistic(sender: Connection, parent: int, out: Path, realtime: bool, say: Say) -> None:
    try:
        with stopping_in_order():
            end_with(parent)
            sender.send(run_realistic(out, realtime, say))
    except FdhilError as error:
        sender.send((type(error), str(error)))
    except KeyboardInterrupt:  # the demonstration ends
        return


def run_realistic(out: Path, realtime: bool, say: Say) -> Realistic:
    """Shuttle, identify and cut below ``out``; FdhilError when a step fails, while a refusal is an answer."""
    say("the same with what real ones have: friction, weight, ripples, a soft screw, an inverter")
    with running(out, realtime, say, machine_document(REAL)) as stage:
        say("shuttling both axes at rapid speed, listening")
        play_shuttle(stage)
        verdicts = {axis: _verdict(stage, axis) for axis in stage.config.axis}
        cut(stage, "uncorrected", AMBIENT_C)
        refused = _corrected(stage)
        plants = true_plants(stage.config)
        return Realistic(stage.config, plants, verdicts, _predicted(stage), stage.cuts, refused)


def _verdict(stage: Stage, axis: str) -> AxisVerdict:
    with History.read(stage.config.store.directory) as history:
        sets, windows = history.revisions(axis, limit=1), history.windows(axis)
    reasons = Counter(reason.partition(":")[0] for window in windows for reason in window.reasons)
    believed = sum(window.accepted for window in windows)
    stage.say(f"{axis}: {believed} of {len(windows)} rapids believed, {'a' if sets else 'no'} model published")
    return AxisVerdict(published_of(sets[0].set) if sets else None, believed, len(windows), reasons)


def _predicted(stage: Stage) -> Prediction | None:
    """Return what the published models predict, with their loops; None unless there is one of every axis."""
    source, program = str(stage.config.store.directory), stage.programs["10 m/min"]
    newest = read_newest_sets(stage.config.store.directory, stage.config.axis)
    if len(newest) < len(stage.config.axis):
        return None
    sets = {axis: revision.set for axis, revision in newest.items()}
    models, config = validated_models(sets, stage.config, source)
    reference = load_trajectory(program, config)
    return predict(reference, models_for(reference, models, config, source), config)


def _corrected(stage: Stage) -> str:
    """Cut by the inverse; return why not, in the daemon's words, where it refuses."""
    try:
        cut(stage, "inverse", AMBIENT_C, "inverse")
    except FdhilError as error:
        stage.say(f"not corrected: {error}")
        return str(error)
    return ""
