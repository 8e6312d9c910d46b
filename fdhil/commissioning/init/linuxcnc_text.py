"""Parse the text of LinuxCNC's INI and HAL files, as documented in its "INI Configuration" and "HAL".

Pure: text in, tables out. Of HAL only the parameters that are set and the pins on each signal are kept: they give the
scale of a joint and the loops around it.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

_SUBSTITUTE = re.compile(r"\[(\w+)\]\(?(\w+)\)?")
_HAL_ARROWS = frozenset({"=>", "<=", "<=>"})

_PIDS = {"pid": "pid", "at_pid": "pid"}  # component, and what its numbered instances are called
_DEFAULT_LOOPS, _MOST_LOOPS = 3, 16
_OUTPUT = re.compile(r".*out|sum$|result$|pos-cmd$")
_ENDS = frozenset({"joint", "axis", "motion", "halui", "ini"})  # LinuxCNC's own

Read = Callable[[str], str]
"""Returns the text of a file that another one names; OSError or ValueError if it cannot be read."""


@dataclass(frozen=True, slots=True)
class Ini:
    """Sections of keys in file order; a key may occur several times.

    ``repeated`` are sections that occur again, which LinuxCNC ignores.
    """

    sections: Mapping[str, Mapping[str, tuple[str, ...]]]
    repeated: tuple[str, ...] = ()

    def find_all(self, section: str, key: str) -> tuple[str, ...]:
        """Return every value of a key; empty without one."""
        return self.sections.get(section, {}).get(key, ())

    def get_text(self, section: str, key: str) -> str:
        """Return a key's first value, as LinuxCNC does; empty without one."""
        return next(iter(self.find_all(section, key)), "")

    def get_number(self, section: str, key: str) -> float | None:
        """Return a key's first word as a finite number; None if it is not one."""
        return parse_finite(self.get_text(section, key))


def parse_finite(text: str) -> float | None:
    """Return the first word of a text as a finite number; None if it is not one.

    >>> parse_finite("20.0  # mm"), parse_finite("fast"), parse_finite("nan")
    (20.0, None, None)
    """
    try:
        value = float(text.split()[0])
    except (ValueError, IndexError):
        return None
    return value if abs(value) < float("inf") else None


def parse_ini(text: str, read: Read) -> Ini:
    """Parse an INI file and those that it includes (``#INCLUDE file``); any other line is ignored."""
    sections: dict[str, dict[str, tuple[str, ...]]] = {}
    current: dict[str, tuple[str, ...]] = {}
    repeated: dict[str, None] = {}
    for line in _expand_includes(text, read):
        line = line.strip()
        if line.startswith("[") and "]" in line:
            name, current = line[1 : line.index("]")].strip(), {}
            if name in sections:
                repeated[name] = None
            else:
                sections[name] = current
        elif "=" in line and line[0] not in "#;":
            key, _, value = line.partition("=")
            current[key.strip()] = (*current.get(key.strip(), ()), value.strip())
    return Ini(sections, tuple(repeated))


def _expand_includes(text: str, read: Read, depth: int = 0) -> Iterator[str]:
    for line in _join_continued_lines(text):
        words = line.split()
        if len(words) > 1 and words[0] == "#INCLUDE":
            if depth > 8:
                raise ValueError("files include each other endlessly")
            yield from _expand_includes(read(words[1]), read, depth + 1)
        else:
            yield line


def _join_continued_lines(text: str) -> Iterator[str]:
    yield from re.sub(r"\\[ \t]*\r?\n", " ", text).splitlines()  # a backslash continues the line


@dataclass(slots=True)
class HalNetlist:
    """Parameters that are set, the pins on each signal, the components that are PID loops, and all loaded components.

    ``threads`` holds the functions of each thread in order.
    """

    given: dict[str, str] = field(default_factory=dict)
    nets: dict[str, set[str]] = field(default_factory=dict)
    loops: set[str] = field(default_factory=set)
    loaded: set[str] = field(default_factory=set)
    threads: dict[str, list[str]] = field(default_factory=dict)

    def find_linked_pins(self, pin: str) -> list[str]:
        """Return the other pins on a pin's signal, in alphabetical order."""
        return sorted(other for pins in self.nets.values() if pin in pins for other in pins - {pin})

    def find_linked_components(self, pin: str) -> list[str]:
        """Return the components (with instance) whose pins are on a pin's signal."""
        return list(dict.fromkeys(other.rpartition(".")[0] for other in self.find_linked_pins(pin)))

    def find_pid_loops(self, pin: str) -> list[str]:
        """Return the PID loops that a pin commands, directly or through a chain of components (adders, limits, ...)."""
        found: dict[str, None] = {}
        waiting, seen = [pin], {pin}
        while waiting:
            for other in self.find_linked_pins(waiting.pop()):
                component, _, name = other.rpartition(".")
                if component in self.loops or component.startswith("pid."):
                    if name == "command":
                        found[component] = None
                elif component.partition(".")[0] not in _ENDS:
                    waiting += [out for out in self._find_output_pins(component) if out not in seen]
                    seen.update(waiting)
        return sorted(found)

    def _find_output_pins(self, component: str) -> list[str]:
        pins = [pin.rpartition(".") for pins in self.nets.values() for pin in pins]
        return sorted(f"{owner}.{name}" for owner, _, name in pins if owner == component and _OUTPUT.match(name))


def parse_hal(text: str, ini: Ini, read: Read, hal: HalNetlist, depth: int = 0) -> None:
    """Add the commands of a HAL file, and of those that it sources, to ``hal``; unknown commands are ignored."""
    for line in _join_continued_lines(text):
        # keys missing in the INI are kept verbatim
        words = _SUBSTITUTE.sub(lambda found: ini.get_text(found[1], found[2]) or found[0], line).split()
        words = words[: next((k for k, word in enumerate(words) if word.startswith("#")), len(words))]
        match words:
            case ["setp", pin, value, *_]:
                hal.given[pin] = value
            case [pin, "=", value, *_]:
                hal.given[pin] = value
            case ["net" | "linksp", signal, *pins]:
                hal.nets.setdefault(signal, set()).update(pin for pin in pins if pin not in _HAL_ARROWS)
            case ["linkps", pin, *rest] if signals := [word for word in rest if word not in _HAL_ARROWS]:
                hal.nets.setdefault(signals[0], set()).add(pin)
            case ["loadrt" | "newinst", name, *arguments]:
                hal.loaded.add(name)
                hal.loops.update(_list_instances(name, arguments) if name in _PIDS else ())
            case ["addf", function, thread, *position]:
                functions = hal.threads.setdefault(thread, [])
                place = int(position[0]) if position and position[0].lstrip("-").isdecimal() else -1
                functions.insert(place - 1 if place > 0 else len(functions) + place + 1, function)
            case ["source", name] if depth < 8:
                parse_hal(read(name), ini, read, hal, depth + 1)


def _list_instances(name: str, arguments: Sequence[str]) -> Iterator[str]:
    for argument in arguments:
        key, equals, value = argument.replace('"', "").partition("=")
        if key == "names" or not equals:
            yield from (value or key).split(",")
        elif key in ("count", "num_chan") and value.isdecimal():
            yield from (f"{_PIDS[name]}.{number}" for number in range(min(int(value), _MOST_LOOPS)))
    if not arguments:
        yield from (f"{_PIDS[name]}.{number}" for number in range(_DEFAULT_LOOPS))
