"""A bus log keeps its frames through every file format; frames that a format cannot hold are counted."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
from collections import Counter
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.can import blf_log, candump_log
from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from fdhil.drivers.can.log_conversion import ConvertedLog, convert_log
from fdhil.drivers.can.logged_frame import BUS_ERROR, FD_LENGTHS, LoggedFrame, LogHeader
from fdhil.errors import RecordingError
from fdhil.store import file_suffixes
from tests.daemon.machine_rig import fdhil

FORMATS = tuple(file_suffixes.BUS_LOGS.values())
CANDUMP = """\
(1714557600.249713) can0 080#
(1714557600.249813) can0 181#0100000002000000
(1714557600.250713) can1 080#05
(1714557600.250913) can0 18FF1234#0102
(1714557600.250914) can0 00000123#11
(1714557600.251013) can0 705#R1
(1714557600.251014) can0 705#R
(1714557600.252013) can0 601#R8
(1714557600.252014) can0 18FF1234#R3
(1714557600.253013) can0 182##1010203040506070809101112
(1714557600.253014) can0 182##0
(1714557600.253015) can0 18FF1234##2AA
(1714557601.254013) can1 281#37020000
"""
ERRORS = """\
(1714557600.250100) can0 20000004#0004000000000060
(1714557600.250200) can0 20000040#0000000000000000
(1714557600.250300) can0 20000080#0000000000000000
"""
NOW_NS = 1_714_557_600 * 10**9


def get_suffix(name: str) -> str:
    return file_suffixes.find_suffix(file_suffixes.BUS_LOGS, name)


def convert_file(text: str, target: str, folder: Path, source: str = "candump") -> tuple[Path, ConvertedLog]:
    """Write a log, convert it, and return the converted file."""
    log, out = folder / f"in{get_suffix(source)}", folder / f"out{get_suffix(target)}"
    log.write_text(text)
    reported = convert_log(log, source, target)
    out.write_bytes(reported.content)
    return out, reported


def convert_round_trip(text: str, name: str, folder: Path) -> str:
    out, _ = convert_file(text, name, folder)
    return convert_log(out, name, "candump").content.decode()


@pytest.mark.parametrize("name", FORMATS)
def test_every_frame_survives_every_format(name: str, tmp_path: Path) -> None:
    assert convert_round_trip(CANDUMP, name, tmp_path) == CANDUMP
    undated = CANDUMP.replace("(17145576", "(1")  # as the black box has them: since the computer was switched on
    assert convert_round_trip(undated, name, tmp_path) == undated
    _, reported = convert_file(CANDUMP, name, tmp_path)
    assert (reported.frames, reported.left_out, reported.reduced) == (13, {}, {})


def test_command_reports_kept_and_left_out_frames(tmp_path: Path, capsys: Any) -> None:
    log, out = tmp_path / "bus.log", tmp_path / "bus.trc"
    log.write_text(CANDUMP + ERRORS)
    code, reported, err = fdhil("export", log, "--out", out, "--json", capsys=capsys)
    found = json.loads(reported)
    assert (code, found["frames"], found["left_out"], found["reduced"]) == (0, 13, {"error frames": 3}, {})
    assert found["buses"] == {"can0": 1, "can1": 2}
    assert "3 error frames: omitted from" in err
    rows = [line for line in out.read_text().splitlines() if not line.startswith(";")]
    assert len(rows) == 13


def test_error_frames_keep_their_class_where_the_format_has_one(tmp_path: Path) -> None:
    for name in ("candump", "blf"):
        assert convert_round_trip(ERRORS, name, tmp_path) == ERRORS
        assert convert_file(ERRORS, name, tmp_path)[1].reduced == {}
    out, reported = convert_file(ERRORS, "asc", tmp_path)
    assert out.read_text().count("ErrorFrame") == 3
    assert reported.reduced == {"class and data of error frames": 2}
    assert convert_round_trip(ERRORS, "asc", tmp_path).count("20000080#0000000000000000") == 3
    with pytest.raises(RecordingError, match="3 error frames, which trc cannot hold"):
        convert_file(ERRORS, "trc", tmp_path)


@pytest.mark.usefixtures("processes")
@pytest.mark.skipif(shutil.which("log2asc") is None, reason="needs can-utils")
def test_asc_events_match_log2asc(tmp_path: Path) -> None:
    out, _ = convert_file(CANDUMP + ERRORS, "asc", tmp_path)
    theirs = subprocess.run(
        ["log2asc", "-I", tmp_path / "in.log", "can0", "can1"], check=True, capture_output=True, text=True
    ).stdout

    def events(text: str) -> list[list[str]]:
        words = [line.split() for line in text.splitlines() if line[:5].strip().isdigit() or "." in line[:5]]
        rows = [row[1:] for row in words if len(row) > 2 and row[1] != "Start"]
        return [row[:-8] if row[0] == "CANFD" else row for row in rows]  # not how long it took on the wire

    assert events(out.read_text()) == events(theirs)


@pytest.mark.usefixtures("processes")
@pytest.mark.skipif(shutil.which("log2asc") is None, reason="needs can-utils")
def test_log2asc_output_is_read(tmp_path: Path) -> None:
    log, asc = tmp_path / "bus.log", tmp_path / "bus.asc"
    log.write_text(CANDUMP)
    subprocess.run(["log2asc", "-I", log, "-O", asc, "can0", "can1"], check=True)
    came = convert_log(asc, "asc", "candump").content.decode().splitlines()
    assert [line.split(" ", 1)[1] for line in came] == [line.split(" ", 1)[1] for line in CANDUMP.splitlines()]
    assert came[0].startswith("(1714557600.000000)")  # its head has whole seconds, and its times begin at 0
    assert came[-1].startswith("(1714557601.004300)")


@pytest.mark.usefixtures("processes")
@pytest.mark.skipif(shutil.which("asc2log") is None, reason="needs can-utils")
def test_asc2log_reads_written_asc(tmp_path: Path) -> None:
    out, _ = convert_file(CANDUMP + ERRORS, "asc", tmp_path)
    theirs = subprocess.run(["asc2log", "-I", out], check=True, capture_output=True, text=True).stdout
    came = [line.split()[1:3] for line in theirs.splitlines()]
    generic = [["can0", "20000080#0000000000000000"]] * 3
    assert came == [line.split()[1:3] for line in CANDUMP.splitlines()] + generic


@pytest.mark.parametrize("name", FORMATS)
def test_logs_of_python_can_are_read(name: str, tmp_path: Path) -> None:
    """Its TRC has no remote, error and FD frames, its ASC no frames of CAN FD without data, and candump no lengths."""
    log, theirs = tmp_path / "bus.log", tmp_path / f"theirs{get_suffix(name)}"
    lines = [line for line in CANDUMP.splitlines() if "##" not in line and ("#R" not in line or line.endswith("#R"))]
    wanted = [line for line in lines if "#R" not in line or name != "trc"]
    log.write_text("\n".join(lines))
    with can.Logger(theirs) as writer:
        for message in read_with_python_can(log):
            writer.on_message_received(message)
    reported = convert_log(theirs, name, "candump")
    came = reported.content.decode().splitlines()
    assert [line.split()[1:3] for line in came] == [line.split()[1:3] for line in wanted]
    if name != "asc":  # whose head has milliseconds alone, cut off
        assert [line.split()[0] for line in came] == [line.split()[0] for line in wanted]
    assert reported.left_out == {}
    assert set(reported.reduced) <= ({"times finer than 1 us"} if name == "blf" else set())  # of its floats


def read_with_python_can(path: Path, **options: Any) -> list[can.Message]:
    with can.LogReader(path, **options) as reader:
        return list(reader)


@pytest.mark.parametrize("name", ["asc", "trc", "blf"])
def test_python_can_reads_the_same_frames(name: str, tmp_path: Path) -> None:
    plain = [line for line in CANDUMP.splitlines(keepends=True) if "##0" not in line and "##2" not in line]
    out, _ = convert_file("".join(plain), name, tmp_path)
    options = {"relative_timestamp": False} if name == "asc" else {}
    expected, came = read_with_python_can(tmp_path / "in.log"), read_with_python_can(out, **options)
    assert len(came) == len(expected)
    for theirs, message in zip(expected, came, strict=True):
        assert message.timestamp == pytest.approx(theirs.timestamp, abs=1e-6)
        for key in ("arbitration_id", "is_extended_id", "is_remote_frame", "is_fd", "bitrate_switch", "data"):
            assert getattr(message, key) == getattr(theirs, key), key
        if not message.is_fd:  # its TRC reader leaves the code of a length there
            assert message.dlc == theirs.dlc
        if message.channel is not None:
            assert int(str(message.channel)) + (name != "trc") == int(str(theirs.channel)[3:]) + 1


@pytest.mark.parametrize("name", ["asc", "trc"])
def test_bus_names_are_kept_in_a_remark(name: str, tmp_path: Path) -> None:
    text = "(12.000100) vcan0 080#\n(12.000200) can0 080#\n(12.000300) axes 080#\n(12.000400) can10 080#\n"
    assert convert_round_trip(text, name, tmp_path) == text
    assert convert_file(text, name, tmp_path)[1].buses == {"can0": 1, "can10": 11, "vcan0": 2, "axes": 3}


def test_bus_names_that_blf_cannot_hold_are_counted(tmp_path: Path) -> None:
    _, reported = convert_file("(12.000100) vcan0 080#\n(12.000200) can0 080#\n", "blf", tmp_path)
    assert reported.reduced == {"names of buses": 1}


@pytest.mark.parametrize("name", FORMATS)
def test_sent_frames_and_decreasing_times_are_kept(name: str, tmp_path: Path) -> None:
    text = "(12.000100) can0 080# R\n(12.000050) can1 080# T\n(11.000100) can0 081#05 R\n"
    assert convert_round_trip(text, name, tmp_path) == text


@pytest.mark.parametrize(
    ("name", "lost"),
    [("candump", {}), ("blf", {}), ("asc", {"times finer than 1 us": 1}), ("trc", {"times finer than 1 us": 1})],
)
def test_nanoseconds_are_kept_or_counted(name: str, lost: dict[str, int], tmp_path: Path) -> None:
    text = "(1714557600.249713123) can0 080#\n(1714557600.250000000) can0 080#\n"
    out, reported = convert_file(text, name, tmp_path)
    assert reported.reduced == lost
    if name == "candump":
        assert out.read_text() == text
    if name == "blf":
        back = convert_log(out, "blf", "candump")
        assert back.content.decode() == "(1714557600.249713) can0 080#\n(1714557600.250000) can0 080#\n"
        assert back.reduced == {"times finer than 1 us": 1}
        assert [frame.t_ns for frame in blf_log.read_frames(out, Counter())] == [NOW_NS + 249713123, NOW_NS + 250000000]


IDS = st.one_of(st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF).map(EXTENDED_FLAG.__or__))


@st.composite
def draw_frames(draw: st.DrawFn) -> LoggedFrame:
    t_ns = NOW_NS + draw(st.integers(0, 10**7)) * 1000
    bus, sent = draw(st.sampled_from(["can0", "can1", "can7", "vcan0"])), draw(st.booleans())
    kind = draw(st.sampled_from(["data", "remote", "error", "fd", "long"]))
    if kind == "remote":
        return LoggedFrame(t_ns, bus, draw(IDS) | REMOTE_FLAG, draw(st.integers(0, 8)), sent=sent)
    if kind == "error":
        can_id = ERROR_FLAG | draw(st.integers(0, 0x1FF))
        return LoggedFrame(t_ns, bus, can_id, 8, draw(st.binary(min_size=8, max_size=8)), sent=sent)
    if kind == "fd":
        dlc = draw(st.integers(0, 15))
        data = draw(st.binary(min_size=FD_LENGTHS[dlc], max_size=FD_LENGTHS[dlc]))
        return LoggedFrame(t_ns, bus, draw(IDS), dlc, data, draw(st.integers(0, 3)), sent)
    dlc = draw(st.integers(9, 15) if kind == "long" else st.integers(0, 8))
    data = draw(st.binary(min_size=min(8, dlc), max_size=min(8, dlc)))
    return LoggedFrame(t_ns, bus, draw(IDS), dlc, data, sent=sent)


def expect_frames(frame: LoggedFrame, name: str) -> LoggedFrame | None:
    """Return what reading a frame back from a format must give."""
    if frame.can_id & ERROR_FLAG:
        if name == "trc":
            return None
        if name == "asc":
            return LoggedFrame(frame.t_ns, frame.bus, BUS_ERROR, 8, bytes(8))
    return frame


@pytest.mark.usefixtures("real_time")
@settings(deadline=None)
@given(st.lists(draw_frames(), min_size=1, max_size=30), st.sampled_from(FORMATS))
def test_any_frames_survive_conversion_or_are_counted(
    tmp_path_factory: Any, sent: list[LoggedFrame], name: str
) -> None:
    folder = tmp_path_factory.mktemp("log")
    header = LogHeader(0, {}, True)
    text = "".join(candump_log.format_frame(frame, header) for frame in sent)
    wanted = [frame for frame in (expect_frames(frame, name) for frame in sent) if frame is not None]
    if not wanted:
        return
    out, reported = convert_file(text, name, folder)
    module = import_module(f"fdhil.drivers.can.{name}_log")
    came = list(module.read_frames(out, Counter()))
    assert reported.frames == len(came) == len(sent) - sum(reported.left_out.values())
    renamed = {"vcan0": f"can{int(reported.buses['vcan0']) - 1}"} if name == "blf" and "vcan0" in reported.buses else {}
    for got, frame in zip(came, wanted, strict=True):
        assert (got.t_ns, got.bus) == (frame.t_ns, renamed.get(frame.bus, frame.bus))
        assert (got.can_id, got.dlc, got.data, got.fd) == (frame.can_id, frame.dlc, frame.data, frame.fd)
        assert bool(got.sent) == bool(frame.sent) or frame.is_error


SCREENS = (
    " (2025-03-05 10:00:00.249713)  can0  080   [0] ",
    "  can0  181   [8]  01 00 00 00 02 00 00 00",
    " (000.000100)  vcan1  18FF1234   [2]  01 02   '..'",
    " (1741168800.249713)  can0  RX - -  705   [0]  remote request",
    " (1741168800.249713)  can0  TX B E  182  [12]  01 02 03 04 05 06 07 08 09 10 11 12",
    "\x1b[31m  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\x1b[0m",
)


@pytest.mark.parametrize("line", SCREENS)
def test_candump_screen_output_is_refused_with_advice(line: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"line 1: this is candump's screen output.*candump -l"):
        convert_file(line + "\n", "asc", tmp_path)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("(12.000100) can0 080#0", "a line that is not a frame"),
        ("(12.000100) can0 080#010203040506070809", "9 bytes|no frame|larger"),
        ("(12.000100) can0 080##0010203040506070809", "9 bytes in a CAN FD frame, which has 0 to 8, 12"),
        ("(12.000100) can0 8FF#", "identifier 8FF is too large"),
        ("(12.000", "a line that is not a frame"),
    ],
)
def test_damaged_line_is_refused_with_its_line_number(line: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=f"line 2: .*({said})"):
        convert_file(f"(12.000000) can0 080#\n{line}\n", "asc", tmp_path)


@pytest.mark.timeout(100)
@pytest.mark.parametrize("name", FORMATS)
def test_sparse_file_is_refused_without_reading_it(name: str, tmp_path: Path) -> None:
    log = tmp_path / f"bus{get_suffix(name)}"
    log.touch()
    os.truncate(log, 1 << 40)
    with pytest.raises(RecordingError, match=r"not a bus log|not a readable BLF log"):
        convert_log(log, name, "candump")


def test_asc_of_other_programs_is_read(tmp_path: Path) -> None:
    text = """\
