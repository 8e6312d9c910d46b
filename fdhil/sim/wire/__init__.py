"""The wires of the simulated machine: the CAN hub on TCP, other ways onto a bus, the Modbus sensor."""
