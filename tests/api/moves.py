"""Recordings of the independent motor, each simulated once."""

from __future__ import annotations

from functools import cache

from tests.api.foreign_motor import MOVES, Measured, run, speed_loop, steps, trapezium


@cache
def measured(move: str) -> Measured:
    """Return the arrays of one move of the motor."""
    if move == "rapids":
        return run(speed_loop(trapezium), 2.4)
    if move == "overshooting speed steps":
        return run(speed_loop(steps), 1.8)
    if move == "locked rotor":
        return run(MOVES["steps of voltage"][0], 1.8, locked=True)
    return run(*MOVES[move])
