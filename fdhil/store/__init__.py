"""Recordings, windows and the history on disk."""
