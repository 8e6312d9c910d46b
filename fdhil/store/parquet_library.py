"""The library that reads and writes Parquet files: an extra, which a laboratory can do without."""

from fdhil.errors import FdhilError

try:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
except ImportError:
    raise FdhilError(
        "Parquet files, in which the rapids of a machine are stored, need the extra 'machine': nothing was started; "
        "pip install 'fdhil[machine]'"
    ) from None

__all__ = ["pa", "pc", "pq"]
