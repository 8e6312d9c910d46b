"""Recordings, windows and the history on disk."""

WINDOWS_FOLDER = "windows"  # in the folder of the store
HISTORY_FILE = "history.sqlite"