date Mit Mai 1 10:00:00.250 am 2024
base hex  timestamps relative
internal events logged
Begin Triggerblock Mit Mai 1 10:00:00.250 am 2024
   0.000000 Start of measurement
   0.001000 1  181             Rx   d 1 01  Length = 0 BitCount = 64 ID = 385
   0.001000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
   0.001000 2  181x            TxRq d 1 02
   0.001000 2  181x            Tx   d 1 02
   0.002000 1  701             Rx   r Length = 0
   0.001000 CANFD   2 Rx   182  Drive_PDO2  1 1 9 12 01 02 03 04 05 06 07 08 09 10 11 12 0 0 7000 0 0 0 0 0
   0.001000 CANFD   2 Rx   182  0 0 2 2 01 02 0 0 0 0 0 0 0 0
   0.001000 CANFD   1 Rx   183  0 0 8 0 0 0 1010 0 0 0 0 0
   0.001000 CANFD   1 Rx   ErrorFrame  Not Acknowledge error
End TriggerBlock
"""
    (tmp_path / "bus.asc").write_text(text)
    reported = convert_log(tmp_path / "bus.asc", "asc", "candump")
    start = int(datetime(2024, 5, 1, 10).timestamp())
    assert reported.left_out == {"events that are not CAN frames": 2}
    assert reported.content.decode().splitlines() == [
        f"({start}.{stamp}) {rest}"
        for stamp, rest in [
            ("251000", "can0 181#01 R"),
            ("254000", "can1 00000181#02 T"),
            ("256000", "can0 701#R R"),
            ("257000", "can1 182##3010203040506070809101112 R"),
            ("258000", "can1 182#0102 R"),
            ("259000", "can0 183#R8 R"),
            ("260000", "can0 20000080#0000000000000000"),
        ]
    ]


def test_symbolic_identifier_is_refused_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "bus.asc").write_text("base hex  timestamps absolute\n   0.5 1  Engine             Rx   d 1 16\n")
    with pytest.raises(
        RecordingError, match=r"line 2: 'Engine' where a number belongs \(record with numbers, not names"
    ):
        convert_log(tmp_path / "bus.asc", "asc", "candump")


def test_decimal_asc_without_date_is_read_and_reported(tmp_path: Path) -> None:
    (tmp_path / "bus.asc").write_text("base dec  timestamps absolute\n   0.5 1  385             Rx   d 2 16 255\n")
    reported = convert_log(tmp_path / "bus.asc", "asc", "candump")
    assert reported.content == b"(0.500000) can0 181#10FF\n"
    assert reported.reduced == {"the date, which is unreadable": 1}


def test_trigger_date_applies_only_to_times_counted_from_it(tmp_path: Path) -> None:
    """Python-can writes the time of conversion in the date line, CANoe the trigger's in a later trigger block."""
    head = "date Wed May 01 09:00:00.000 2024\nbase hex  timestamps absolute\ninternal events logged\n"
    block = "Begin Triggerblock Wed May 01 10:00:00.249 2024\n"
    (tmp_path / "bus.asc").write_text(head + block + " 0.000000 Start of measurement\n 1.0 1 80 Rx d 0\n")
    (tmp_path / "later.asc").write_text(head + block + " 3600.249 1 80 Rx d 0\n")
    first = convert_log(tmp_path / "bus.asc", "asc", "candump").content
    later = convert_log(tmp_path / "later.asc", "asc", "candump").content
    assert int(first[1:11]) - int(later[1:11]) == 1


