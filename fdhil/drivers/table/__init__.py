"""Sensors at an axis' table: an encoder in a TPDO of its bus or behind Modbus, an accelerometer on a serial line."""
