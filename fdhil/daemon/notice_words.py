"""Says of each class of notice what it means for the machine, and what to do next; the cause is the notice's own text.

What the guard watches has its words in the guard's own table (``fdhil/guard/interlocks.py``); the others are here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from fdhil.guard.interlocks import CATALOGUE, EFFECT, LATE
from fdhil.records import Notice

_CLASS = re.compile(r"\b([A-Z][A-Za-z]+): ")
_SEE_WHAT_STANDS = "see fdhil status; where an offset may stand, hold the feed and run fdhil adopt"
_UNSENT = "nothing moves by it: no correction was on"
_OLD_SET = "the set published before stays in force"
_NO_VOLTAGE = "the rapids of this axis are not identified while its voltage is missing"
WORDS: Mapping[str, tuple[str, str]] = {
    # the guard and what is armed
    "GuardState": ("the correction stands as the text says", _SEE_WHAT_STANDS),
    "GuardFound": ("an offset of before may still be applied where the text says so", _SEE_WHAT_STANDS),
    "GuardLost": ("what the guard sent last may still be applied", "hold the feed, start fdhil-guard, run fdhil adopt"),
    "ArmRefused": (_UNSENT, "do what the refusal says, then arm again"),
    "Armed": ("the correction begins with the program", "nothing; disarm when it is not wanted"),
    "CheckBehind": (
        "the correction may end before the program does",
        "ease this PC, or arm with --whole, which waits for the whole check",
    ),
    "StreamRefused": ("the correction ends early, ramped to zero", "see the refusal in the text, then arm again"),
    "PassMeasured": ("the pass has been cut as it was", "where it was worse than predicted, identify again"),
    "GuardTripped": ("the correction was ended by the guard", "see the cause, then arm again when it is wanted"),
    "SocketLost": (
        "a running correction is ramped to zero where nobody could ask for that any more",
        "keep the run directory from being cleaned (tmpfiles.d); where it could not be made again, see its rights",
    ),
    "BlackBox": ("none: the frames around a stop are kept", "look at it on the page events, or with candump's tools"),
    # what is heard of the machine
    "SourceLost": ("nothing is heard, so nothing is identified meanwhile", "see the cause in the text"),
    "BusSilent": ("nothing is heard of the drives on this bus", "see whether the NC is on; check wiring and bit rate"),
    "BusErrors": ("frames are sent again, which takes their time", "check termination, shield and bit rate"),
    "TransceiverFault": ("frames may be lost", "check the cable for breaks and shorts"),
    "NotAcknowledged": ("no node takes what is sent", "check the drives' supply, wiring and bit rate"),
    "CoarseStamps": ("the inductance is less certain", "use an interface that stamps frames in its hardware"),
    "SyncPeriodSuspect": ("what is identified is wrong by that share", "correct sync_period_s, or the NC's period"),
    "NodeNeverHeard": ("nothing is known of this axis", "check node_id, the drive's supply and its wiring"),
    "NoSamples": ("nothing is known of this axis", "compare the drive's mapping with the configuration: fdhil check"),
    "PdoMissing": ("the samples of this axis have gaps, or none come", "compare the drive's mapping: fdhil check"),
    "LateFrame": ("the samples around it are left out", "see whether the bus is too busy, or the drive too slow"),
    "PdoIrregular": ("samples cannot be placed, and are not used", "set the drive's TPDOs to be sent at each SYNC"),
    "DemandMismatch": ("the samples of this axis cannot be trusted", "check who sends set-points, and their delay"),
    "ScaleSuspect": ("what is identified is wrong by that share", "compare the scaling with the drive: fdhil check"),
    "PitchSuspect": ("what is identified is wrong by that share", "compare screw_pitch_mm with the machine"),
    "MovesNotUsed": ("no rapid of this axis is identified", "see the reason in the text; look at [g0]"),
    "NcSilent": ("rapid moves cannot be recognised; none is used", "see that the NC and its interface run"),
    "GantrySkew": (
        "the beam may be skewed; a correction of this machine is ramped to zero",
        "stop the axis, compare both drives' positions and couplings, then arm again",
    ),
    # sensors
    "ModbusTimeout": (_NO_VOLTAGE, "check the sensor's supply, address and wiring"),
    "ModbusException": (_NO_VOLTAGE, "compare the registers with the sensor's manual"),
    "ModbusCrc": (_NO_VOLTAGE, "check shield, termination and baud rate of the line"),
    "ModbusShape": (_NO_VOLTAGE, "compare the registers with the sensor's manual"),
    "ModbusStale": (_NO_VOLTAGE, "lengthen the sensor's timeout, or ease the line"),
    "RegisterTear": ("that answer is left out", "if it comes often, have the sensor hold a block while it is read"),
    "ModbusUnit": (_NO_VOLTAGE, "see that no two sensors have one address"),
    "ModbusPortGone": (_NO_VOLTAGE, "check the sensor's supply and cable; it is tried again until it answers"),
    "SerialTimeout": ("its values are missing meanwhile", "check the instrument's supply and cable"),
    "SerialShape": ("its values are missing meanwhile", "compare the instrument's lines with its configuration"),
    "SerialPortGone": ("its values are missing meanwhile", "check the cable; it is tried again until it is back"),
    "StuckValue": ("the voltage is not believed, its rapids are refused", "check the sensor and its measuring circuit"),
    "SampleTiming": ("the voltage is placed less well, so that L is less certain", "ease the sensor's line"),
    "TableSilent": ("the error at the table is not measured", "check the table's encoder and its cable"),
    # what the rapids tell
    "ValidationFailed": (_OLD_SET, "look at the newest rapids and why they were refused"),
    "LoadChanged": ("predictions are made for the load before it", "see whether the load is meant"),
    "ParameterJump": (_OLD_SET + " until more rapids agree", "look at the axis; more rapids confirm it or not"),
    "MaintenanceDue": ("the axis still works, but its condition has degraded", "plan the maintenance of this axis"),
    "CalibrationSuspect": ("a sensor's gain may be wrong, and K, R with it", "compare the sensor with another one"),
    # this PC
    "ResourceHigh": ("the system ends the daemon when nothing is left", "restart it at rest, and report what grew"),
    "ClockJump": ("none; the history is dated by that clock, its order holds", "see that this PC's clock is set right"),
    "OfferWaits": (
        "none: nothing is changed until somebody accepts it",
        "look at it with fdhil offers list, then accept or reject it",
    ),
    "ConfigUnlikely": ("what is identified may be wrong", "see whether the value in the text is meant"),
    "CorruptFile": ("what was damaged is not used", "check the disk"),
    "StrayFiles": ("none: they are left alone", "move them out of the store"),
    "StoreFault": ("nothing is kept, and nothing can be armed", "check the disk and its rights"),
    "DiskFull": ("nothing is kept, and nothing can be armed", "free the disk"),
    "StoreReplaced": (
        "what was recorded since that file was written is in no history; identification goes on",
        "stop the daemon before you restore a backup; bring back the file that was moved away where it is wanted",
    ),
    "StoreRecovered": ("what came in between was not kept", "arm again when it is wanted"),
    "SchemaVersion": ("nothing is kept, and nothing can be armed", "use the fdhil that wrote the store"),
}  # fmt: skip


def words_of(notice: Notice) -> tuple[str, str]:
    """Return effect and next action; empty where the notice's own text says all that there is to say.

    A refusal, or a change of the guard's state, names the class that caused it: what to do is that class' own action.
    """
    inner = next((code for code in _CLASS.findall(notice.text) if code in CATALOGUE), None)
    effect, action = WORDS.get(notice.code, ("", ""))
    if inner is None:
        return (effect, action) if notice.code in WORDS else _of_guard(notice.code)
    sent = EFFECT[CATALOGUE[inner][0]]
    cause = "PcLate" if LATE in notice.text else inner
    return sent if sent in notice.text else effect, CATALOGUE[cause][2]


def _of_guard(code: str) -> tuple[str, str]:
    """Return the words of what the guard watches too: its effect is one on a correction that runs."""
    if code not in CATALOGUE:
        return "", ""
    reaction, _, action = CATALOGUE[code]
    return f"while a correction runs: {EFFECT[reaction]}", action
