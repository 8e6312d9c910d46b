"""Defines the types of a CAN frame inside the simulated machine."""

Frame = tuple[int, bytes]
BusFrame = tuple[str, Frame]

EXTENDED = 1 << 31  # marks a 29 bit identifier, as SocketCAN does
