"""Sends a file unchanged: a recording or a black box."""

from functools import partial
from typing import BinaryIO

from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

PIECE = 64 * 1024


class FileStreamResponse(StreamingResponse):
    """An open file, sent in pieces, so that many slow clients do not fill the memory."""

    def __init__(self, file: BinaryIO, name: str, media_type: str) -> None:
        self._file = file
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        super().__init__(iter(partial(file.read, PIECE), b""), headers=headers, media_type=media_type)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._file:
            await super().__call__(scope, receive, send)
