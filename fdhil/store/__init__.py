"""Stores recordings, windows and the history on disk."""

WINDOWS_FOLDER = "windows"  # in the store's folder
HISTORY_FILE = "history.sqlite"
