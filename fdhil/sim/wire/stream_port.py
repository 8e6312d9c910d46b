"""Serves a stream of text as a serial device: a pseudo terminal, under the name that the configuration gives it."""

import contextlib
import os
import tty
from pathlib import Path

from fdhil.errors import ConnectError


class StreamPort:
    """A pseudo terminal behind the link ``device``; what nobody reads is lost, as on a wire."""

    def __init__(self, name: str, device: str) -> None:
        """Make it; ConnectError when something else has that name, or the folder cannot be written."""
        self._link = Path(device)
        if self._link.exists() and not self._link.is_symlink():
            raise ConnectError(name, f"{device} is there already: give another device, the simulator makes that one")
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.path = os.ttyname(self._theirs)
        try:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self.path)
        except OSError as error:
            self.close()
            raise ConnectError(
                name, f"{device} cannot be made ({error.strerror}): name it in a folder of yours"
            ) from None

    def send(self, data: bytes) -> None:
        """Send what there is room for; a line that does not fit is lost whole."""
        for line in data.splitlines(keepends=True):
            try:
                os.write(self._ours, line)
            except BlockingIOError:
                return

    def close(self) -> None:
        """Close it and take its name away."""
        if self._link.is_symlink() and str(self._link.readlink()) == self.path:
            self._link.unlink()
        for descriptor in (self._ours, self._theirs):
            with contextlib.suppress(OSError):
                os.close(descriptor)
