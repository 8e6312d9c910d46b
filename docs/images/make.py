"""Draw the pictures of the documents from what ``fdhil demo`` left in out/: a corner, and each page in a browser.

python docs/images/make.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure
from PIL import Image, ImageChops

from fdhil.cli.demo.loop import read_trace
from fdhil.report import figures, find_browser
from fdhil.report.path_maps import make_error_colormap
from fdhil.report.pdf import run_browser

ROOT = Path(__file__).resolve().parents[2]
IMAGES, OUT = ROOT / "docs" / "images", ROOT / "out"
CUTS = (("uncorrected", "cut-1.csv", 0), ("mirror of the paper", "cut-2.csv", 1), ("inverse", "cut-3.csv", 2))
HALF_WIDTH_MM = 7.0
WIDTHS = {"wide": 1200, "narrow": 480}
TOP_OF_PAGE = 800  # px, of the prediction's page: its map and error
TALLEST = 14_000  # px, of what the browser draws
SHOWN = {"paper": 5_000}  # px, of a page that goes on in the same way
COLOURS = 160  # of a screenshot, by how often they are; the maps' scale is added, whose colours are rarely
OF_SCALE = 64
CONFIG = str(OUT / "machine.toml")
PROGRAM = str(ROOT / "fdhil" / "cli" / "demo" / "bench_10m.ngc")
PAGES = {
    "report": ["report", CONFIG, "--out"],
    "predict": ["predict", PROGRAM, "--config", CONFIG, "--from-history", "--report"],
    "correct": ["correct", PROGRAM, "--config", CONFIG, "--from-history", "--report"],
    "acceptance": ["acceptance", CONFIG, "--by", "A. Fitter", "--circle-um", "3", "--out"],
}


def main() -> None:
    """Draw all of them."""
    draw_corner()
    browser = find_browser()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pages = {"demo": OUT / "report.html"}
        for page, command in PAGES.items():
            pages[page] = folder / f"{page}.html"
            subprocess.run([sys.executable, "-m", "fdhil.cli.main", *command, pages[page]], check=True, stdout=2)
        subprocess.run(
            [sys.executable, "-m", "fdhil.cli.main", "paper", "--out", folder / "paper"], check=True, stdout=2
        )
        pages["paper"] = folder / "paper" / "paper.html"
        for page, path in pages.items():
            for label, width in WIDTHS.items():
                screenshot(browser, folder, path, IMAGES / f"{page}-{label}.png", width)
    with Image.open(IMAGES / "predict-wide.png") as page_seen:
        page_seen.crop((0, 0, page_seen.width, TOP_OF_PAGE)).save(IMAGES / "path.png", optimize=True)


def draw_corner() -> None:
    """Draw corner E as the twin's table ran it, errors magnified."""
    with style.context(Path(figures.__file__).with_name("fdhil.mplstyle")):
        figure = Figure(figsize=(8.0, 4.2))
        axes = figure.add_axes((0.08, 0.13, 0.88, 0.76))
        for label, name, colour in CUTS:
            reference, table = read_trace(OUT / name, ("X", "Y"))
            if colour == 0:
                axes.plot(*reference.T, color=figures.REFERENCE, lw=3.0, label="desired")
                centre = reference[np.argmin(np.hypot(*(reference - (200.0, 55.0)).T))]
            axes.plot(
                *figures.magnify_deviation(reference, table, 20).T, color=figures.COLOURS[colour], label=label, lw=1.5
            )
        axes.set_xlim(centre[0] - 1.1 * HALF_WIDTH_MM, centre[0] + 1.4 * HALF_WIDTH_MM)
        axes.set_ylim(centre[1] - 0.85 * HALF_WIDTH_MM, centre[1] + 0.45 * HALF_WIDTH_MM)
        axes.set_xlabel("X (mm)")
        axes.set_ylabel("Y (mm)")
        axes.legend(loc="lower right")
        axes.set_title("Corner E at 10 m/min, measured at the simulated table; errors 20 times as large", fontsize=10)
        figure.savefig(IMAGES / "corner.png", dpi=130)


def screenshot(browser: str, folder: Path, page: Path, picture: Path, width: int) -> None:
    """Write the whole page as the browser shows it in a window of ``width`` px."""
    taken = folder / "taken.png"
    size = f"--window-size={width},{TALLEST}"
    run_browser(browser, folder, "--hide-scrollbars", size, f"--screenshot={taken}", page.resolve().as_uri())
    image = Image.open(taken).convert("RGB")
    empty = Image.new("RGB", image.size, image.getpixel((0, TALLEST - 1)))
    used = ImageChops.difference(image, empty).getbbox()
    assert used is not None
    cropped = image.crop((0, 0, width, min(SHOWN.get(page.stem, TALLEST), used[3] + 20)))
    often = (cropped.quantize(COLOURS).getpalette() or [])[: 3 * COLOURS]
    scale = 255 * make_error_colormap()(np.linspace(0, 1, OF_SCALE))[:, :3]
    palette = Image.new("P", (1, 1))
    palette.putpalette([*often, *scale.round().astype(int).ravel().tolist()])
    cropped.quantize(palette=palette, dither=Image.Dither.NONE).save(picture, optimize=True)


if __name__ == "__main__":
    main()