# a data frame, an error frame, something else, and a remote frame
TRC: dict[str, list[str]] = {
    "1.0": ["1) 1841 0181 3 01 02 03", "2) 1842 0008 4 ERROR 00 19 08 08", "3) 1843 FFFFFFFF 4 00 00 00 04 BUSLIGHT",
            "4) 1844 18FF1234 3 RTR"],
    "1.1": ["1) 1841.0 Rx 0181 3 01 02 03", "2) 1842.0 Error 0008 4 00 19 08 08",
            "3) 1843.0 Warng FFFFFFFF 4 00 00 00 04", "4) 1844.0 Rx 18FF1234 3 RTR"],
    "1.2": ["1) 1841.000 1 Rx 0181 3 01 02 03", "2) 1842.000 1 Error 0008 4 00 19 08 08",
            "3) 1843.000 1 Warng FFFFFFFF 4 00 00 00 04", "4) 1844.000 1 Rx 18FF1234 3 RTR"],
    "1.3": ["1) 1841.000 1 Rx 0181 - 3 01 02 03", "2) 1842.000 1 Error 0008 - 4 00 19 08 08",
            "3) 1843.000 1 Warng FFFFFFFF - 4 00 00 00 04", "4) 1844.000 1 Rx 18FF1234 - 3 RTR"],
    "2.0": ["1 1841.000 DT 0181 Rx 3 01 02 03", "2 1842.000 ER Rx 04 00 02 00 00", "3 1843.000 ST Rx 00 00 00 08",
            "4 1844.000 RR 18FF1234 Rx 3"],
    "2.1": ["1 1841.000 DT 1 0181 Rx - 3 01 02 03", "2 1842.000 ER 1 - Rx - 5 04 00 02 00 00",
            "3 1843.000 EV - An event", "4 1844.000 RR 1 18FF1234 Rx - 3"],
}  # fmt: skip
COLUMNS = {"2.0": ";$COLUMNS=N,O,T,I,d,l,D\n", "2.1": ";$COLUMNS=N,O,T,B,I,d,R,L,D\n"}


