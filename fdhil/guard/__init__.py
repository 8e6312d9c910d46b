"""Bounds what fdhil may add to a set-point: a separate process that owns the transmit socket.

``core.step(state, inputs, settings) -> (state, output)`` is pure and decides everything; ``process`` is its shell.
Scope: a bound on what fdhil itself may send. It is not a safety function; E-stop, STO, limit switches and the drive's
own limits stay effective without it. It imports the standard library, :mod:`fdhil.errors` and :mod:`fdhil.cia402` only.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
