"""Gets a document, or a stream of documents, over HTTP/1.1, to the extent that an MTConnect agent needs.

Sources: RFC 9112 (messages, chunked), RFC 2046 5.1 (multipart); MTConnect Standard Part 1 (multipart/x-mixed-replace).
"""

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

from fdhil.errors import ConnectError, DeviceTimeout, ProtocolError

MOST_HEAD_BYTES = 1 << 16
MOST_BYTES = 1 << 24  # of a document
MOST_DIGITS = 18
READ_BYTES = 1 << 16
_STATUS = re.compile(rb"HTTP/1\.[01] (\d{3})")


class Response:
    """An answer whose head has arrived; the body is read on demand."""

    def __init__(self, name: str, reader: asyncio.StreamReader) -> None:
        self._name, self._reader = name, reader
        self._rest = b""
        self._left: int | None = None  # bytes of the body, or of the present chunk; None: until the end
        self._chunked = False
        self.status = 0
        self.headers: dict[str, str] = {}

    async def read_head(self) -> None:
        """Read the head; ConnectError, ProtocolError."""
        lines = (await self._read_until(b"\r\n\r\n")).split(b"\r\n")
        found = _STATUS.match(lines[0])
        if found is None:
            raise ProtocolError(self._name, f"answers {lines[0][:40]!r}, which is not HTTP; compare host and port")
        self.status = int(found[1])
        for line in lines[1:]:
            key, _, value = line.decode("latin-1").partition(":")
            self.headers[key.strip().lower()] = value.strip()
        self._chunked = "chunked" in self.headers.get("transfer-encoding", "").lower()
        length = self.headers.get("content-length", "")
        self._left = 0 if self._chunked else int(length) if length.isdecimal() and len(length) <= MOST_DIGITS else None

    async def _read_until(self, end: bytes) -> bytes:
        while end not in self._rest:
            if len(self._rest) > MOST_HEAD_BYTES:
                raise ProtocolError(self._name, "sends a head without an end; compare host and port")
            self._rest += await self._receive_bytes()
        found, _, self._rest = self._rest.partition(end)
        return found

    async def _receive_bytes(self) -> bytes:
        try:
            came = await self._reader.read(READ_BYTES)
        except OSError as error:
            raise ConnectError(self._name, f"the connection is lost ({error}); is it still running?") from None
        if not came:
            raise ConnectError(self._name, "it ended the connection; is it still running?")
        return came

    async def read_some(self) -> bytes:
        """Return the next bytes of the body, none at its end; ConnectError, ProtocolError."""
        if self._left == 0 and not (self._chunked and await self._begin_chunk()):
            return b""
        if not self._rest:
            if self._left is None and self._reader.at_eof():
                return b""
            self._rest = await self._receive_bytes()
        size = len(self._rest) if self._left is None else min(self._left, len(self._rest))
        came, self._rest = self._rest[:size], self._rest[size:]
        if self._left is not None:
            self._left -= size
            if self._chunked and not self._left:
                await self._read_until(b"\r\n")
        return came

    async def _begin_chunk(self) -> bool:
        size = (await self._read_until(b"\r\n")).partition(b";")[0].strip()
        try:
            self._left = int(size, 16)
        except ValueError:
            self._left = -1
        if not 0 <= self._left <= MOST_BYTES:
            raise ProtocolError(self._name, f"announces a chunk of {size[:20]!r} bytes; is a proxy in between?")
        if not self._left:
            self._chunked = False
        return bool(self._left)

    async def read_document(self) -> bytes:
        """Return the whole body; ProtocolError if it is too large."""
        whole = b""
        try:
            while came := await self.read_some():
                whole += came
                if len(whole) > MOST_BYTES:
                    raise ProtocolError(self._name, f"sends more than {MOST_BYTES >> 20} MiB as one document")
        except ConnectError:
            if self._left is not None:
                raise
        return whole


class MultipartSplitter:
    """Splits the body of a multipart answer into its parts. Pure."""

    def __init__(self, name: str, content_type: str) -> None:
        self._name = name
        found = re.search(r'boundary="?([^";,\s]{1,200})"?', content_type)
        if not content_type.lower().startswith("multipart/") or found is None:
            text = f"answers with {content_type[:60]!r} instead of a stream; is a proxy in between?"
            raise ProtocolError(name, text)
        self._mark = b"--" + found[1].encode().removeprefix(b"--")
        self._rest = b""

    def split_parts(self, came: bytes) -> list[bytes]:
        """Add bytes; return the completed parts. ProtocolError for invalid ones."""
        self._rest += came
        parts = []
        while (part := self._take_part()) is not None:
            parts.append(part)
        if len(self._rest) > MOST_BYTES + MOST_HEAD_BYTES:
            raise ProtocolError(self._name, f"sends more than {MOST_BYTES >> 20} MiB as one document")
        return parts

    def _take_part(self) -> bytes | None:
        at = self._rest.find(self._mark)
        if at < 0:
            self._refuse_if(len(self._rest) > MOST_HEAD_BYTES)
            return None
        end = self._rest.find(b"\r\n\r\n", at)
        if end < 0:
            self._refuse_if(len(self._rest) - at > MOST_HEAD_BYTES)
            return None
        length = re.search(rb"content-length:\s*(\d{1,12})", self._rest[at:end], re.IGNORECASE)
        if length is None or int(length[1]) > MOST_BYTES:
            raise ProtocolError(self._name, "sends a part of a stream without a length; is a proxy in between?")
        begin, size = end + 4, int(length[1])
        if len(self._rest) < begin + size:
            return None
        part, self._rest = self._rest[begin : begin + size], self._rest[begin + size :]
        return part

    def _refuse_if(self, lost: bool) -> None:
        if lost:
            raise ProtocolError(self._name, "sends a stream without parts; is a proxy in between?")


@asynccontextmanager
async def open_document(name: str, url: str, timeout_s: float) -> AsyncIterator[Response]:
    """Request a document; its head has arrived on entry. ConnectError, DeviceTimeout, ProtocolError."""
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or 80
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    writer = None
    try:
        try:
            async with asyncio.timeout(timeout_s):
                reader, writer = await asyncio.open_connection(host, port)
                writer.write(
                    f"GET {target} HTTP/1.1\r\nHost: {parts.netloc}\r\nAccept: text/xml\r\n"
                    "User-Agent: fdhil\r\nConnection: close\r\n\r\n".encode("ascii", "replace")
                )
                response = Response(name, reader)
                await response.read_head()
        except TimeoutError:
            text = f"{host}:{port} does not answer within {timeout_s:g} s; is it switched on and the agent running?"
            raise DeviceTimeout(name, text) if writer else ConnectError(name, text) from None
        except OSError as error:
            text = f"{host}:{port} cannot be reached ({error}); start the agent, or correct url"
            raise ConnectError(name, text) from None
        yield response
    finally:
        if writer is not None:
            writer.close()
