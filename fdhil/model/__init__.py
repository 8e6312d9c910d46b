"""The physics of a feed drive: equations [1] and [2] of [DES], open loop from voltage and in closed loop."""
