"""Warnings of skevgp's own."""

from __future__ import annotations

__all__ = ["DependentRowsWarning"]


class DependentRowsWarning(UserWarning):
    """Rows near each other are alike, and nobody said which belong together.

    Given by `EVGPRegressor.fit` without ``groups``: its standard deviations are then those of rows like these, not of
    new trajectories.

    See Also
    --------
    EVGPRegressor : Its ``fit`` takes ``groups``, by which ``noise_cv`` leaves out rows.

    Examples
    --------
    Where rows are sorted but independent:

    >>> import warnings
    >>> from skevgp.exceptions import DependentRowsWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", DependentRowsWarning)
    """
