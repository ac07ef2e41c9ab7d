"""One-dimensional toy data."""

from __future__ import annotations

from typing import Literal, overload

import numpy as np
from sklearn.utils import Bunch, check_random_state

from ..utils.validation import check_integer, check_real

RandomState = int | np.random.RandomState | None


# Height, centre and width of the waves: a broad dip and then faster waves, similar to Snelson's data.
_WAVES = ((-1.8, 1.45, 0.9), (0.8, 2.6, 0.45), (0.9, 4.4, 0.4), (-0.85, 5.3, 0.45))


def _toy_mean(x: np.ndarray) -> np.ndarray:
    """Return the noise-free target: waves on a line of slope 3, as in the toy figure of the paper."""
    waves = sum(height * np.exp(-(((x - centre) / width) ** 2)) for height, centre, width in _WAVES)
    return 6.0 * waves + 3.0 * x


@overload
def make_toy(
    n_samples: int = ..., noise: float = ..., random_state: RandomState = ..., *, return_X_y: Literal[False] = ...
) -> Bunch: ...
@overload
def make_toy(
    n_samples: int = ..., noise: float = ..., random_state: RandomState = ..., *, return_X_y: Literal[True]
) -> tuple[np.ndarray, np.ndarray]: ...
def make_toy(
    n_samples: int = 200, noise: float = 1.7, random_state: RandomState = None, *, return_X_y: bool = False
) -> Bunch | tuple[np.ndarray, np.ndarray]:
    """Generate a noisy wave on a linear trend, similar to the toy data of the paper.

    The paper uses Snelson's 200 points, which `fetch_snelson` loads. These points are random, with similar waves and
    similar noise. The features ``h(x) = (1, x)`` explain the trend.

    Parameters
    ----------
    n_samples : int, default=200
        Number of points, at least 1.
    noise : float, default=1.7
        Standard deviation of the Gaussian noise on the target, at least 0.
    random_state : int, RandomState instance or None, default=None
        Seed of the inputs and the noise.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` instead of a Bunch.

    Returns
    -------
    toy : :class:`~sklearn.utils.Bunch`
        Dictionary-like object with

        - ``data`` : ndarray of shape (n_samples, 1), sorted and in (0, 6);
        - ``target`` : ndarray of shape (n_samples,);
        - ``mean`` : ndarray of shape (n_samples,), the target without noise;
        - ``feature_names``, ``target_names``, ``DESCR``.
    (data, target) : tuple of ndarray
        Returned only if ``return_X_y`` is True.

    Raises
    ------
    ValueError, TypeError
        If an argument is out of its range or of the wrong type.

    See Also
    --------
    fetch_snelson : Load the points of the figure in the paper.

    Examples
    --------
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(n_samples=5, random_state=0, return_X_y=True)
    >>> X.shape, y.shape
    ((5, 1), (5,))
    """
    check_integer(n_samples, "n_samples", minimum=1)
    check_real(noise, "noise", minimum=0.0)
    rng = check_random_state(random_state)
    x = np.sort(rng.uniform(0.0, 6.0, n_samples))
    mean = _toy_mean(x)
    target = mean + noise * rng.standard_normal(n_samples)
    data = x[:, np.newaxis]
    if return_X_y:
        return data, target
    return Bunch(
        data=data,
        target=target,
        mean=mean,
        feature_names=["x"],
        target_names=["y"],
        DESCR=f"{n_samples} points of a wave on a line of slope 3, with noise of standard deviation {noise}.",
    )
