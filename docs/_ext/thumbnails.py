"""Pictures of the gallery's index: of each example one panel of its figures, without the words that would be too small.

The panel is drawn again when the example has run, so that it shows what the example shows.
"""

from __future__ import annotations

import pickle
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.transforms import Bbox

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DOCS = Path(__file__).resolve().parents[1]
FOLDER = DOCS / "generated" / "thumbnails"
# In inches, of letters of SIZE points: shown at about half the size.
WIDTH, HEIGHT, MARGIN, DPI = 4.0, 2.8, 0.12, 200
LETTERS, THICKER, LARGER = 18, 1.8, 1.6


@dataclass(frozen=True)
class Panel:
    """A panel of a figure of an example.

    Attributes
    ----------
    axes : int
        Its number in the figure.
    x, y : str
        Its labels, in a word.
    share : float
        Of the range of x that is shown.
    """

    axes: int
    x: str
    y: str
    share: float = 1.0


# The name of a file, without "plot_". The panel is of the figure that the example shows last.
PANELS = {
    "sparse_gp": Panel(1, "x", "y"),
    "tabular": Panel(0, "interval", "truth inside"),
    "many_rows": Panel(1, "x", "y"),
    "learn_dynamics": Panel(0, "time", "velocity"),
    "any_robot": Panel(1, "time", "change", share=0.3),
    "nominal_dynamics": Panel(0, "moves", "error"),
    "link_gravity": Panel(1, "time", "torque"),
    "calibrate_simulator": Panel(3, "x", "discrepancy"),
    "rollout": Panel(1, "time", "angle"),
    "online": Panel(0, "time", "error"),
    "swing_up": Panel(1, "time", "angle"),
    "acrobot": Panel(1, "time", "angle"),
    "crocoddyl": Panel(0, "time", "angle"),
    "real_arm": Panel(0, "time", "torque"),
    "payload": Panel(0, "length of the log", "mass"),
    "tracking": Panel(0, "y", "z"),
}


def scrape(block: Any, variables: dict[str, Any], conf: dict[str, Any], **given: Any) -> str:
    """Save the figures of a block of an example, and its thumbnail."""
    from sphinx_gallery.scrapers import matplotlib_scraper

    story = Path(variables["src_file"]).stem.removeprefix("plot_")
    if (numbers := plt.get_fignums()) and story in PANELS:
        save(plt.figure(numbers[-1]), PANELS[story], FOLDER / f"{story}.png")
    return matplotlib_scraper(block, variables, conf, **given)


def save(figure: Figure, panel: Panel, path: Path) -> None:
    """Save a panel of a figure, which is not changed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    copy = pickle.loads(pickle.dumps(figure))
    ax = copy.axes[panel.axes]
    copy.set_layout_engine("none")
    for other in copy.axes:
        other.set_visible(other is ax)
    for part in (copy, *copy.subfigs):
        for words in (*part.texts, *part.legends):
            words.set_visible(False)
    simplify(ax, panel)
    # The figure is as large as makes the panel WIDTH times HEIGHT, less the room for its letters, which is cut out.
    copy.canvas.draw()
    box, letters = ax.get_window_extent(), 1.7 * LETTERS / 72
    width, height = WIDTH - letters - 2 * MARGIN, HEIGHT - letters - 2 * MARGIN
    copy.set_size_inches(copy.get_size_inches() * (width * copy.dpi / box.width, height * copy.dpi / box.height))
    copy.canvas.draw()
    x, y = ax.get_window_extent().min / copy.dpi - MARGIN - letters
    copy.savefig(path, dpi=DPI, bbox_inches=Bbox.from_bounds(x, y, WIDTH, HEIGHT))
    plt.close(copy)


def simplify(ax: Axes, panel: Panel) -> None:
    """Leave the lines of a panel and its two words."""
    if (legend := ax.get_legend()) is not None:
        legend.remove()
    for words in list(ax.texts):
        words.remove()
    for side in ("left", "center", "right"):
        ax.set_title("", loc=side)
    ax.tick_params(which="both", length=0, labelbottom=False, labelleft=False)
    ax.grid(visible=False)
    ax.set_aspect("auto")
    first, last = ax.get_xlim()
    ax.set_xlim(first, first + panel.share * (last - first))
    ax.set_xlabel(panel.x, fontsize=LETTERS, labelpad=6)
    ax.set_ylabel(panel.y, fontsize=LETTERS, labelpad=6)
    ax.spines[["left", "bottom"]].set_linewidth(THICKER)
    for line in ax.lines:
        line.set_linewidth(THICKER * line.get_linewidth())
        line.set_markersize(LARGER * line.get_markersize())
    for drawn in ax.collections:
        drawn.set_linewidth(THICKER * np.asarray(drawn.get_linewidth()))


def put(folder: Path) -> None:
    """Replace the thumbnails of sphinx-gallery."""
    for story in PANELS:
        if (made := FOLDER / f"{story}.png").exists():
            shutil.copy(made, folder / f"sphx_glr_plot_{story}_thumb.png")
