"""Lists the effect on the machine and the next action of each class of notice; the notice has the cause.

Classes of the guard have their texts in ``fdhil/guard/interlocks.py``; all others are here.
"""

import re
from collections.abc import Mapping

from fdhil.guard import INTERLOCK_CATALOGUE, LATE_PC, REACTION_EFFECTS
from fdhil.records import Notice

_CLASS = re.compile(r"\b([A-Z][A-Za-z]+): ")
_SEE_WHAT_STANDS = "see fdhil status; where an offset may be applied, hold the feed and run fdhil adopt"
_UNSENT = "no effect on the machine: no correction was active"
_OLD_SET = "the previously published parameters stay in force"
_NO_VOLTAGE = "rapids of this axis are not identified while its voltage is missing"
WORDS: Mapping[str, tuple[str, str]] = {
    # the guard and what is armed
    "GuardState": ("the state of the correction is in the text", _SEE_WHAT_STANDS),
    "GuardFound": ("an earlier offset may still be applied; see the text", _SEE_WHAT_STANDS),
    "GuardLost": ("the offset sent last may still be applied", "hold the feed, start fdhil-guard, run fdhil adopt"),
    "ArmRefused": (_UNSENT, "do what the refusal says, then arm again"),
    "Armed": ("the correction begins with the program", "none; disarm when the correction is not wanted"),
    "CheckBehind": (
        "the correction may end before the program does",
        "reduce the load of this PC, or arm with --whole, which waits for the whole check",
    ),
    "StreamRefused": ("the correction ends early, ramped to zero", "see the refusal in the text, then arm again"),
    "PassMeasured": ("none: the pass is finished", "if the error exceeds the prediction, identify again"),
    "GuardTripped": ("the correction was ended by the guard", "see the cause, then arm again when needed"),
    "SocketLost": (
        "a running correction is ramped to zero unless clients can connect again",
        "keep the run directory from being cleaned (tmpfiles.d); if it cannot be created again, check its permissions",
    ),
    "BlackBox": ("none: the frames around the stop were stored", "see the page events, or use candump's tools"),
    # reception
    "SourceLost": ("nothing is received, so nothing is identified", "see the cause in the text"),
    "BusSilent": ("nothing is received from the drives on this bus", "check NC, wiring and bit rate"),
    "BusErrors": ("frames are repeated, which loads the bus and delays them", "check termination, shield and bit rate"),
    "TransceiverFault": ("frames may be lost", "check the cable for breaks and shorts"),
    "NotAcknowledged": ("no node acknowledges frames", "check the drives' supply, wiring and bit rate"),
    "CoarseStamps": ("the inductance is less certain", "use an interface with hardware time stamps"),
    "SyncPeriodSuspect": ("identified parameters are wrong by that share", "correct sync_period_s, or the NC's period"),
    "NodeNeverHeard": ("this axis is not monitored or identified", "check node_id, the drive's supply and its wiring"),
    "NoSamples": ("this axis is not monitored or identified", "compare the drive's mapping: fdhil check"),
    "PdoMissing": ("the samples of this axis have gaps, or none come", "compare the drive's mapping: fdhil check"),
    "LateFrame": ("the samples around it are not used", "check the bus load and the drive's response time"),
    "PdoIrregular": ("samples cannot be dated, and are not used", "set the drive's TPDOs to be sent at every SYNC"),
    "DemandMismatch": ("the samples of this axis cannot be trusted", "check the set-points' sender and delay"),
    "ScaleSuspect": ("identified parameters are wrong by that share", "compare the drive's scaling: fdhil check"),
    "PitchSuspect": ("identified parameters are wrong by that share", "compare screw_pitch_mm with the machine"),
    "MovesNotUsed": ("no rapid of this axis is used for identification", "see the reason in the text; check [g0]"),
    "NcSilent": ("rapid moves cannot be recognised; none is used", "check that the NC and its interface are running"),
    "GantrySkew": (
        "the beam may be skewed; a correction of this machine is ramped to zero",
        "stop the axis, compare both drives' positions and couplings, then arm again",
    ),
    # sensors
    "ModbusTimeout": (_NO_VOLTAGE, "check the sensor's supply, address and wiring"),
    "ModbusException": (_NO_VOLTAGE, "compare the registers with the sensor's manual"),
    "ModbusCrc": (_NO_VOLTAGE, "check shield, termination and baud rate of the line"),
    "ModbusShape": (_NO_VOLTAGE, "compare the registers with the sensor's manual"),
    "ModbusStale": (_NO_VOLTAGE, "increase the sensor's timeout, or reduce the load of the line"),
    "RegisterTear": ("that answer is not used", "if it is frequent, make the sensor freeze a block while it is read"),
    "ModbusUnit": (_NO_VOLTAGE, "check that no two sensors have the same address"),
    "ModbusPortGone": (_NO_VOLTAGE, "check the sensor's supply and cable; it is polled until it answers"),
    "SerialTimeout": ("its values are missing meanwhile", "check the instrument's supply and cable"),
    "SerialShape": ("its values are missing meanwhile", "compare the instrument's lines with its configuration"),
    "SerialPortGone": ("its values are missing meanwhile", "check the cable; the port is opened again when it is back"),
    "StuckValue": ("rapids with this voltage are refused", "check the sensor and its measuring circuit"),
    "SampleTiming": ("the inductance is less certain", "reduce the load of the sensor's line"),
    "TableSilent": ("the error at the table is not measured", "check the table's encoder and its cable"),
    # results of the rapids
    "ValidationFailed": (_OLD_SET, "check the newest rapids and the reasons for their refusal"),
    "LoadChanged": ("predictions still assume the previous load", "check whether the load change is intended"),
    "ParameterJump": (
        _OLD_SET + " until more rapids agree",
        "inspect the axis; further rapids confirm or refute the change",
    ),
    "MaintenanceDue": ("the axis still works, but its condition has degraded", "plan the maintenance of this axis"),
    "CalibrationSuspect": ("a sensor's gain may be wrong, and with it K and R", "check the sensor against another one"),
    # this PC
    "ResourceHigh": (
        "the system ends the daemon when the resource is exhausted",
        "restart it while the machine stands still, and report the resource",
    ),
    "ClockJump": ("none; dates in the history may be wrong, its order is right", "set this PC's clock"),
    "OfferWaits": ("none: nothing changes until it is accepted", "run fdhil offers list, then accept or reject it"),
    "ConfigUnlikely": ("identified parameters may be wrong", "check whether the value in the text is intended"),
    "CorruptFile": ("damaged data are not used", "check the disk"),
    "StrayFiles": ("none: they are ignored", "move them out of the store"),
    "StoreFault": ("nothing is stored, and nothing can be armed", "check the disk and its permissions"),
    "DiskFull": ("nothing is stored, and nothing can be armed", "free the disk"),
    "StoreReplaced": (
        "records made since that file was written are lost; identification continues",
        "stop the daemon before you restore a backup; restore the file that was moved away if it is needed",
    ),
    "StoreRecovered": ("records in between were not stored", "arm again when needed"),
    "SchemaVersion": ("nothing is stored, and nothing can be armed", "use the fdhil that wrote the store"),
}


def get_effect_and_action(notice: Notice) -> tuple[str, str]:
    """Return effect and next action; empty where the notice's own text is complete.

    A refusal, or a change of the guard's state, names the class that caused it: the next action is that class' own.
    """
    inner = next((code for code in _CLASS.findall(notice.text) if code in INTERLOCK_CATALOGUE), None)
    effect, action = WORDS.get(notice.code, ("", ""))
    if inner is None:
        return (effect, action) if notice.code in WORDS else _get_guard_texts(notice.code)
    sent = REACTION_EFFECTS[INTERLOCK_CATALOGUE[inner][0]]
    cause = "PcLate" if LATE_PC in notice.text else inner
    return sent if sent in notice.text else effect, INTERLOCK_CATALOGUE[cause][2]


def _get_guard_texts(code: str) -> tuple[str, str]:
    """Return the texts of a class of the guard; its effect applies to a running correction."""
    if code not in INTERLOCK_CATALOGUE:
        return "", ""
    reaction, _, action = INTERLOCK_CATALOGUE[code]
    return f"while a correction runs: {REACTION_EFFECTS[reaction]}", action
