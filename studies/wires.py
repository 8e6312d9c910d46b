"""Spoilt wires (``python -m studies.wires``): is a stale or wrong value ever taken, and is every lost frame counted?

Late, doubled, damaged and foreign answers to fdhil's drivers of Modbus and SDO, and frames that are lost between
simulated drives and its decoder. The page goes to ``docs/studies/wires.md``, the figures beside it as JSON. Exit code 1
when a wrong value was taken within what the drivers promise, or a loss was counted wrongly.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fdhil.config.sensor_sections import ModbusDevice
from fdhil.drivers.can.frame_ring import pack_frames
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.errors import DeviceError
from fdhil.sim.frame_faults import FrameFault, FrameFaults
from fdhil.sim.wire.modbus_sensor import VoltageSensor
from fdhil.sim.wire.modbus_tcp_servers import SensorServers
from studies import pages
from studies.late_answers import Questioned, measure_modbus, measure_sdo_reads
from tests.drivers.frame_builder import FrameBuilder, build_machine_config

SPOILT = ("flipped", "noisy", "split", "wrong_unit", "short", "too_many")
LOSSES = {"TPDO1": {0x181}, "TPDO2": {0x281}, "SYNC": {0x80}, "any of the three": {0x80, 0x181, 0x281}}
PERCENT = (0.1, 1.0, 5.0)
TICKS = 4000
SDO = "SDO, late by up to 1.45 s, doubled, lost"
EDGE = 20  # cycles at either end of a recording in which nothing is lost, so that the end of it is no loss
TCP_TIMEOUT_S = 1.0


def query_over_tcp(questions: int, kind: str) -> Counter[str]:
    """Query a unit on a real TCP connection whose answers are corrupted now and then; counts as in ``modbus``."""
    sensor, device = VoltageSensor(1000.0, 300.0, 0.0, np.random.default_rng(1)), Questioned()
    sensor.faults.answers[kind] = 100.0 / 3
    servers = SensorServers({"X": sensor}, {"X": ("127.0.0.1", 0)}, {"X": device})
    servers.start()
    seen: Counter[str] = Counter()

    async def ask() -> None:
        link = ModbusUnit("sensor", ModbusDevice(port=servers.ports["X"], timeout_s=TCP_TIMEOUT_S))
        rng = random.Random(1)
        for question in range(questions):
            device.question = question
            count = rng.choice((1, 2, 4))
            seen["asked"] += 1
            try:
                await link.connect()
                got = await link.read_input_registers(0, count)
            except DeviceError:
                seen["refused"] += 1
                continue
            seen["answered"] += 1
            seen["wrong"] += got != [question & 0xFFFF] * count
        link.close()

    try:
        asyncio.run(ask())
    finally:
        servers.stop()
    return seen


def lose_frames(frames: int, seed: int, can_ids: set[int], percent: float) -> Counter[str]:
    """Lose some frames of a bus; count sent, lost and reported ones, and rows with another row's value."""
    seen: Counter[str] = Counter()
    while seen["frames"] < frames:
        wire = FrameBuilder(n=TICKS)
        fault = FrameFault("drop", can_ids=can_ids, percent=percent, from_sync=EDGE, until_sync=TICKS - EDGE)
        faults = FrameFaults([fault], seed + seen["frames"])
        decoder = BusDecoder("can0", build_machine_config())
        for samples in _decode_samples(wire, faults, decoder, seen):
            seen["rows"] += samples.tick.size
            for k, volts, amperes in zip(samples.tick, samples.voltage_v, samples.current_a, strict=True):
                true = (wire.build_tpdo2(int(k) + 1)[2] * 0.02, wire.build_tpdo2(int(k))[1] * 0.05)
                seen["misplaced"] += abs(volts - true[0]) > 1e-6 or abs(amperes - true[1]) > 1e-6
        reported = decoder.read_counters()
        seen["lost"] += faults.total("drop")
        seen["reported"] += reported["sync_missed"] + reported["pdo_lost"]
        seen["late"] += reported["pdo_late"] + reported["pdo_duplicates"]
    return seen


