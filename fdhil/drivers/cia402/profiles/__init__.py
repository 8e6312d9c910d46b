"""Drive profiles, one TOML file each."""
