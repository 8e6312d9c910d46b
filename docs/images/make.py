"""Draw docs/images/corner.png from the traces that ``fdhil demo`` left in out/.

python docs/images/make.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure

from fdhil.cli.demo.loop import read_trace
from fdhil.report import figures

ROOT = Path(__file__).resolve().parents[2]
CUTS = (("uncorrected", "cut-1.csv", 0), ("mirror of the paper", "cut-2.csv", 1), ("inverse", "cut-3.csv", 2))
HALF_WIDTH_MM = 7.0


def main() -> None:
    """Draw corner E as the twin's table ran it, errors magnified."""
    with style.context(Path(figures.__file__).with_name("fdhil.mplstyle")):
        figure = Figure(figsize=(8.0, 4.2))
        axes = figure.add_axes((0.08, 0.13, 0.88, 0.76))
        for label, name, colour in CUTS:
            reference, table = read_trace(ROOT / "out" / name, ("X", "Y"))
            if colour == 0:
                axes.plot(*reference.T, color=figures.REFERENCE, lw=3.0, label="desired")
                centre = reference[np.argmin(np.hypot(*(reference - (200.0, 55.0)).T))]
            axes.plot(*figures.magnified(reference, table, 20).T, color=figures.COLOURS[colour], label=label, lw=1.5)
        axes.set_xlim(centre[0] - 1.1 * HALF_WIDTH_MM, centre[0] + 1.4 * HALF_WIDTH_MM)
        axes.set_ylim(centre[1] - 0.85 * HALF_WIDTH_MM, centre[1] + 0.45 * HALF_WIDTH_MM)
        axes.set_xlabel("X (mm)")
        axes.set_ylabel("Y (mm)")
        axes.legend(loc="lower right")
        axes.set_title("Corner E at 10 m/min, measured at the simulated table; errors 20 times as large", fontsize=10)
        figure.savefig(ROOT / "docs" / "images" / "corner.png", dpi=130)


if __name__ == "__main__":
    main()
