"""Describes what an EDS or DCF file offers: the device's identity, its objects and its PDOs."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fdhil.cia402 import LOGICAL_AXES, LOGICAL_AXIS_STEP, Object
from fdhil.drivers.cia402.drive_profile import ObjectKey
from fdhil.eds import INTEGER_TYPES, EdsFile, read_eds, read_expression, read_octal

MOST_PDOS = 512
COB_ID_BITS, EXTENDED = 0x7FF, 1 << 29
DRIVE = 402


@dataclass(frozen=True, slots=True)
class DeviceObject:
    """One variable of the dictionary; ``bits`` 0: not an integer. ``default`` None: not given in the file.

    ``relative``: the default contains the node-ID. ``doubt`` explains a default that is invalid or ambiguous.
    """

    key: ObjectKey
    name: str
    bits: int
    signed: bool
    access: str
    mappable: bool
    default: int | None
    relative: bool = False
    doubt: str = ""

    @property
    def is_fixed(self) -> bool:
        return self.access in ("ro", "const")

    @property
    def fits_in_rpdo(self) -> bool:
        """Whether an RPDO can carry it (CiA 306: rww, or rw)."""
        return self.mappable and self.bits > 0 and self.access in ("rw", "wo", "rww")

    @property
    def fits_in_tpdo(self) -> bool:
        """Whether a TPDO can carry it (CiA 306: ro, rwr, or rw)."""
        return self.mappable and self.bits > 0 and self.access in ("ro", "rw", "rwr", "const")

    @property
    def may_fit_in_tpdo(self) -> bool:
        """Whether a TPDO might carry it: many drives accept more than the ``rww`` of their file."""
        return self.mappable and self.bits > 0 and self.access == "rww"


@dataclass(frozen=True, slots=True)
class PdoSlot:
    """One PDO of the device: its number, default COB-ID less the node-ID, and how many objects it can map.

    ``mapped`` are the default mapping words, read-only if ``fixed``. ``cob_base`` None: not given, or it belongs to a
    node that the file does not name. ``cob_fixed``, ``kind_fixed``: COB-ID and transmission type are read-only.
    """

    number: int
    cob_base: int | None
    valid: bool
    kind: int | None
    room: int
    mapped: tuple[int, ...]
    fixed: bool
    cob_fixed: bool = False
    kind_fixed: bool = False


@dataclass(frozen=True, slots=True)
class DeviceDescription:
    """Content of a device's file; numbers are 0 where it does not give them."""

    file: str
    vendor_name: str
    product_name: str
    vendor_id: int
    product_code: int
    objects: Mapping[ObjectKey, DeviceObject]
    rpdos: tuple[PdoSlot, ...]
    tpdos: tuple[PdoSlot, ...]

    @property
    def ambiguities(self) -> tuple[str, ...]:
        """Ambiguous or invalid numbers of the file, a sentence each."""
        return tuple(found.doubt for found in self.objects.values() if found.doubt)

    def find_object(self, key: ObjectKey) -> DeviceObject | None:
        """Return an object, None where the device has none."""
        return self.objects.get(key)

    def get_default(self, index: int, sub: int = 0) -> int | None:
        """Return an object's default value, None where the device or the file has none."""
        found = self.find_object((index, sub))
        return None if found is None else found.default

    def get_mapping_entry(self, key: ObjectKey) -> tuple[int, int, int, bool] | None:
        """Return an object as a mapping entry; None where it is missing or not an integer."""
        found = self.find_object(key)
        return None if found is None or not found.bits else (*key, found.bits, found.signed)

    @property
    def logical_axes(self) -> tuple[int, ...]:
        """The logical axes of CiA 402 with a controlword: their objects lie 0x800 higher for each."""
        words = {axis: (Object.CONTROLWORD + (axis - 1) * LOGICAL_AXIS_STEP, 0) for axis in LOGICAL_AXES}
        return tuple(axis for axis, key in words.items() if key in self.objects)

    @property
    def is_drive(self) -> bool:
        """Whether it is a CiA 402 drive: by its device type, else by its control- and statusword."""
        kind = self.get_default(Object.DEVICE_TYPE)
        words = (
            self.find_object((Object.CONTROLWORD, 0)) is not None
            and self.find_object((Object.STATUSWORD, 0)) is not None
        )
        return words and (not kind or kind & 0xFFFF == DRIVE)


