"""The fault matrix: each fault that may happen, the class that reports it, and the faults known to have no test yet.

A test proves a row by the marker ``fault("A1", ...)``: the safe reaction happens, and the class is reported by its
name. A case of a parametrised test whose id begins with a row's id ("A20 short") counts for that row alone.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parent


@dataclass(frozen=True)
class Row:
    """One fault: its id, a short description, the classes that report it (none: it is counted or silent)."""

    id: str
    fault: str
    classes: tuple[str, ...]


TEXT = """
A1 | CAN bus-off | BusOff
A2 | controller warns or is passive | ErrorPassive
A3 | controller auto-restarted | BusRestarted
A4 | interface down, adapter unplugged | BusDown
A5 | transmit queue full | TxQueueFull
A6 | kernel receive overflow | RxOverflow
A7 | SYNC lost | SyncLost
A8 | SYNC late, jitter | SyncJitter
A9 | second SYNC producer / counter jump | SyncCollision
A10 | feedback TPDO dropped | StaleData
A11 | duplicated frame |
A12 | reordered frames | OutOfOrder
A13 | frame older than one period | LateFrame
A14 | wrong content, right length | Implausible
A15 | PDO shorter than mapping | PdoLength
A16 | PDO longer | PdoMapping
A17 | mapping changed by another tool | PdoMapping
A18 | foreign node uses the drive's id | ForeignProducer
A19 | someone else sends our offset id | OffsetHijack
A20 | emergency, any code, any length | DriveEmergency
A21 | flood of emergencies |
A22 | drive heartbeat lost | HeartbeatLost
A23 | drive reboots in mid-move | NodeRebooted
A24 | drive leaves Operational | NmtStateWrong
A25 | SDO abort | SdoAbort
A26 | SDO time-out / late answer | SdoTimeout
A27 | toggle error, endless or oversize segment | SdoToggle SdoTooLarge
A28 | host wall-clock jump | ClockJump
A29 | wrong bit rate, silent bus | BusSilent
B1 | Modbus time-out | ModbusTimeout
B2 | exception answer | ModbusException
B3 | CRC error | ModbusCrc
B4 | short answer, noise before it | ModbusShape
B5 | serial port gone / EIO | ModbusPortGone
B6 | answer from another unit | ModbusUnit
B7 | late answer of the previous request | ModbusStale
B8 | register count differs from request | ModbusShape
B9 | 16-bit wrap, 32-bit tear | RegisterTear
B10 | word order / sign wrong | SignOrScale
B11 | stuck value while i, w move | StuckValue
B12 | sample rate or skew beyond need | SampleTiming
C1 | saturated sensor (>= 3 samples at rail) | Saturated
C2 | NaN/inf anywhere | NotFinite
C3 | quantisation > 1/50 of the range used | Quantised
C4 | acceleration stage missing (late trigger) | MissingStage
C5 | top-speed stage missing | MissingStage
C6 | load or collision during a rapid | LoadDetected
C7 | G0 aborted, feed hold, override < 100 % | EpisodeAborted
C8 | offset/gain error | CalibrationSuspect
D1 | rank-deficient regressor | RankDeficient
D2 | low excitation | LowExcitation
D3 | a parameter outside its physical box | Unphysical
D4 | outlier against the history, step beyond limit | ParameterJump LoadChanged
D5 | model fits by chance | ValidationFailed
D6 | solver error, LinAlgError, time-out | SolverFailed
E1 | offset beyond L | OffsetLimit
E2 | step, acceleration or total variation beyond limit | OffsetRate OffsetEnergy
E3 | NaN/inf/not int in table | OffsetNotFinite
E4 | stale model | ModelStale
E5 | wrong program | ProgramMismatch
E6 | latched target differs from the table | Misaligned
E7 | correction predicted to make it worse | HarmPredicted
E8 | comms lost while offset applied |
E9 | 0x6061 not CSP | NotCsp
E10 | drive not Operation Enabled | DriveNotEnabled
E11 | limit switch | LimitActive
E12 | following error | FollowingError
E13 | non-zero 0x60B0 found at start | StaleOffset
E14 | drive watchdog not armed / starve test failed | WatchdogNotArmed
E15 | read-back is not what was commanded | EchoMismatch
E16 | units or axis sign wrong | ScaleMismatch
E17 | feed hold; override change | FeedHold OverrideChanged
E18 | operator disarms in the cut |
E19 | prediction not trustworthy | PoorSkill
F1 | kill -9 at any byte of a write | RecoveredTail
F2 | power cut |
F3 | disk full / quota | DiskFull
F4 | fsync fails | StoreFault
F5 | read-only disk | ReadOnlyStore
F6 | short write |
F7 | config typo, unknown key, unit missing, NaN | ConfigError
F8 | two daemons on one bus | BusLocked
F9 | wall clock wrong at boot | ClockJump
F10 | memory/fd/thread growth | ResourceHigh
F11 | slow or dead API client | ClientSlow
F12 | log flood |
F13 | SIGTERM while ACTIVE |
F14 | loop hangs: SIGSTOP | LoopOverrun
F15 | kill -9 of the main daemon while ACTIVE | MainLost
F16 | guard killed too | StaleOffset
F17 | bit rot in recording/model/table | CorruptFile
F18 | stray, partial or foreign files in state dir |
F19 | newer/older schema | SchemaVersion
F20 | exception in any thread or callback | InternalError
F21 | restart loop |
G1 | API write without credentials | AuthRequired
G2 | CSRF | BadOrigin
G3 | DNS rebinding | BadHost
G4 | path traversal in recording names | BadName
G5 | hostile EDS | EdsError
G6 | hostile G-code | GcodeBudget
G7 | config bombs | ConfigError
G8 | hostile recording import | CorruptFile
G9 | PDO/SDO/NMT injection on CAN |
G10 | secrets in log, core, process list |
G11 | limits raised via API/config beyond ceiling | CeilingExceeded
G12 | log/terminal escape injection via names, EMCY text, EDS strings |
G13 | compromised daemon |
G14 | dependency tampering |
"""

# No test proves these yet. A row leaves this list with its first test and never comes back.
UNTESTED: dict[str, str] = {}

# The product tells these by another class than the matrix, or in another way.
TOLD_OTHERWISE: dict[str, str] = {
    "A12": "counted as out of order",
    "A17": "the operator reads `RecordVoid`, or at commissioning the mapping that was found",
    "E3": "refused before it is written, or as `CorruptFile`",
    "E16": "the object, its value and the configured one in a sentence",
    "F1": "nothing is told: a half-written file is never looked at and the next one takes its place",
    "F11": "its answers wait, then it is let go",
    "F16": "adopted by the next guard",
    "G8": "by `RecordingError`",
    "G11": "by `ConfigError`",
}


def _row(line: str) -> Row:
    identity, fault, *classes = (part.strip() for part in line.split("|"))
    return Row(identity, fault, tuple(classes[0].split()) if classes else ())


ROWS: dict[str, Row] = {row.id: row for row in map(_row, TEXT.strip().splitlines())}


@cache
def mark_rows() -> dict[str, tuple[Path, ...]]:
    """Return the files with a test of each row, found in their text: nothing is imported."""
    found: dict[str, set[Path]] = {}
    for path in TESTS.rglob("*.py"):
        text = path.read_text("utf-8")
        if "mark.fault(" in text:
            for row in _list_rows(ast.parse(text)):
                found.setdefault(row, set()).add(path)
    return {row: tuple(sorted(paths)) for row, paths in found.items()}


def _list_rows(tree: ast.Module) -> set[str]:
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    marks = (call for call in calls if ast.unparse(call.func) == "pytest.mark.fault")
    return {str(arg.value) for mark in marks for arg in mark.args if isinstance(arg, ast.Constant)}
