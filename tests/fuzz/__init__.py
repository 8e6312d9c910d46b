"""Fuzzing: whatever bytes come from outside, the answer is one that is declared, soon, and in little memory.

One module for each way in (``TARGETS``): its ``Target`` has true examples to begin with and tastes any bytes.
``make fuzz`` lets atheris look for bytes that hurt (``__main__``); what it finds stays in ``found`` and is tasted by
every test run.
"""

from __future__ import annotations

# way in -> the module with its ``target()``; the cheapest first
TARGETS = (
    "guard_socket", "guard_can", "modbus_rtu", "modbus_tcp", "hearing", "nc_lines", "gcode", "fault_script", "eds",
    "machine_toml", "status_told", "kept_documents", "offer", "recording_csv", "trace_text", "recording_parquet",
    "recording_hdf5", "recording_mat", "recording_mdf4", "daemon_socket", "web",
)  # fmt: skip
