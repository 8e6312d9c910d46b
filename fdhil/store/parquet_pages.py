"""Sums the declared sizes of a Parquet file's pages, so that an oversized file is refused before it is read.

The library allocates what a page's own header declares, whatever the file's footer says: 64 kB can become 2 GB. The
header is a struct of the Thrift compact protocol; its fields 2 and 3 are the page's size after and before decompression
([Parquet] PageHeader, [Thrift] compact protocol).
"""

_UNCOMPRESSED, _COMPRESSED = 2, 3
_INTEGERS, _BYTE, _DOUBLE, _BINARY, _STRUCT = (4, 5, 6), 3, 7, 8, 12
_DEEPEST = 8


def count_uncompressed_bytes(content: bytes, start: int, size: int) -> int:
    """Return the declared size of the pages in ``size`` bytes from ``start``. ValueError for invalid pages."""
    reader, total, end = _ThriftReader(content, start), 0, start + size
    if start < 0 or end > len(content):
        raise ValueError("a column lies outside of the file")
    while reader.at < end:
        sizes = reader.read_struct()
        before, after = sizes.get(_COMPRESSED, -1), sizes.get(_UNCOMPRESSED, -1)
        if before < 0 or after < 0:
            raise ValueError("a page has no size")
        reader.at += before
        total += after
    if reader.at != end:
        raise ValueError("a page reaches beyond its column")
    return total


class _ThriftReader:
    def __init__(self, content: bytes, at: int) -> None:
        self._content, self.at = content, at

    def read_struct(self, depth: int = 0) -> dict[int, int]:
        if depth > _DEEPEST:
            raise ValueError("a page header is nested too deep")
        found: dict[int, int] = {}
        field = 0
        while head := self._read_byte():
            field = field + (head >> 4) if head >> 4 else self._read_integer()
            kind = head & 0xF
            if kind in _INTEGERS:
                found[field] = self._read_integer()
            else:
                self._skip_field(kind, depth)
        return found

    def _skip_field(self, kind: int, depth: int) -> None:
        if kind in (1, 2):
            return  # a boolean is contained in the field's head
        if kind == _BYTE:
            self.at += 1
        elif kind in _INTEGERS:
            self._read_varint()
        elif kind == _DOUBLE:
            self.at += 8
        elif kind == _BINARY:
            length = self._read_varint()
            self.at += length
        elif kind == _STRUCT:
            self.read_struct(depth + 1)
        else:  # page headers have no lists, sets or maps
            raise ValueError(f"a page header holds a field of kind {kind}")

    def _read_byte(self) -> int:
        if self.at >= len(self._content):
            raise ValueError("a page header is cut off")
        self.at += 1
        return self._content[self.at - 1]

    def _read_varint(self) -> int:
        value = shift = 0
        while True:
            byte = self._read_byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7
            if shift > 63:
                raise ValueError("a number of a page header has no end")

    def _read_integer(self) -> int:
        raw = self._read_varint()
        return (raw >> 1) ^ -(raw & 1)
