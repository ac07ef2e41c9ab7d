"""Colours and axes of all displays."""

from __future__ import annotations

from typing import Any

from ..utils.optional import require

# The palette of Okabe & Ito, safe for colour-blind readers, without black and yellow.
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
PALETTE = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9")


def axes_of(ax: Any) -> Any:
    """Return the given axes, or new ones."""
    pyplot = require("matplotlib.pyplot", "Plotting")
    return ax if ax is not None else pyplot.subplots()[1]


def free_color(ax: Any) -> str:
    """Return the first colour of the palette that no line on the axes has."""
    used = {line.get_color() for line in ax.lines}
    return next((free for free in PALETTE if free not in used), PALETTE[0])


def check_output(output: int, n_outputs: int) -> None:
    if not -n_outputs <= output < n_outputs:
        raise ValueError(f"output={output!r} must be the index of one of {n_outputs} outputs.")
