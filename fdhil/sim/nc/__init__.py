"""The simulated NC: SYNC producer, NMT master and source of the set-points."""
