"""Decode the device type: the device profile of a node (0x1000 in CiA 301, 0x67FF in CiA 402-2)."""

DRIVES = 402
_KINDS = {
    401: "an I/O module",
    402: "a drive",
    404: "a measuring device",
    405: "a programmable controller",
    406: "an encoder",
    408: "a hydraulic drive",
    410: "an inclinometer",
}


def is_cia402_drive(device_type: int | None) -> bool:
    """Return whether the device profile is CiA 402."""
    return device_type is not None and device_type & 0xFFFF == DRIVES


def describe_device_type(device_type: int | None) -> str:
    """Return the device profile in words.

    >>> describe_device_type(0x00030191)
    'CiA 401, an I/O module'
    """
    number = (device_type or 0) & 0xFFFF
    if number == 0:
        return "no device profile"
    return f"CiA {number}, {_KINDS[number]}" if number in _KINDS else f"CiA {number}"