def _decode_samples(wire: FrameBuilder, faults: FrameFaults, decoder: BusDecoder, seen: Counter[str]) -> Iterator[Any]:
    """Yield the samples of a bus whose frames pass the faults, some at a time."""
    rows = wire.build_rows()
    seen["frames"] += len(rows)
    left = [
        (t, i, d) for t, can_id, data in rows for (i, d), _ in faults.process_frame((can_id, data), "received", 0.0)
    ]
    for start in range(0, len(left), 350):
        block = pack_frames(left[start : start + 350])
        for record in decoder.decode_frames(block, int(block["t_ns"][-1])):
            if hasattr(record, "voltage_v"):
                yield record


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return the counts of every part, and the goals by them."""
    n, seed = options.questions, options.seed
    promised = {
        "Modbus RTU, late by up to 2 time-outs": measure_modbus(5 * n // 2, seed, 2.0),
        "Modbus RTU, late, spoilt and noise": measure_modbus(n, seed + 1, 2.0, SPOILT, 0.3),
        "Modbus RTU, a register too many": measure_modbus(n, seed + 2, 0.5, ("too_many",)),
        "Modbus RTU, cut short": measure_modbus(n // 2, seed + 3, 0.5, ("short",)),
        "Modbus TCP, the answer before comes first": query_over_tcp(n // 100, "stale"),
        "Modbus TCP, a register too many": query_over_tcp(n // 100, "too_many"),
        SDO: measure_sdo_reads(3 * n // 10, seed, 1.45),
    }
    beyond = {
        "Modbus RTU, late by up to 10 time-outs": measure_modbus(n // 10, seed + 4, 10.0),
        "SDO, late by up to 6 s": measure_sdo_reads(n // 10, seed + 1, 6.0),
    }
    cases = [(name, percent) for name in LOSSES for percent in PERCENT]
    each = -(-options.frames // len(cases))
    frames = [
        [name, percent, lose_frames(each, seed + 1000 * place, LOSSES[name], percent)]
        for place, (name, percent) in enumerate(cases)
    ]
    return {"promised": promised, "beyond": beyond, "frames": frames} | {"goals": evaluate_goals(promised, frames)}


def evaluate_goals(promised: Mapping[str, Mapping[str, int]], frames: list[list[Any]]) -> dict[str, Any]:
    """Return the goals R8 and R9 by the counts."""
    wrong, late, corrupted = (
        sum(seen.get(key, 0) for seen in promised.values()) for key in ("wrong", "late", "spoilt")
    )
    stale = promised.get(SDO, {}).get("late", 0)
    lost, reported, sent = (sum(seen.get(key, 0) for _, _, seen in frames) for key in ("lost", "reported", "frames"))
    modbus = f"{wrong} of {late - stale:,} stale and {corrupted:,} wrong Modbus answers"
    told_of = f"{modbus} and {stale:,} stale SDO answers taken"
    exact = all(seen.get("lost", 0) == seen.get("reported", 0) and not seen.get("misplaced") for _, _, seen in frames)
    return {
        "R8": {"met": wrong == 0, "figure": told_of},
        "R9": {"met": exact, "figure": f"{reported:,} reported of {lost:,} lost among {sent:,} frames"},
    }


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page; its conclusions follow from the figures."""
    reported = figures["goals"]
    lines = pages.write_head("Spoilt wires", "wires", run)
    lines += pages.wrap_paragraph(f"**{reported['R8']['figure']}; {reported['R9']['figure']}.**")
    lines += pages.wrap_paragraph(
        """What is asked for changes with every question, so an answer to another question is known by its value. Nine
        of ten answers on a serial line take a while, late is what came after the time-out. Where the row says how, more
        than half are spoilt; in the second row a sixth are, each in its way, and noise stands on the line in a third of
        the questions. Time is virtual on the serial line and for SDO (it passes by being waited for); the drivers are
        the product's own. The TCP connection is a real one."""
    )
    lines += [*_describe_answers(figures["promised"]), ""]
    lines += pages.wrap_paragraph(
        """What no protocol on a serial line can tell: an answer names neither its question nor its time. fdhil hears
        the line out for a second time-out after a question that was not answered, and an SDO server for a second. What
        comes later than that may meet the next question of the same kind, so `timeout_s` must be at least half of the
        longest time that a device may take:"""
    )
    lines += [*_describe_answers(figures["beyond"]), ""]
    lines += pages.wrap_paragraph(
        """Frames that are lost between drive and decoder, SYNCs among them. A row is misplaced when it has the value of
        another row; late is what was taken for a frame that came too late or twice."""
    )
    columns = ("frames", "lost", "reported", "late", "misplaced")
    rows = [
        [name, f"{percent:g} %", *(f"{seen.get(key, 0):,}" for key in columns)]
        for name, percent, seen in figures["frames"]
    ]
    lines += pages.write_table(
        ("lost at random", "share", "frames", "lost", "reported", "late", "rows misplaced"), rows
    )
    return "\n".join(lines)


def _describe_answers(parts: Mapping[str, Mapping[str, int]]) -> list[str]:
    names = ("asked", "answered", "refused", "late", "spoilt", "wrong")
    rows = [[name, *(f"{seen.get(key, 0):,}" for key in names)] for name, seen in parts.items()]
    return pages.write_table(("answers", *names), rows)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--questions", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    figures = pages.run_study("wires", parser, lambda options: str(options.seed), measure)
    sys.exit(not all(goal["met"] for goal in figures["goals"].values()))


if __name__ == "__main__":
    main()
