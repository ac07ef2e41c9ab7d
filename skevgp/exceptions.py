"""Warnings of skevgp's own."""

from __future__ import annotations

import inspect
import warnings

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


def warn_user(message: str, category: type[Warning]) -> None:
    """Warn of the user's line: the first on the stack that is neither of this package nor of scikit-learn."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in ("skevgp", "sklearn"):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
