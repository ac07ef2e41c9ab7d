"""A fitted model as a residual model of L4acados."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .compiled import CompiledPredictor


class L4acadosModel:
    """A fitted model as a residual model of L4acados, as `EVGPRegressor.to_l4acados` returns it.

    L4acados adds a learned residual r to a nominal model of acados: x' = f(x, u) + B r(y) with y = [x, u]. Pass this
    object as ``residual_model`` to its controllers. They need no subclass of theirs: they call ``value_and_jacobian``
    with one row for each stage of the plan, and the zero-order controller then reads ``current_variance``.

    Rows are not validated: pass finite float64 arrays. Threads need one object each, because the results of the last
    call are kept.

    Parameters
    ----------
    compiled : CompiledPredictor
        The fitted model for control loops.
    columns : ndarray of shape (n_features,), default=None
        Indices of the columns of y that the model was fitted to. If None, it was fitted to all columns.

    Attributes
    ----------
    current_prediction : ndarray of shape (n_stages, n_outputs)
        The residual at the rows of the last call.
    current_prediction_dy : ndarray of shape (n_outputs, n_stages, n_states + n_inputs)
        Its derivatives. Only after ``jacobian`` or ``value_and_jacobian``.
    current_variance : ndarray of shape (n_stages, n_outputs)
        Its variance.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp import EVGPRegressor
    >>> XU = np.random.RandomState(0).uniform(-1.0, 1.0, (60, 3))  # two states and an input
    >>> residual = EVGPRegressor(n_inducing=10, random_state=0).fit(XU, np.sin(XU[:, 0])).to_l4acados()
    >>> value, jacobian = residual.value_and_jacobian(XU[:20])
    >>> value.shape, jacobian.shape, residual.current_variance.shape
    ((20, 1), (1, 20, 3), (20, 1))
    """

    current_prediction: np.ndarray
    current_prediction_dy: np.ndarray
    current_variance: np.ndarray

    def __init__(self, compiled: CompiledPredictor, columns: np.ndarray | None = None):
        self.compiled, self.columns = compiled, columns

    def evaluate(self, y: np.ndarray) -> np.ndarray:
        """Predict the residual.

        Parameters
        ----------
        y : ndarray of shape (n_stages, n_states + n_inputs)
            States and inputs of the stages, [x, u].

        Returns
        -------
        value : ndarray of shape (n_stages, n_outputs)
            The posterior mean.
        """
        mean, std = self.compiled.predict(self._inputs(y), return_std=True)
        return self._keep(y, mean, std)

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        """Differentiate the residual with respect to states and inputs.

        Parameters
        ----------
        y : ndarray of shape (n_stages, n_states + n_inputs)
            States and inputs of the stages, [x, u].

        Returns
        -------
        jacobian : ndarray of shape (n_outputs, n_stages, n_states + n_inputs)
            The derivatives of the posterior mean, with the axis of outputs first.
        """
        return self.value_and_jacobian(y)[1]

    def value_and_jacobian(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict the residual and its derivatives.

        Parameters
        ----------
        y : ndarray of shape (n_stages, n_states + n_inputs)
            States and inputs of the stages, [x, u].

        Returns
        -------
        value : ndarray of shape (n_stages, n_outputs)
            The posterior mean.
        jacobian : ndarray of shape (n_outputs, n_stages, n_states + n_inputs)
            Its derivatives, with the axis of outputs first. They are 0 for columns that the model was not fitted to.
        """
        inputs = self._inputs(y)
        mean, slopes = self.compiled.value_and_jacobian(inputs)
        _, std = self.compiled.predict(inputs, return_std=True)  # takes less time than the derivatives of std
        value = self._keep(y, mean, std)
        slopes = slopes.reshape(*value.shape, inputs.shape[1]).swapaxes(0, 1)  # (n_outputs, n_stages, n_features)
        if self.columns is None:
            self.current_prediction_dy = slopes
        else:
            self.current_prediction_dy = np.zeros((*slopes.shape[:2], y.shape[1]))
            self.current_prediction_dy[:, :, self.columns] = slopes
        return value, self.current_prediction_dy

    def update(self, model: Any) -> None:
        """Copy the weights of a model that has learned further rows by ``partial_fit``.

        Parameters
        ----------
        model : EVGPRegressor, EGPRegressor or ResidualRegressor
            The model that this object was made of, not fitted again since.

        Raises
        ------
        ValueError
            If the model was fitted again, or is another one.
        NotFittedError
            If the model is not fitted.
        """
        self.compiled.update(model)

    def _inputs(self, y: np.ndarray) -> np.ndarray:
        """Return the columns of y (n_stages, n_states + n_inputs) that the model was fitted to."""
        return y if self.columns is None else y[:, self.columns]

    def _keep(self, y: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
        """Keep variance and mean of all rows, and return the mean (n_stages, n_outputs)."""
        self.current_variance = std.reshape(len(y), -1) ** 2
        self.current_prediction = mean.reshape(len(y), -1)
        return self.current_prediction


def checked_columns(columns: ArrayLike | None, n_columns: int) -> np.ndarray | None:
    """Return the columns of y that a model of n_columns columns was fitted to, or raise ValueError."""
    if columns is None:
        return None
    found = np.asarray(columns)
    if (
        found.shape != (n_columns,)
        or not np.issubdtype(found.dtype, np.integer)
        or found.min() < 0
        or len(np.unique(found)) < n_columns
    ):
        raise ValueError(
            f"columns={columns!r} must have a different index, from 0, for each of the {n_columns} columns that the "
            "model was fitted to."
        )
    return found
