"""Small EDS files of other vendors' drives: the relevant objects of each, as in the vendor's file or manual."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
SHEETS = tuple(sorted(path.stem for path in FOLDER.glob("*.txt")))
_TYPES = {
    "BOOL": 1, "I8": 2, "I16": 3, "I32": 4, "U8": 5, "U16": 6, "U32": 7, "REAL32": 8, "STRING": 9, "U64": 27,
}  # fmt: skip


def format_eds(sheet: str) -> str:
    """Return the EDS of one of ``SHEETS``."""
    head: dict[str, str] = {}
    objects: dict[int, dict[int, str]] = {}
    for line in (FOLDER / f"{sheet}.txt").read_text("utf-8").splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        if words[0].endswith(":"):
            head[words[0][:-1]] = " ".join(words[1:])
        elif words[0] == "PDO":
            _add_pdo(objects, *words[1:])
        else:
            place, _, sub = words[0].partition(":")
            index = int(place, 16)
            objects.setdefault(index, {})[int(sub or "0")] = _format_keys(words[0], *words[1:])
    device = "".join(f"{key}={value}\n" for key, value in head.items())
    return f"[FileInfo]\nEDSVersion=4.0\n\n[DeviceInfo]\n{device}\n" + "".join(
        _format_object(index, subs) for index, subs in sorted(objects.items())
    )


def write_eds(sheet: str, folder: Path) -> Path:
    """Write the EDS of one of ``SHEETS`` into a folder and return its path."""
    path = folder / f"{sheet}.eds"
    path.write_text(format_eds(sheet), encoding="utf-8")
    return path


def _format_keys(name: str, kind: str, access: str, *more: str) -> str:
    default = next((word[1:] for word in more if word.startswith("=")), "")
    return (
        f"ParameterName=Object {name}\nObjectType=7\nDataType=0x{_TYPES[kind]:04X}\nAccessType={access}\n"
        f"PDOMapping={int('map' in more)}\nDefaultValue={default}\n"
    )


def _add_pdo(
    objects: dict[int, dict[int, str]], place: str, access: str, cob_id: str, kind: str, room: str, *mapped: str
) -> None:
    index = int(place, 16)
    objects[index] = {1: _format_keys(f"{index:04X}:1", "U32", "rw", f"={cob_id}")}
    objects[index][2] = _format_keys(f"{index:04X}:2", "U8", "rw", f"={kind}")
    words = [*mapped, *["0"] * (int(room) - len(mapped))]
    objects[index + 0x200] = {0: _format_keys(f"{index + 0x200:04X}:0", "U8", access, f"={len(mapped)}")}
    for sub, word in enumerate(words, 1):
        value = word if word == "0" else f"0x{word}"
        objects[index + 0x200][sub] = _format_keys(f"{index + 0x200:04X}:{sub}", "U32", access, f"={value}")


def _format_object(index: int, subs: dict[int, str]) -> str:
    if list(subs) == [0]:
        return f"[{index:04X}]\n{subs[0]}\n"
    subs.setdefault(0, _format_keys(f"{index:04X}:0", "U8", "ro", f"={max(subs)}"))
    head = f"[{index:04X}]\nParameterName=Object {index:04X}\nObjectType=9\nSubNumber={len(subs)}\n\n"
    return head + "".join(f"[{index:04X}sub{sub:X}]\n{keys}\n" for sub, keys in sorted(subs.items()))
