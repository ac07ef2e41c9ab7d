"""RolloutDisplay: predictions of many steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import Bunch

from ..utils.optional import require
from ..utils.validation import as_floats, check_integer, check_real
from ._style import BLUE, ORANGE


class RolloutDisplay:
    """Predictions of `rollout`, with a panel for each state.

    Each panel shows the mean with its credible interval, a few samples, and the true states.

    Parameters
    ----------
    times : ndarray of shape (n_steps,)
        End times of the steps.
    mean, std : ndarray of shape (n_steps, n_panels)
        Predicted means and standard deviations.
    samples : ndarray of shape (n_samples, n_steps, n_panels), default=None
        Particles.
    truth : ndarray of shape (n_steps, n_panels), default=None
        True states.
    state_names : sequence of str of length n_panels, default=None
        Labels of the vertical axes. If None, state 0, state 1, ...
    time_name : str, default="step"
        Label of the horizontal axis.

    Attributes
    ----------
    axes_ : ndarray of shape (n_panels,)
        Axes of the panels.
    figure_ : matplotlib Figure
        Figure of the plot.

    See Also
    --------
    RolloutDisplay.from_rollout : Make one from the result of `rollout`.

    Examples
    --------
    >>> from skevgp import EVGPRegressor, rollout
    >>> from skevgp.datasets import make_dynamics
    >>> from skevgp.features import InertiaForceGravity
    >>> from skevgp.plotting import RolloutDisplay
    >>> train, test = (make_dynamics("pendulum", n, 60, random_state=s) for n, s in [(4, 0), (1, 1)])
    >>> model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, sharing="all", random_state=0)
    >>> model = model.fit(train.data, train.target, groups=train.groups)
    >>> ahead = rollout(model, test.data[0, :2], test.data[:50, 2:], random_state=0)
    >>> truth = test.trajectories[0, 1:51]
    >>> display = RolloutDisplay.from_rollout(ahead, truth, state_names=test.target_names, dt=test.dt)
    >>> len(display.axes_)
    2
    """

    def __init__(
        self,
        times: np.ndarray,
        mean: np.ndarray,
        std: np.ndarray,
        samples: np.ndarray | None = None,
        truth: np.ndarray | None = None,
        state_names: Sequence[str] | None = None,
        time_name: str = "step",
    ):
        self.times = times
        self.mean = mean
        self.std = std
        self.samples = samples
        self.truth = truth
        self.state_names = state_names
        self.time_name = time_name

    @classmethod
    def from_rollout(
        cls,
        ahead: Bunch,
        truth: ArrayLike | None = None,
        *,
        states: Sequence[int] | None = None,
        state_names: Sequence[str] | None = None,
        dt: float | None = None,
        index: int = 0,
        axes: Any = None,
        n_std: float = 2.0,
        n_samples: int = 10,
        label: str = "mean",
    ) -> Self:
        """Draw the result of `rollout`.

        Parameters
        ----------
        ahead : Bunch
            Result of `rollout` with any method.
        truth : array-like of shape (n_steps, n_states), default=None
            True states after each step.
        states : sequence of int, default=None
            Indices of the states to draw. If None, all states.
        state_names : sequence of str of length n_states, default=None
            Names of all states, as in ``make_dynamics(...).target_names``.
        dt : float, default=None
            Length of a step in seconds. If None, the horizontal axis has the numbers of the steps.
        index : int, default=0
            Index of the initial state, if there are several.
        axes : matplotlib Axes or sequence of them, default=None
            Axes to draw on, one for each state. If None, a new figure.
        n_std : float, default=2.0
            Half width of the intervals, in standard deviations.
        n_samples : int, default=10
            Maximum number of samples to draw.
        label : str, default="mean"
            Name of the line of the mean, for ``display.axes_[0].legend()``.

        Returns
        -------
        display : RolloutDisplay
            The drawn display, with ``axes_`` and ``figure_``.

        Raises
        ------
        ValueError, TypeError
            If there is no such state or initial state, or truth or names do not fit the rollout. If the number of axes
            is not that of the states.
        """
        own = _of_one(ahead, index)
        n_steps, n_states = own.mean.shape
        if dt is not None:
            check_real(dt, "dt", minimum=0.0, strict=True)
        chosen = list(range(n_states) if states is None else states)
        if not chosen or not set(chosen) <= set(range(-n_states, n_states)):
            raise ValueError(f"states={states!r} must be indices of some of {n_states} states.")
        names = [f"state {number}" for number in range(n_states)] if state_names is None else list(state_names)
        if len(names) != n_states:
            raise ValueError(f"state_names must name the {n_states} states of the rollout; got {names}.")
        happened = None if truth is None else as_floats(truth, "truth")
        if happened is not None and happened.shape != own.mean.shape:
            raise ValueError(f"truth must be of shape (n_steps, n_states) = {own.mean.shape}; got {happened.shape}.")
        return cls(
            np.arange(1, n_steps + 1) * (1 if dt is None else dt),
            own.mean[:, chosen],
            own.std[:, chosen],
            own.samples[:, :, chosen] if "samples" in own else None,
            None if happened is None else happened[:, chosen],
            [names[state] for state in chosen],
            "step" if dt is None else "time (s)",
        ).plot(axes, n_std=n_std, n_samples=n_samples, label=label)

    def plot(self, axes: Any = None, *, n_std: float = 2.0, n_samples: int = 10, label: str = "mean") -> Self:
        """Draw the display.

        Parameters
        ----------
        axes : matplotlib Axes or sequence of them, default=None
            Axes to draw on, one for each panel. If None, a new figure.
        n_std : float, default=2.0
            Half width of the intervals, in standard deviations.
        n_samples : int, default=10
            Maximum number of samples to draw.
        label : str, default="mean"
            Name of the line of the mean, for ``display.axes_[0].legend()``.

        Returns
        -------
        self : RolloutDisplay
            The display itself, with ``axes_`` and ``figure_``.

        Raises
        ------
        ValueError
            If the number of axes is not that of the panels.
        """
        check_integer(n_samples, "n_samples", minimum=0)
        panels = _panels(axes, self.mean.shape[1])
        for panel, ax in enumerate(panels):
            self._draw(ax, panel, n_std, n_samples, label)
            ax.set_ylabel(f"state {panel}" if self.state_names is None else self.state_names[panel])
        panels[-1].set_xlabel(self.time_name)
        self.axes_, self.figure_ = panels, panels[0].figure
        return self

    def _draw(self, ax: Any, panel: int, n_std: float, n_samples: int, label: str) -> None:
        mean, std = self.mean[:, panel], self.std[:, panel]
        band = {"color": BLUE, "alpha": 0.2, "linewidth": 0, "label": f"±{n_std:g} std"}
        ax.fill_between(self.times, mean - n_std * std, mean + n_std * std, **band)
        few = () if self.samples is None else self.samples[:n_samples, :, panel]
        for number, sample in enumerate(few):
            ax.plot(self.times, sample, color="0.45", linewidth=0.5, label=None if number else "samples")
        ax.plot(self.times, mean, color=BLUE, label=label)
        if self.truth is not None:
            ax.plot(self.times, self.truth[:, panel], color=ORANGE, linestyle="--", label="truth")


def _of_one(ahead: Bunch, index: int) -> Bunch:
    """Return the rollout from one initial state."""
    if ahead.mean.ndim == 2:
        if index not in (0, -1):
            raise ValueError(f"index={index!r}, but the rollout is from one initial state.")
        return ahead
    n = len(ahead.mean)
    if index not in range(-n, n):
        raise ValueError(f"index={index!r} must be that of one of {n} initial states.")
    return Bunch(**{name: values[index] for name, values in ahead.items()})


def _panels(axes: Any, n: int) -> np.ndarray:
    """Return the given axes, or new ones."""
    pyplot = require("matplotlib.pyplot", "Plotting")
    if axes is None:
        options = {"sharex": True, "squeeze": False, "layout": "constrained"}
        return np.ravel(pyplot.subplots(n, figsize=(6.4, 1.2 + 1.7 * n), **options)[1])
    given = np.ravel(np.asarray(axes, dtype=object))
    if len(given) != n:
        raise ValueError(f"axes must be one for each of the {n} states drawn; got {len(given)}.")
    return given
