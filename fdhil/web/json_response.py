"""Serialises JSON responses, whatever text they contain."""

import json
from typing import Any

from fastapi.responses import JSONResponse
from pydantic_core import PydanticSerializationError, to_json


class SafeJsonResponse(JSONResponse):
    """A JSON response: non-finite numbers become null, lone surrogates a question mark.

    Lone surrogates come from file names that are not UTF-8 and cannot be sent.
    """

    def render(self, content: Any) -> bytes:
        try:
            return to_json(content, inf_nan_mode="null")
        except PydanticSerializationError:
            whole = json.dumps(content, ensure_ascii=False).encode("utf-8", "replace")
            return to_json(json.loads(whole), inf_nan_mode="null")
