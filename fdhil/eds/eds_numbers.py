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
    rest, total, relative = re.sub(r"[\s()]", "", text).upper(), 0, False
    if not rest or _APART.search(text):
        return None
    rest = rest if rest[0] in "+-" else f"+{rest}"
    while rest:
        term = _TERM.match(rest)
        if term is None:
            return None
        sign, word = term[1], term[2]
        if word.startswith("$"):
            if relative or sign == "-":
                return None
            relative = True
        else:
            total += int(sign + word, 16 if word.startswith("0X") else 8 if octal and _OCTAL.fullmatch(word) else 10)
        rest = rest[term.end() :]
    return total, relative


def read_octal(text: str) -> int | None:
    """Read a number with a leading zero as octal; None where that makes no difference.

    CiA 306 and programs in C take it for octal, most files and their tools mean decimal.

    >>> read_octal("0100"), read_octal("007"), read_octal("0180"), read_octal("0x10")
    (64, None, None, None)
    """
    decimal, octal = read_expression(text), read_expression(text, octal=True)
    return None if octal is None or octal == decimal else octal[0]
