"""Typesets units and signs: ASCII in data and terminals, µm, ±, °C and N·m in pages."""

import re

# longer units match first
_PRINTED = {
    "N.m.s/rad": "N·m·s/rad",
    "N.m/A": "N·m/A",
    "N.m.s": "N·m·s",
    "mN.m.s": "mN·m·s",
    "N.m": "N·m",
    "kg.m2": "kg·m²",
    "g.m2": "g·m²",
    "mm/s2": "mm/s²",
    "mohm": "mΩ",
    "ohm": "Ω",
    "degC": "°C",
    "um": "µm",
    "+-": "±",
    "->": "→",
}
_ALONE = re.compile(
    r"(?<![\w./-])(" + "|".join(re.escape(unit) for unit in sorted(_PRINTED, key=len, reverse=True)) + r")(?!\w|[./]\w)"
)
_TIMES = re.compile(r"(?<=\d) x(?![\w.])")
_EXPONENT = re.compile(r"(?<=\))e(-?\d+)")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_TEXT = re.compile(r">[^<>]+<|aria-label=\"[^\"]*\"")


def typeset_text(text: str) -> str:
    """Return plain text with typeset units and signs; file names stay unchanged."""
    text = _EXPONENT.sub(lambda found: "·10" + found[1].translate(_RAISED), text)
    return _TIMES.sub(" ×", _ALONE.sub(lambda found: _PRINTED[found[0]], text))


def typeset_markup(markup: str) -> str:
    """Return a picture's markup with its text typeset."""
    return _TEXT.sub(lambda found: typeset_text(found[0]), markup)
