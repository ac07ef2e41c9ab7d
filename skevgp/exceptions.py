"""Warnings of skevgp's own."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock

__all__ = ["DependentRowsWarning", "InconsistentVersionWarning", "RobotModelWarning"]

_filters = RLock()


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


class InconsistentVersionWarning(UserWarning):
    """A model is loaded by another version than it was saved with, and nobody knows whether it predicts the same.

    Given for pickles, and files of `skops.io.dump`, of another version of skevgp; and by `skevgp.io.load` for those few
    models that it cannot try, if they are of another version of scikit-learn. As an error:

    See Also
    --------
    skevgp.io.save : A model of its files has to predict what it did.

    Examples
    --------
    >>> import warnings
    >>> from skevgp.exceptions import InconsistentVersionWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", InconsistentVersionWarning)
    """


class RobotModelWarning(UserWarning):
    """A robot's file or model has numbers that no robot can have, and is used all the same.

    Given by `skevgp.datasets.load_robot`, and by what loads a robot, for moments of inertia that violate the triangle
    inequality and for numbers of a URDF file that are not used, such as a negative limit of effort.

    See Also
    --------
    skevgp.InverseDynamics : Its ``write_urdf`` writes inertias that bodies can have.

    Examples
    --------
    >>> import warnings
    >>> from skevgp.exceptions import RobotModelWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", RobotModelWarning)
    """


def warn_user(message: str, category: type[Warning]) -> None:
    """Warn of the user's line: the first on the stack that is neither of this package nor of scikit-learn."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in ("skevgp", "sklearn"):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


@contextmanager
def ignored(message: str = "", category: type[Warning] = Warning) -> Iterator[None]:
    """Ignore warnings of a category whose text begins so (a regular expression).

    Filters are the process's: two threads that changed them at once would each put back what it found, and leave those
    of the other for ever. So it is one after the other.
    """
    with _filters, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message, category)
        yield
