"""How every answer that is JSON is written: whatever text is in it."""

import json
from typing import Any

from fastapi.responses import JSONResponse
from pydantic_core import PydanticSerializationError, to_json


class Json(JSONResponse):
    """Every JSON of the pages: a number that is none is null, half a character a question mark.

    Half of one comes in file names that are no UTF-8; it cannot be sent.
    """

    def render(self, content: Any) -> bytes:
        """Return the body."""
        try:
            return to_json(content, inf_nan_mode="null")
        except PydanticSerializationError:
            whole = json.dumps(content, ensure_ascii=False).encode("utf-8", "replace")
            return to_json(json.loads(whole), inf_nan_mode="null")
