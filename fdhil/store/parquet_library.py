"""Imports the Parquet library, an extra that is not needed in a laboratory."""

from fdhil.errors import FdhilError

try:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
except ImportError:
    raise FdhilError(
        "Parquet files, in which a machine's rapids are stored, need the extra 'machine': nothing was started; "
        "pip install 'fdhil[machine]'"
    ) from None

__all__ = ["pa", "pc", "pq"]
