"""Lists the communication objects beyond PDO and heartbeat: time stamps, node guarding, error behaviour."""

from fdhil.sim.drive.object_dictionary import (
    ARRAY,
    U8,
    U16,
    U32,
    DataType,
    DictionaryObject,
    Entry,
    create_record,
    create_var,
)

KEEP_STATE = 1  # 0x1029: 0x6007 defines the drive's reaction


def list_service_objects() -> list[DictionaryObject]:
    """Return the objects with their power-on values."""
    return [
        create_var(0x100C, "Guard time", U16, "rw"),
        create_var(0x100D, "Life time factor", U8, "rw"),
        create_var(0x1012, "COB-ID time stamp object", U32, "rw", 0x80000100),
        create_var(0x1013, "High resolution time stamp", U32, "rw", mappable=True),
        create_var(0x1015, "Inhibit time EMCY", U16, "rw"),
        create_record(
            0x1029,
            "Error behaviour",
            Entry(0x1029, 1, "Communication error", U8, "rw", KEEP_STATE, low=0, high=2),
            kind=ARRAY,
        ),
        create_var(0x2122, "User data", DataType.DOMAIN, "rw", b""),
    ]
