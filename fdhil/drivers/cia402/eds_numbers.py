"""Reads the numbers of EDS and DCF files (CiA 306): decimal, hexadecimal, with leading zeros, with $NODEID. Pure."""

import re

_TERM = re.compile(r"([+-])(\$NODE_?ID|0X[0-9A-F]{1,16}|[0-9]{1,20})[UL]*")
_OCTAL = re.compile(r"0[0-7]+")
_APART = re.compile(r"\w\s+[\w$]")


def read_number(text: str) -> int | None:
    """Read a number without $NODEID, leading zeros as decimal; None for anything else.

    >>> read_number("0x1F"), read_number("007"), read_number("$NODEID")
    (31, 7, None)
    """
    found = read_expression(text)
    return None if found is None or found[1] else found[0]


def read_expression(text: str, *, octal: bool = False) -> tuple[int, bool] | None:
    """Read a sum of numbers and at most one $NODEID: the sum of the numbers, and whether the node-ID is to be added.

    ``octal``: a leading zero means octal.

    >>> read_expression("0x180 + $NodeId"), read_expression("$NODEID"), read_expression("$NODEID*2")
    ((384, True), (0, True), None)
    """
    left, total, relative = re.sub(r"[\s()]", "", text).upper(), 0, False
    if not left or _APART.search(text):
        return None
    left = left if left[0] in "+-" else f"+{left}"
    while left:
        term = _TERM.match(left)
        if term is None:
            return None
        sign, word = term[1], term[2]
        if word.startswith("$"):
            if relative or sign == "-":
                return None
            relative = True
        else:
            total += int(sign + word, 16 if word.startswith("0X") else 8 if octal and _OCTAL.fullmatch(word) else 10)
        left = left[term.end() :]
    return total, relative


def octal_reading(text: str) -> int | None:
    """Return what a number with a leading zero is where that means octal, if it is another then; None otherwise.

    CiA 306 and programs in C take it for octal, most files and their tools mean decimal.

    >>> octal_reading("0100"), octal_reading("007"), octal_reading("0180"), octal_reading("0x10")
    (64, None, None, None)
    """
    decimal, octal = read_expression(text), read_expression(text, octal=True)
    return None if octal is None or octal == decimal else octal[0]
