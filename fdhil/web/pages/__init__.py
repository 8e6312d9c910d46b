"""The API of the pages, one file a page: its ``router`` (under /api/NAME) and its documents."""
