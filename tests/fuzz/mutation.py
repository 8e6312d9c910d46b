"""Random mutation of bytes by a seed: used by the default tests, where no fuzzer may be installed."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

from tests.fuzz.input_assessment import Target

_ODD = (b"\0", b"\xff", b"\x7f", b"\x80", b"-1", b"nan", b"1e999", b"9" * 40, b"\n", b"[" * 40, b"\xed\xa0\x80")


def generate_mutants(target: Target, count: int, seed: int) -> Iterator[bytes]:
    """Yield mutated copies of the target's valid examples."""
    rng = random.Random(f"{target.name} {seed}")
    for _ in range(count):
        data = bytearray(rng.choice(target.seeds))
        for _ in range(rng.choice((1, 1, 2, 4, 8))):
            _mutate_input(data, target, rng)
        yield bytes(data[: target.longest])


def _mutate_input(data: bytearray, target: Target, rng: random.Random) -> None:
    at, size = rng.randrange(len(data) + 1), rng.randrange(1, 17)
    words: Sequence[bytes] = (*_ODD, *target.words)
    match rng.randrange(6):
        case 0:
            data[at : at + 1] = bytes([rng.randrange(256)])
        case 1:
            del data[at : at + size]
        case 2:
            data[at:at] = data[at : at + size] * rng.choice((1, 2, 30))
        case 3:
            data[at : at + rng.choice((0, size))] = rng.choice(words)
        case 4:
            other = rng.choice(target.seeds)
            data[at:] = other[rng.randrange(len(other) + 1) :]
        case _ if data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
