"""Profiles of NC interfaces, one TOML file each."""
