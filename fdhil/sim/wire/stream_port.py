"""Serves a stream of text as a serial device: a pseudo terminal with the configured name."""

import contextlib
import os
import tty
from pathlib import Path

from fdhil.errors import ConnectError


class StreamPort:
    """A pseudo terminal behind the link ``device``; unread data is lost, as on a wire."""

    def __init__(self, name: str, device: str) -> None:
        """Create it; ConnectError when the name is in use, or the folder cannot be written."""
        self._link = Path(device)
        if self._link.exists() and not self._link.is_symlink():
            raise ConnectError(name, f"{device} already exists; choose another name, the simulator creates the device")
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
                name, f"{device} cannot be created ({error.strerror}); choose a writable folder"
            ) from None

    def send_lines(self, data: bytes) -> None:
        """Send as many whole lines as fit; the rest is lost."""
        for line in data.splitlines(keepends=True):
            try:
                os.write(self._ours, line)
            except BlockingIOError:
                return

    def close(self) -> None:
        if self._link.is_symlink() and str(self._link.readlink()) == self.path:
            self._link.unlink()
        for descriptor in (self._ours, self._theirs):
            with contextlib.suppress(OSError):
                os.close(descriptor)
