"""Recordings of the independent motor, each simulated once."""

from __future__ import annotations

from functools import cache

from tests.api.independent_motor import (
    MOVES,
    MotorRecord,
    build_speed_loop,
    build_speed_steps,
    build_trapezoidal_move,
    run_motor,
)


@cache
def record_motor(move: str) -> MotorRecord:
    """Return the arrays of one move of the motor."""
    if move == "rapids":
        return run_motor(build_speed_loop(build_trapezoidal_move), 2.4)
    if move == "overshooting speed steps":
        return run_motor(build_speed_loop(build_speed_steps), 1.8)
    if move == "locked rotor":
        return run_motor(MOVES["steps of voltage"][0], 1.8, locked=True)
    return run_motor(*MOVES[move])
