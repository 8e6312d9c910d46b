"""Reads sensors on Modbus, each over a link of its own."""
