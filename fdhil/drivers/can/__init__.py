"""One CAN bus: ways onto it, its frames in bulk, the SYNC grid, SDO, and what the nodes say about themselves."""
