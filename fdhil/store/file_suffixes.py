"""Maps file name suffixes to file formats."""

from collections.abc import Mapping

RECORDING_SUFFIXES: Mapping[str, str] = {
    ".csv": "csv", ".parquet": "parquet", ".mat": "mat", ".mf4": "mdf4", ".h5": "hdf5", ".hdf5": "hdf5",
}  # fmt: skip
# logs of all frames of a bus, as python-can reads and writes them
BUS_LOGS: Mapping[str, str] = {".log": "candump", ".blf": "blf", ".asc": "asc", ".trc": "trc"}


def find_suffix(table: Mapping[str, str], name: str) -> str:
    return next(suffix for suffix, meant in table.items() if meant == name)
