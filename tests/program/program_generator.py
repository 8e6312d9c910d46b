"""Random programs by seed, for the differential tests of both interpreters."""

from __future__ import annotations

import random
from collections.abc import Callable


class ProgramWriter:
    """Writes one random program; ``lines`` grows. Co-ordinates have three decimals, so that four are conclusive."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self.lines: list[str] = ["G21 G90 G94 G17 F500", "S600 M3"]
        self._labels = 100
        self._inch = False
        self._plane = 17

    def write_number(self, low: float = -50.0, high: float = 50.0) -> str:
        """Return a number, sometimes as an expression."""
        value = round(self._random.uniform(low, high), 3)
        kind = self._random.randrange(12)
        if kind == 0:
            part = round(self._random.uniform(-5, 5), 2)
            return f"[{value} + {part} * 2]"
        if kind == 1:
            return f"#{self._random.randint(31, 34)}"
        return f"{value:g}" if "e" not in f"{value:g}" else "0"

    def write_axis_words(self, letters: str, least: int = 1) -> str:
        count = self._random.randint(least, len(letters))
        chosen = self._random.sample(letters, count)
        return " ".join(letter + self.write_number() for letter in chosen)

    def write_straight(self) -> None:
        code = self._random.choice(["G0", "G1", "", "", "G1 F" + str(self._random.randint(10, 900))])
        if not code:
            code = self._random.choice(["G0", "G1"])
        self.lines.append(f"{code} {self.write_axis_words('XYZ')}")

    def write_polar(self) -> None:
        words = self._random.choice(["@{} ^{}", "@{}", "^{1}", "@{} ^{} Z2"])
        self.lines.append("G1 " + words.format(round(self._random.uniform(1, 30), 2), self._random.randint(-200, 200)))

    def write_arc(self) -> None:
        plane = self._random.choice([17, 18, 19])
        first, second = {17: ("X", "Y"), 18: ("X", "Z"), 19: ("Y", "Z")}[plane]
        offset = {17: "IJ", 18: "IK", 19: "JK"}[plane]
        code = self._random.choice(["G2", "G3"])
        normal = {17: "Z", 18: "Y", 19: "X"}[plane]
        helix = self._random.choice(["", "", f" {normal}{self.write_number()}"])
        turns = self._random.choice(["", "", " P2", " P3"])
        self.lines.append(f"G91 G{plane}")
        a, b = (round(self._random.uniform(1, 20), 3) for _ in range(2))
        shape = self._random.randrange(4)
        if shape == 0:
            self.lines.append(f"{code} {first}{2 * a:g} {second}0 {offset[0]}{a:g}{helix}{turns}")
        elif shape == 1:
            self.lines.append(f"{code} {offset[0]}{a:g} {offset[1]}{-b:g}{helix}{turns}")
        elif shape == 2:
            self.lines.append(
                f"{code} {first}{a:g} {second}{b:g} R{self._random.choice(['', '-'])}{a + b:g}{helix}{turns}"
            )
        else:
            self.lines.append(f"{code} {first}{a:g} {second}{a:g} {offset[0]}{a:g} {offset[1]}0{helix}")
        self.lines.append(self._random.choice(["G90", "G90", "G90 G17", "G91"]))

    def write_modes(self) -> None:
        self.lines.append(
            self._random.choice(
                [
                    "G17",
                    "G18",
                    "G19",
                    "G90",
                    "G90",
                    "G91",
                    "G20",
                    "G21",
                    "G98",
                    "G99",
                    "G61",
                    "G64 P0.1",
                    "G4 P0.25",
                    "G80",
                    "G7",
                    "G8",
                    "G94 F300",
                    "M8",
                    "M9",
                    "G90 G49 G21 G8",
                ]
            )
        )

    def write_inverse_time(self) -> None:
        self.lines += [f"G93 G1 {self.write_axis_words('XYZ')} F{self._random.randint(1, 20)}", "G94 F250"]

    def write_offsets(self) -> None:
        system = self._random.randint(1, 9)
        self.lines.append(
            self._random.choice(
                [
                    f"G10 L2 P{system} {self.write_axis_words('XYZ')}",
                    f"G10 L20 P{system} {self.write_axis_words('XYZ')}",
                    f"G10 L2 P{system} R{self._random.randint(-90, 90)}",
                    "G10 L2 P0 R0",
                    f"G{SYSTEMS[system - 1]}",
                    f"G92 {self.write_axis_words('XYZ')}",
                    f"G52 {self.write_axis_words('XYZ')}",
                    "G92.1",
                    "G92.2",
                    "G92.3",
                    f"G90 G53 G0 {self.write_axis_words('XYZ')}",
                    "G28.1",
                    "G30.1",
                    "G28",
                    f"G28 {self.write_axis_words('XYZ')}",
                    "G30",
                    f"G30 {self.write_axis_words('XY')}",
                    f"G43.1 {self.write_axis_words('XYZ')}",
                    "G49",
                    "G43.1 Z3",
                ]
            )
        )

    def write_cycle(self) -> None:
        code = self._random.choice(["73", "81", "82", "83", "84", "74", "85", "86", "87", "88", "89", "81"])
        if code == "74":
            self.lines += ["M4", "G17"]
        absolute = self._random.random() < 0.7
        top = round(self._random.uniform(-5, 20), 2)
        depth = round((top if absolute else 0.0) - self._random.uniform(0.5, 20), 2)
        repeat = self._random.choice(["", "", " L2", " L3"])
        self.lines.append(
            f"G{90 if absolute else 91} G{self._random.choice([98, 99])} G{code} {self.write_axis_words('XY')} "
            f"Z{depth} R{top}"
            f"{' Q' + str(round(self._random.uniform(0.7, 9), 2)) if code in ('73', '83') else ''}"
            f"{' P0.5' if code in ('82', '86', '88', '89') else ''}"
            f"{' I1.5 J-2 K' + str(round(depth + 0.3, 2)) if code == '87' else ''}{repeat if code != '74' else ''}"
        )
        for _ in range(self._random.randrange(3)):
            self.lines.append(self.write_axis_words("XY"))
        self.lines += ["G80", "M3"]

    def write_parameter(self) -> None:
        a, b = self.write_number(), self.write_number(1, 5)
        operator = self._random.choice(["+", "-", "*", "/", "mod", "eq", "gt", "le", "and", "or", "xor", "ne"])
        function = self._random.choice(["abs", "fix", "fup", "round", "sin", "cos"])
        self.lines.append(f"#{self._random.randint(31, 34)} = {function}[{a} {operator} {b} - 1]")

    def write_loop(self) -> None:
        self._labels += 1
        label, kind = self._labels, self._random.randrange(4)
        body = f"G1 X[#40 * 1.5] Y{self.write_number()} F200"
        if kind == 0:
            self.lines += [f"o{label} repeat [{self._random.randint(0, 3)}]", body, f"o{label} endrepeat"]
        elif kind == 1:
            self.lines += ["#40 = 0", f"o{label} while [#40 lt 3]", body, "#40 = [#40 + 1]", f"o{label} endwhile"]
        elif kind == 2:
            self.lines += ["#40 = 0", f"o{label} do", body, "#40 = [#40 + 1]", f"o{label} while [#40 lt 2]"]
        else:
            self.lines += [
                f"o{label} if [#31 gt 0]",
                body,
                f"o{label} elseif [#32 gt 0]",
                "G0 Z1",
                f"o{label} else",
                "G0 X1",
                f"o{label} endif",
            ]

    def write_subroutine(self) -> None:
        self._labels += 1
        label = self._labels
        self.lines += [
            f"o{label} sub",
            "G0 X#1 Y[#2 * 2]",
            "#1 = [#1 + 1]",
            f"o{label}9 if [#1 gt 3]",
            f"o{label}9 return [#1]",
            f"o{label}9 endif",
            "G1 Z#1",
            f"o{label} endsub [7]",
            f"o{label} call [{self.write_number()}] [2.5]",
            "G0 X[#<_value>]",
            f"o{label} call",
        ]

    def write_compensated_path(self) -> None:
        """A path with cutter compensation; occasionally one that is impossible."""
        pick = self._random
        plane = pick.choice(["G17", "G17", "G18"])
        first, second, normal = ("X", "Y", "Z") if plane == "G17" else ("X", "Z", "Y")
        offset = "IJ" if plane == "G17" else "IK"
        self.lines += [plane, f"G{pick.choice(['41.1', '42.1'])} D{round(pick.uniform(0.2, 3), 2)}", "G91"]
        self.lines.append(f"G1 {first}{pick.randint(8, 20)} {second}{pick.randint(-20, 20)}")
        for _ in range(pick.randint(1, 8)):
            a, b = round(pick.uniform(-25, 25), 2), round(pick.uniform(-25, 25), 2)
            kind = pick.randrange(9)
            if kind < 4:
                self.lines.append(f"{pick.choice(['G1', 'G1', 'G0'])} {first}{a:g} {second}{b:g}")
            elif kind < 6:
                radius = round(((a * a + b * b) ** 0.5) * pick.uniform(0.52, 1.5) + 0.01, 3)
                sign = pick.choice(["", "", "-"])
                self.lines.append(f"G{pick.choice([2, 3])} {first}{a:g} {second}{b:g} R{sign}{radius:g}")
            elif kind == 6:
                self.lines.append(
                    f"G{pick.choice([2, 3])} {first}{2 * a:g} {offset[0]}{a:g} {normal}{pick.randint(-3, 3)}"
                )
            elif kind == 7:
                self.lines.append(f"G1 {normal}{pick.randint(-5, 5)}")
            else:
                self.lines.append(pick.choice(["G4 P0.1", "F333", "M8"]))
        self.lines += ["G40", "G90", f"G1 {self.write_axis_words('XYZ', 2)}", "G17"]

    def write_thread(self) -> None:
        pick = self._random
        self.lines += ["M3 S600 G18", f"G0 X{pick.randint(10, 30)} Z{pick.randint(-5, 5)}"]
        first = round(pick.uniform(0.2, 0.5), 2)
        self.lines.append(
            f"G76 P1.5 Z{pick.randint(-40, 40)} I{pick.choice([-1, 1]) * round(pick.uniform(0.5, 2), 2)} J{first}"
            f" K{round(first + pick.uniform(0.1, 2), 2)} R{pick.choice([1, 1.5, 2])} Q{pick.choice([0, 29.5])}"
            f" H{pick.randint(0, 2)} E{round(pick.uniform(0.1, 2), 2)} L{pick.randint(0, 3)}"
        )
        self.lines += [
            f"G33 {self.write_axis_words('XZ')} K{round(pick.uniform(0.5, 3), 2)}",
            "G33.1 Z-20 K1.25",
            "G17 G80",
        ]

    def write_contour(self) -> None:
        """A turned contour in a subroutine, roughed and finished; occasionally an impossible one."""
        pick = self._random
        self._labels += 1
        label = self._labels
        self.lines += ["G18 G90 G40", f"o{label} sub"]
        x, z = pick.randint(0, 4), 0
        self.lines.append(f"G0 X{x} Z{z}")
        for _ in range(pick.randint(1, 6)):
            kind = pick.randrange(5)
            dx, dz = pick.randint(1, 4), pick.randint(1, 6)
            corner = pick.choice(["", "", "", " A0.4", " C0.5"])
            if kind == 0:
                self.lines.append(f"G1 Z{z - dz}{corner}")
                dx = 0
            elif kind == 1:
                self.lines.append(f"G1 X{x + dx}{corner}")
                dz = 0
            elif kind == 2:
                self.lines.append(f"G1 X{x + dx} Z{z - dz}{corner}")
            elif kind == 3:
                dz = dx
                self.lines.append(f"G2 X{x + dx} Z{z - dz} {pick.choice([f'I{dx}', f'R{dx}'])}")
            else:
                dz = dx
                self.lines.append(f"G3 X{x + dx} Z{z - dz} K{-dx}")
            x, z = x + dx, z - dz
        start = f"X{x + pick.randint(0, 3)} Z{pick.randint(1, 4)}"
        self.lines += [f"o{label} endsub", f"G0 {start}"]
        code = pick.choice(["71", "71", "72", "71.1", "71.2", "72.1", "72.2"])
        stock = pick.choice([0, 0, 0.2, 0.5])
        self.lines.append(f"G{code} Q{label} {start} D{stock} I{pick.choice([0.5, 1, 1.7])} R{pick.choice([0.3, 0.5])}")
        self.lines += [f"G70 Q{label} {start} D0.3 E0 P{pick.randint(1, 3)}", "G17"]

    def write_cycle_series(self) -> None:
        """Consecutive cycle blocks with changed words, levels, planes and retracts."""
        pick = self._random
        planes = [(17, "X", "Y", "Z"), (17, "X", "Y", "Z"), (18, "Z", "X", "Y"), (19, "Y", "Z", "X")]
        plane, first, second, normal = pick.choice(planes)
        code = pick.choice(["81", "82", "83", "73", "85", "89"])
        extra = {"82": " P0.2", "89": " P0.1", "83": " Q1.3", "73": " Q2.1"}.get(code, "")
        top = pick.randint(0, 6)
        self.lines += [f"G{plane} G{pick.choice([90, 90, 91])}", f"G0 {normal}{pick.randint(0, 9)}"]
        place = f"{first}{self.write_number()} {second}1 {normal}{-pick.randint(1, 9)}"
        self.lines.append(f"G{pick.choice([98, 99])} G{code} {place} R{top}{extra}")
        for _ in range(pick.randint(1, 5)):
            words = pick.choice(
                [
                    f"{first}{self.write_number()}",
                    f"{second}{pick.randint(-9, 9)} R{pick.randint(0, 8)}",
                    f"G98 {first}3",
                    f"G99 {second}4",
                    f"{first}2 L{pick.randint(1, 3)}",
                    f"{normal}{-pick.randint(1, 9)}",
                    "M8",
                    f"G92 {first}{pick.randint(0, 3)}",
                    f"F{pick.randint(10, 90)} {second}2",
                ]
            )
            self.lines.append(words)
        self.lines += ["G80 G90 G17"]

    def write_saved_modes(self) -> None:
        self.lines += [
            "M70",
            self._random.choice(["G20 G91", "G18", "G7", "G55", "F33"]),
            f"G1 {self.write_axis_words('XYZ')}",
            "M72",
        ]


SYSTEMS = ("54", "55", "56", "57", "58", "59", "59.1", "59.2", "59.3")
GROUPS: dict[str, list[Callable[[ProgramWriter], None]]] = {
    "moves": [
        ProgramWriter.write_straight,
        ProgramWriter.write_straight,
        ProgramWriter.write_modes,
        ProgramWriter.write_parameter,
        ProgramWriter.write_polar,
        ProgramWriter.write_inverse_time,
    ],
    "arcs": [ProgramWriter.write_straight, ProgramWriter.write_arc, ProgramWriter.write_arc],
    "offsets": [
        ProgramWriter.write_straight,
        ProgramWriter.write_straight,
        ProgramWriter.write_offsets,
        ProgramWriter.write_offsets,
        ProgramWriter.write_modes,
    ],
    "cycles": [
        ProgramWriter.write_straight,
        ProgramWriter.write_cycle,
        ProgramWriter.write_cycle,
        ProgramWriter.write_offsets,
    ],
    "series": [ProgramWriter.write_cycle_series, ProgramWriter.write_cycle_series, ProgramWriter.write_straight],
    "contours": [ProgramWriter.write_contour],
    "compensation": [ProgramWriter.write_straight, ProgramWriter.write_compensated_path],
    "lathe": [ProgramWriter.write_straight, ProgramWriter.write_thread, ProgramWriter.write_modes],
    "flow": [
        ProgramWriter.write_straight,
        ProgramWriter.write_loop,
        ProgramWriter.write_subroutine,
        ProgramWriter.write_parameter,
        ProgramWriter.write_saved_modes,
    ],
}
GROUPS["all"] = [step for name, group in GROUPS.items() if name != "contours" for step in group]


def generate_program(group: str, seed: int, steps: int = 25) -> str:
    """Return the text of one random program of a group."""
    writer = ProgramWriter(seed)
    pick = random.Random(seed + 1)
    for _ in range(steps):
        pick.choice(GROUPS[group])(writer)
    return "\n".join([*writer.lines, "M2", ""])
