"""Bounds what fdhil may add to a set-point: a separate process that owns the transmit socket.

``guard_step.step_guard(state, inputs, settings) -> (state, output)`` is pure and decides everything; ``guard_process``
is its shell.
Scope: a bound on what fdhil itself may send. It is not a safety function; E-stop, STO, limit switches and the drive's
own limits stay effective without it. It imports the standard library, :mod:`fdhil.errors`, :mod:`fdhil.cia402` and
:mod:`fdhil.lazy_exports` only.
"""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
