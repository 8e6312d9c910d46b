"""What the pages ask for, one file a page: its ``router`` (under /api/NAME) and the documents that it answers with."""
