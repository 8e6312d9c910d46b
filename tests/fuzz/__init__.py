"""Fuzzing: for any bytes from outside the answer is a declared one, fast, and with little memory.

One module per entry point (``TARGETS``): its ``Target`` has valid examples and processes any bytes. ``make fuzz`` lets
atheris search for failing inputs (``__main__``); its findings stay in ``found`` and are replayed in every test run.
"""

from __future__ import annotations

# entry point: the module with its ``target()``; the cheapest first
TARGETS = (
    "guard_socket", "guard_can", "modbus_rtu", "modbus_tcp", "hearing", "nc_lines", "gcode", "fault_script", "eds",
    "machine_toml", "status_told", "kept_documents", "offer", "recording_csv", "trace_text", "recording_parquet",
    "recording_hdf5", "recording_mat", "recording_mdf4", "daemon_socket", "web",
)  # fmt: skip
