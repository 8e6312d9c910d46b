"""Holds the drive models, one TOML file each."""