@pytest.mark.parametrize("version", TRC)
def test_trc_of_every_version_is_read(version: str, tmp_path: Path) -> None:
    dated = version != "1.0"
    head = f";$FILEVERSION={version}\n;$STARTTIME=45413.4166666667\n" if dated else ";   Start time: 11.09.2002\n"
    (tmp_path / "bus.trc").write_text(head + COLUMNS.get(version, "") + "".join(f"   {row}\n" for row in TRC[version]))
    reported = convert_log(tmp_path / "bus.trc", "trc", "candump")
    start, part = (1714557600, "003") if dated else (0, "000")
    assert reported.content.decode() == (
        f"({start + 1}.841{part}) can0 181#010203\n"
        f"({start + 1}.842{part}) can0 20000080#0000000000000000\n"
        f"({start + 1}.844{part}) can0 18FF1234#R3\n"
    )
    assert reported.left_out == {"lines that are not CAN frames": 1}
    assert reported.reduced == ({} if dated else {"the date, which is not in the header": 1})


def test_fd_flags_match_peaks_types(tmp_path: Path) -> None:
    """FE is the error state alone, BI is both; python-can 4.6 has them swapped."""
    out, _ = convert_file("".join(f"(12.00000{k}) can0 181##{k}01\n" for k in range(4)), "trc", tmp_path)
    assert [line.split()[2] for line in out.read_text().splitlines() if line[0] != ";"] == ["FD", "FB", "FE", "BI"]


