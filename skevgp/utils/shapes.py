"""Results in the shape that GaussianProcessRegressor gives them."""

from __future__ import annotations

import numpy as np


def like_y(values: np.ndarray) -> np.ndarray:
    """Without the last axis, of outputs, if there is one output.

    Parameters
    ----------
    values : ndarray of shape (..., n_outputs)

    Returns
    -------
    values : ndarray of shape (...) or (..., n_outputs)
    """
    return values[..., 0] if values.shape[-1] == 1 else values
