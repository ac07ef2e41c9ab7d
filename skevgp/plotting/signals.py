"""SignalsDisplay: the processing of the signals of a log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from sklearn.utils import Bunch

from ..utils.optional import require
from ._style import BLUE, GREEN, PALETTE

_PANELS = {"velocity": "velocity\n(rad/s)", "acceleration": "acceleration\n(rad/s²)", "torque": "torque\n(N m)"}
_COLOURS = {
    "gap": "0.3",
    "jump": PALETTE[1],
    "corrupt": PALETTE[5],
    "held": "0.6",
    "rest": GREEN,
    "edge": PALETTE[4],
    "too short": PALETTE[3],
}
_WORDS = {
    "gap": "gap",
    "jump": "jump",
    "corrupt": "cut: corrupt value",
    "held": "cut: repeated frame",
    "rest": "cut: rest",
    "edge": "cut: filter's edge",
    "too short": "cut: too short",
}
_MARGIN = 0.25  # above and below the processed signals, as a share of a panel's height


class SignalsDisplay:
    """Recorded and processed velocities, accelerations and torques of a log, with the cuts.

    The vertical axes fit the processed signals, because recorded accelerations are mostly noise. If the file has no
    accelerations, differences of velocities are drawn. For prismatic joints, rad means m and N m means N.

    Parameters
    ----------
    raw, processed : Bunch
        Signals ``time`` (n,), and ``velocity``, ``acceleration`` and ``torque`` of shape (n, n_joints). A signal that
        was not recorded is None. Raw signals also have ``position`` (n, n_joints), and processed signals ``why`` (n,).
    cuts : list of (float, float, str)
        First and last second of each cut, and its reason: ``"gap"``, ``"jump"``, ``"rest"``, ``"edge"`` or ``"too
        short"``.
    joint_names : sequence of str of length n_joints
        Titles of the columns.
    title : str, default=None
        Title of the figure.

    Attributes
    ----------
    axes_ : ndarray of shape (3, n_joints)
        Axes of velocities, accelerations and torques, with a column for each joint.
    figure_ : matplotlib Figure
        Figure of the plot.

    See Also
    --------
    SignalsDisplay.from_log : Make one from the result of `load_log`.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from skevgp.datasets import load_log
    >>> from skevgp.plotting import SignalsDisplay
    >>> t = np.arange(0.0, 6.0, 0.008)
    >>> table = np.column_stack([t, np.sin(t), np.cos(t), np.sin(t)])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "swing.csv"
    ...     np.savetxt(file, table, delimiter=",")
    ...     log = load_log(file, columns={"time": 0, "position": 1, "velocity": 2, "effort": 3})
    >>> SignalsDisplay.from_log(log).axes_.shape
    (3, 1)
    """

    def __init__(
        self,
        raw: Bunch,
        processed: Bunch,
        cuts: Sequence[tuple[float, float, str]],
        joint_names: Sequence[str],
        title: str | None = None,
    ):
        self.raw = raw
        self.processed = processed
        self.cuts = cuts
        self.joint_names = joint_names
        self.title = title

    @classmethod
    def from_log(
        cls, log: Bunch, *, file: int = 0, joints: int | str | Sequence[int | str] | None = None, axes: Any = None
    ) -> Self:
        """Draw the result of `load_log`.

        Parameters
        ----------
        log : Bunch
            Result of `load_log`.
        file : int, default=0
            Index of the file in the log.
        joints : int, str or sequence of them, default=None
            Joints to draw, by index or by name. If None, all joints.
        axes : array of matplotlib Axes of shape (3, n_joints), default=None
            Axes to draw on. For one joint, the shape may be (3,). If None, a new figure.

        Returns
        -------
        display : SignalsDisplay
            The drawn display, with ``axes_`` and ``figure_``.

        Raises
        ------
        ValueError
            If there is no such file or joint, or axes have another shape.
        """
        n_files = len(log.recordings)
        if file not in range(-n_files, n_files):
            raise ValueError(f"file={file!r} must be the index of one of {n_files} files.")
        names = list(log.joint_names)
        known = {**{index: index for index in range(-len(names), len(names))}, **{n: i for i, n in enumerate(names)}}
        asked = range(len(names)) if joints is None else [joints] if isinstance(joints, (int, str)) else list(joints)
        if not asked or not set(asked) <= set(known):
            raise ValueError(f"joints={joints!r} must be some of {names}, by name or by index.")
        chosen = [known[joint] for joint in asked]
        recording = log.recordings[file]
        raw, processed = (_of_joints(signals, chosen) for signals in (recording.raw, recording.processed))
        title = recording.filename.replace("\\", "/").rpartition("/")[2]
        return cls(raw, processed, recording.cuts, [names[joint] for joint in chosen], title).plot(axes)

    def plot(self, axes: Any = None) -> Self:
        """Draw the display.

        Parameters
        ----------
        axes : array of matplotlib Axes of shape (3, n_joints), default=None
            Axes to draw on. For one joint, the shape may be (3,). If None, a new figure.

        Returns
        -------
        self : SignalsDisplay
            The display itself, with ``axes_`` and ``figure_``.

        Raises
        ------
        ValueError
            If axes have another shape.
        """
        panels = _axes(axes, len(self.joint_names))
        for row, (name, label) in enumerate(_PANELS.items()):
            for joint, ax in enumerate(panels[row]):
                self._draw(ax, name, joint)
            panels[row, 0].set_ylabel(label)
        for ax, name in zip(panels[0], self.joint_names, strict=True):
            ax.set_title(name)
        for ax in panels[-1]:
            ax.set_xlabel("time (s)")
        self.axes_, self.figure_ = panels, panels[0, 0].figure
        if axes is None:
            handles, labels = panels[0, 0].get_legend_handles_labels()
            self.figure_.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
            self.figure_.suptitle(self.title)
            self.figure_.align_ylabels(panels[:, 0])
        return self

    def _draw(self, ax: Any, name: str, joint: int) -> None:
        time, values = _recorded(_broken(self.raw, self.cuts), name)
        all_there = all(self.raw[panel] is not None for panel in _PANELS)
        label = "recorded" if all_there else "recorded, or differences"
        ax.plot(time, values[:, joint], color="0.6", linewidth=0.7, label=label)
        kept = np.where(self.processed.why == "", self.processed[name][:, joint], np.nan)
        ax.plot(self.processed.time, kept, color=BLUE, linewidth=1.2, label="processed")
        for number, (first, last, why) in enumerate(self.cuts):
            known = why in {before for _, _, before in self.cuts[:number]}
            ax.axvspan(first, last, color=_COLOURS[why], alpha=0.2, linewidth=0, label=None if known else _WORDS[why])
        low, high = np.nanmin(kept), np.nanmax(kept)
        # A signal that is constant up to rounding has no height.
        flat = high - low <= 1e-9 * max(abs(low), abs(high))
        margin = 1.0 if flat else _MARGIN * (high - low)
        ax.set_ylim(low - margin, high + margin)


def _of_joints(signals: Bunch, chosen: list[int]) -> Bunch:
    return Bunch(**{k: v[:, chosen] if v is not None and v.ndim == 2 else v for k, v in signals.items()})


def _broken(raw: Bunch, cuts: Sequence[tuple[float, float, str]]) -> Bunch:
    """Insert a row of NaN in each gap, jump or repeated frame, so that no line crosses it."""
    gaps = np.searchsorted(raw.time, [first for first, _, why in cuts if why in ("gap", "jump", "held")], side="right")
    return Bunch(**{k: v if v is None else np.insert(v, gaps, np.nan, axis=0) for k, v in raw.items()})


def _recorded(raw: Bunch, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a recorded signal, or differences of recorded signals between the rows."""
    if raw[name] is not None:
        return raw.time, raw[name]
    time, values = _recorded(raw, "velocity" if name == "acceleration" else "position")
    return (time[1:] + time[:-1]) / 2.0, np.diff(values, axis=0) / np.diff(time)[:, np.newaxis]


def _axes(axes: Any, n_joints: int) -> np.ndarray:
    pyplot = require("matplotlib.pyplot", "Plotting")
    rows = len(_PANELS)
    if axes is None:
        size = (max(6.4, 2.4 * n_joints), 6.0)
        return pyplot.subplots(rows, n_joints, figsize=size, sharex=True, squeeze=False, layout="constrained")[1]
    given = np.asarray(axes, dtype=object)
    if given.shape != (rows, n_joints) and not (n_joints == 1 and given.shape == (rows,)):
        raise ValueError(f"axes must be of shape {(rows, n_joints)}, a column for each joint; got {given.shape}.")
    return given.reshape(rows, n_joints)
