"""The guard: the last word on what is added to a set-point, in a process of its own that owns the transmit socket.

``core.step(state, inputs, settings) -> (state, output)`` is pure and decides everything; ``process`` is its shell.
Scope: a bound on what fdhil itself may do. It is no safety function; E-stop, STO, limit switches and the drive's own
limits stay effective without it. Standard library, :mod:`fdhil.errors` and :mod:`fdhil.cia402` only.
"""
