"""Holds how NCs show what they do, one TOML file each."""
