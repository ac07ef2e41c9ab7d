"""Warnings of skevgp."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock

__all__ = [
    "DependentRowsWarning",
    "InconsistentVersionWarning",
    "RobotModelWarning",
    "UnidentifiedWarning",
    "UnstableRolloutWarning",
]

_filters = RLock()


class DependentRowsWarning(UserWarning):
    """Warning that neighbouring rows are similar, but ``groups`` were not given.

    `EVGPRegressor.fit` gives it. The standard deviations are then valid for rows near the training rows, but not for
    new trajectories.

    See Also
    --------
    EVGPRegressor : Its ``fit`` takes ``groups``, which ``noise_cv`` holds out in folds.

    Examples
    --------
    Ignore it if rows are sorted but independent:

    >>> import warnings
    >>> from skevgp.exceptions import DependentRowsWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", DependentRowsWarning)
    """


class InconsistentVersionWarning(UserWarning):
    """Warning that a model was saved with another version, and may predict other values.

    It appears if a pickle or a file of `skops.io.dump` comes from another version of skevgp. `skevgp.io.load` gives it
    if the file comes from another version of scikit-learn, and predictions cannot be compared.

    See Also
    --------
    skevgp.io.save : Write a file whose predictions are compared when it is loaded.

    Examples
    --------
    Turn it into an error:

    >>> import warnings
    >>> from skevgp.exceptions import InconsistentVersionWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", InconsistentVersionWarning)
    """


class RobotModelWarning(UserWarning):
    """Warning that the file, the model or a log of a robot has unphysical numbers.

    `skevgp.datasets.load_robot` gives it for moments of inertia that violate the triangle inequality. It also gives it
    for numbers of a URDF file that are not used, such as a negative effort limit. Every function that loads a robot
    does the same. `skevgp.datasets.load_log` gives the warning if it finds that efforts lag behind positions.

    See Also
    --------
    skevgp.InverseDynamics : Its ``write_urdf`` writes physical inertias.

    Examples
    --------
    >>> import warnings
    >>> from skevgp.exceptions import RobotModelWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", RobotModelWarning)
    """


class UnidentifiedWarning(UserWarning):
    """Warning that the data do not identify a parameter of the feature map.

    The posterior of the parameter is its prior. `EVGPRegressor.fit` and `EGPRegressor.fit` give this warning.

    See Also
    --------
    skevgp.features.ParametricFeatures : Features with parameters.

    Examples
    --------
    >>> import warnings
    >>> from skevgp.exceptions import UnidentifiedWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", UnidentifiedWarning)
    """


class UnstableRolloutWarning(UserWarning):
    """Warning that a few particles of a rollout run away, and dominate its mean and standard deviation.

    `skevgp.rollout` gives it. Particles that leave the training data follow a function that the data do not determine.
    Quantiles of ``samples`` describe the other particles.

    See Also
    --------
    skevgp.rollout : Multi-step predictions.

    Examples
    --------
    >>> import warnings
    >>> from skevgp.exceptions import UnstableRolloutWarning
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", UnstableRolloutWarning)
    """


def warn_user(message: str, category: type[Warning]) -> None:
    """Warn at the line of the user: the innermost frame outside of this package and scikit-learn."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in ("skevgp", "sklearn"):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


@contextmanager
def ignored(message: str = "", category: type[Warning] = Warning) -> Iterator[None]:
    """Ignore warnings of a category whose text begins with ``message`` (a regular expression)."""
    # Filters belong to the process. Two threads that change them at the same time would restore the filters of each
    # other, so that a lock lets one thread in at a time.
    with _filters, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message, category)
        yield
