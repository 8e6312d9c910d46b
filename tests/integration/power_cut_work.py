"""Runs in the machine whose power is cut: reports the stored records, then keeps storing records of all kinds.

Its clock is set before each round of records: their order must not depend on it.
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from itertools import count
from pathlib import Path

from tests.crash.stored_records import KEEPERS, Keeper, place_of

JUMPS_S = (0.0, 3600.0, -3600.0, -1.7e9, 3.0e8)  # an hour either way, back to about 1970, on to ten years ahead


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    folder, begun_s = Path(sys.argv[1]), time.time()
    if sys.argv[2] == "careless":
        os.fsync = lambda fd: None
    keepers: dict[str, Keeper] = {}
    there: dict[str, set[int]] = {}
    for name, make in KEEPERS.items():
        place = folder / place_of(name)
        place.mkdir(parents=True, exist_ok=True)
        keepers[name] = make(place)
        there[name] = keepers[name].found()
        for line in keepers[name].said:
            say(f"told {name}: {line}")
    say("found " + json.dumps({name: sorted(numbers) for name, numbers in there.items()}))
    for number in count(1 + max((number for numbers in there.values() for number in numbers), default=0)):
        time.clock_settime(time.CLOCK_REALTIME, begun_s + random.choice(JUMPS_S))
        for name, keeper in keepers.items():
            keeper.keep(number)
            say(f"kept {name} {number}")


if __name__ == "__main__":
    main()
