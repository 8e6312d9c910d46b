#!/usr/bin/env bash
# python-can reads CAN FD frames of a PEAK trace (.trc 2.1) with wrong flags and a wrong length.
#
# Library:  python-can 4.6.1, can.TRCReader (also behind can.LogReader and can_logconvert).
# Expected: PEAK's "PEAK CAN TRC File Format" (versions 2.0 and 2.1) names the types of CAN FD frames:
#           FD = neither bit, FB = BRS set, FE = ESI set, BI = both bits set.
#           The column L holds the data length code of the bus: code 9 means 12 bytes (ISO 11898-1).
#           python-can's documentation of can.Message: dlc of a CAN FD message is the number of bytes.
# Seen:     FE and BI are exchanged: FE gets both bits, BI gets ESI alone. dlc is the code, 9, beside 12 bytes of data.
# Effect:   an error-passive sender is reported with a bit rate it did not use, the printed message lacks
#           three bytes, and can.Message with check=True rejects the values that the reader returned.
# Output seen:
#   FD: BRS False, ESI False, dlc 9, 12 bytes of data
#   FB: BRS True, ESI False, dlc 9, 12 bytes of data
#   FE: BRS True, ESI True, dlc 9, 12 bytes of data
#   BI: BRS False, ESI True, dlc 9, 12 bytes of data
#   The library's own check: the DLC and the length of the data must match up for non remote frames
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check python-can==4.6.1
cd "$folder"

cat >trace.trc <<'TRACE'
;$FILEVERSION=2.1
;$STARTTIME=45244.5
;$COLUMNS=N,O,T,B,I,d,R,L,D
;
      1      1.000 FD  1      0181 Rx -  9    00 01 02 03 04 05 06 07 08 09 0A 0B
      2      2.000 FB  1      0181 Rx -  9    00 01 02 03 04 05 06 07 08 09 0A 0B
      3      3.000 FE  1      0181 Rx -  9    00 01 02 03 04 05 06 07 08 09 0A 0B
      4      4.000 BI  1      0181 Rx -  9    00 01 02 03 04 05 06 07 08 09 0A 0B
TRACE

venv/bin/python -I - <<'PYTHON'
import sys

import can

SEEN = [(False, False, 9), (True, False, 9), (True, True, 9), (False, True, 9)]

messages = list(can.LogReader("trace.trc"))
found = [(m.bitrate_switch, m.error_state_indicator, m.dlc) for m in messages]
for kind, message, (brs, esi, dlc) in zip(("FD", "FB", "FE", "BI"), messages, found, strict=True):
    print(f"{kind}: BRS {brs}, ESI {esi}, dlc {dlc}, {len(message.data)} bytes of data")
if found != SEEN:
    sys.exit("Changed: python-can no longer reads the CAN FD frames of a trace as described.")
first = messages[0]
try:
    can.Message(arbitration_id=0x181, is_extended_id=False, is_fd=True, dlc=first.dlc, data=first.data, check=True)
except ValueError as error:
    print("The library's own check:", error)
else:
    sys.exit("Changed: can.Message accepts the length that the reader returned.")
PYTHON
