"""Sensors on Modbus: one link, and what is read over it."""
