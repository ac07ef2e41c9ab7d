"""Shapes of results, and of Jacobians that do not depend on the row."""

from __future__ import annotations

import numpy as np


def like_y(values: np.ndarray) -> np.ndarray:
    """Drop the last axis (of outputs) if there is one output, as GaussianProcessRegressor does."""
    return values[..., 0] if values.shape[-1] == 1 else values


def same_for_all(jacobian: np.ndarray, n_rows: int) -> np.ndarray:
    """Copy one row's Jacobian to each of n_rows rows, (n_rows, n_features_out, n_features_in)."""
    copies = np.empty((n_rows, *jacobian.shape))
    copies[:] = jacobian
    return copies