def test_truncated_blf_counts_the_missing_objects(tmp_path: Path) -> None:
    out, reported = convert_file(CANDUMP * 40, "blf", tmp_path)
    out.write_bytes(reported.content[:-400])
    cut = convert_log(out, "blf", "candump")
    assert 0 < cut.frames < reported.frames
    assert cut.left_out == {"objects that are not CAN frames": reported.frames - cut.frames}


def test_log_is_not_a_recording_and_empty_log_is_refused(tmp_path: Path, capsys: Any) -> None:
    log = tmp_path / "bus.log"
    log.write_text(CANDUMP)
    code, _, err = fdhil("export", log, "--out", tmp_path / "bus.csv", capsys=capsys)
    assert (code, "is a bus log, which converts to candump, blf, asc, trc" in err) == (2, True)
    log.write_text("\n")
    code, _, err = fdhil("export", log, "--out", tmp_path / "bus.blf", capsys=capsys)
    assert (code, "has no frame" in err) == (3, True)
    assert not (tmp_path / "bus.blf").exists()


@pytest.mark.usefixtures("real_time")
@settings(deadline=None, max_examples=60)
@given(st.sampled_from(FORMATS), st.binary(max_size=200), st.integers(0, 900))
def test_any_bytes_are_read_or_refused(tmp_path_factory: Any, name: str, junk: bytes, keep: int) -> None:
    folder = tmp_path_factory.mktemp("log")
    out, reported = convert_file(CANDUMP, name, folder)
    out.write_bytes(reported.content[:keep] + junk)
    with contextlib.suppress(RecordingError):
        convert_log(out, name, "candump")
