"""Reads sensors on Modbus, TCP or RTU, over lines that several may share."""
