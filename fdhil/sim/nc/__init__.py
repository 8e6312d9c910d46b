"""The simulated NC: SYNC producer, NMT master, and the one who streams set-points."""
