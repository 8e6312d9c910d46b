"""The connections of the simulated machine: the CAN hub on TCP, other bus interfaces, the Modbus sensors."""