def read_device(path: Path) -> DeviceDescription:
    """Read an EDS or DCF file; EdsError when it cannot be read. A DCF's values count as its defaults."""
    file = read_eds(path)
    objects = {found.key: found for found in _describe_objects(file)}
    vendor, product = (objects.get((int(Object.IDENTITY), sub)) for sub in (1, 2))
    return DeviceDescription(
        file=path.name,
        vendor_name=file.vendor_name,
        product_name=file.product_name,
        vendor_id=file.vendor_number or (vendor.default if vendor else 0) or 0,
        product_code=file.product_number or (product.default if product else 0) or 0,
        objects=objects,
        rpdos=_describe_pdos(objects, Object.RPDO_PARAMETER, Object.RPDO_MAPPING, file.node_id),
        tpdos=_describe_pdos(objects, Object.TPDO_PARAMETER, Object.TPDO_MAPPING, file.node_id),
    )


def _describe_objects(file: EdsFile) -> Iterator[DeviceObject]:
    for item in file.objects:
        for entry in item.entries:
            bits, signed = INTEGER_TYPES.get(entry.data_type, (0, False))
            written = entry.default if bits or not entry.data_type else ""
            number, relative = read_expression(written) or (None, False)
            doubt = ""
            if written and number is None:
                doubt = ", which is not a number: ignored"
            elif (octal := read_octal(written)) is not None:
                doubt = f": read as {number}, but it is {octal} if octal is meant"
            elif number is not None and relative:  # an EDS of no node: as of node 0
                number += file.node_id or 0
            yield DeviceObject(
                key=(entry.index, entry.sub),
                name=item.name if item.name == entry.name else f"{item.name}: {entry.name}",
                bits=bits,
                signed=signed,
                access=entry.access,
                mappable=entry.mappable,
                default=number,
                relative=relative,
                doubt=f"{entry.index:04X}:{entry.sub:02X} is written {written[:40]}{doubt}" if doubt else "",
            )


def _describe_pdos(
    objects: Mapping[ObjectKey, DeviceObject], parameter: int, mapping: int, own: int | None
) -> tuple[PdoSlot, ...]:
    found = []
    for place in range(MOST_PDOS):
        cob, kind = (objects.get((parameter + place, sub)) for sub in (1, 2))
        slots = [objects[mapping + place, sub] for sub in range(1, 65) if (mapping + place, sub) in objects]
        if cob is None:
            continue
        count = objects.get((mapping + place, 0))
        words = [slot.default or 0 for slot in slots]
        mapped = words[: len(words) if count is None or count.default is None else count.default]
        found.append(
            PdoSlot(
                number=place + 1,
                cob_base=_derive_cob_base(cob, own),
                valid=cob.default is None or not cob.default >> 31 & 1,
                kind=None if kind is None else kind.default,
                room=len(slots),
                mapped=tuple(word for word in mapped if word),
                fixed=bool(slots) and all(slot.is_fixed for slot in slots),
                cob_fixed=cob.is_fixed,
                kind_fixed=kind is None or kind.is_fixed,
            )
        )
    return tuple(found)


def _derive_cob_base(cob: DeviceObject, own: int | None) -> int | None:
    """Return a COB-ID less the node-ID that it contains; None where none is given, or the node is unknown."""
    number = (cob.default or 0) & COB_ID_BITS
    if not number or (cob.default or 0) & EXTENDED:
        return None
    if cob.relative or own is not None:
        return number - (own or 0) if number >= (own or 0) else None
    return None if number & 0x7F else number  # without a node-ID, or with one that the file does not name
