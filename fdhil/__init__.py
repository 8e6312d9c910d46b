"""fdhil: identify feed drives during rapid moves, predict path errors, and feed corrections back."""

import os

# The matrices of a window are small: threads of the numeric libraries only spin, and this PC has an NC next to it.
# The libraries read these when NumPy is imported first.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
