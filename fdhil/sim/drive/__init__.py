"""The simulated CiA 402 servo drive: object dictionary, SDO, PDO, power states, loops and motor."""
