"""Models as files, by skops: loading runs no code of the file, and the model has to predict what it did.

A file is what skops makes of the model, and of a few rows with what the model predicted for them when it was saved.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import platform
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import IO, Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import numpy as np
import scipy
import sklearn
from joblib import parallel_config
from sklearn.base import BaseEstimator
from sklearn.gaussian_process import kernels as sklearn_kernels
from sklearn.pipeline import Pipeline

import skevgp

from ._version import __version__
from .data.maps import take_rows
from .exceptions import InconsistentVersionWarning, ignored, warn_user
from .utils.files import replacing
from .utils.frames import FrameColumns
from .utils.optional import require
from .utils.validation import check_fitted

__all__ = ["TRUSTED_TYPES", "load", "save"]

_FORMAT, _VERSION = "skevgp", 2
# Rows that a model is tried with.
_ROWS = 4
# What a prediction may differ by where other libraries compute it: shares of its standard deviation, and of itself; its
# standard deviation by a share of the largest mean too, since it is rounding where there is no noise.
_OF_STD, _OF_MEAN, _OF_LARGEST = 1e-2, 1e-6, 1e-4
# Parts of the package without a class that is part of a fitted model.
_WITHOUT_MODELS = ("skevgp.datasets", "skevgp.exceptions", "skevgp.io", "skevgp.metrics", "skevgp.plotting")
# Of a covariance: takes a tuple apart.
_FUNCTIONS = ("operator.itemgetter", "skevgp.kernels.covariances._all_of_it")
# Parts of ColumnTransformer, SplineTransformer and SimpleImputer, some of them in some versions only.
_OF_SCIKIT_LEARN = (
    "numpy.dtype",
    "numpy.number",
    "scipy._lib.array_api_compat.numpy._aliases.asarray",
    "scipy.interpolate._bsplines.BSpline",
    "scipy.interpolate._bsplines._BSpline",
    "sklearn.compose._column_transformer._RemainderColsList",
    "sklearn.compose._column_transformer.make_column_selector",
)
# scikit-learn's kernels are kernel and kernel_.
_KERNELS = tuple(
    f"{kind.__module__}.{kind.__name__}"
    for kind in vars(sklearn_kernels).values()
    if isinstance(kind, type) and issubclass(kind, sklearn_kernels.Kernel)
)


def _classes() -> Iterator[str]:
    """The classes of this package whose instances a fitted model may hold: no functions."""
    for found in pkgutil.walk_packages(skevgp.__path__, "skevgp."):
        if found.ispkg or found.name.startswith(_WITHOUT_MODELS):
            continue
        for value in vars(importlib.import_module(found.name)).values():
            if isinstance(value, type) and value.__module__ == found.name:
                yield f"{found.name}.{value.__qualname__}"


TRUSTED_TYPES: list[str] = sorted({*_classes(), *_FUNCTIONS, *_KERNELS, *_OF_SCIKIT_LEARN})
"""Names of the types that a fitted model of skevgp is made of, for ``skops.io.load(path, trusted=TRUSTED_TYPES)``: its
own classes, and some of scikit-learn, SciPy and NumPy. None of them runs what a file says. Functions and transformers
of yours are not among them: ``skops.io.get_untrusted_types(file=path)`` lists these.
"""


def save(model: BaseEstimator, path: str | os.PathLike[str], *, trusted: Sequence[str] = ()) -> None:
    """Write a fitted model to a file from which loading runs no code.

    A loaded model predicts the same to the bit, and goes on with ``partial_fit``. The file is written next to ``path``
    and read again before it replaces ``path``: if anything fails, the old file is still there.

    Parameters
    ----------
    model : estimator
        Fitted: a regressor or transformer of skevgp, or a scikit-learn estimator of these.
    path : str or path-like
        File to write, for example ``"arm.skevgp"``. It is replaced.
    trusted : sequence of str, default=()
        Names of further types in the model, such as transformers and functions of yours:
        ``["my_package.MyMap"]``. `load` needs the same list.

    Raises
    ------
    ImportError
        If skops is not installed; the message gives the pip command.
    ValueError
        If the model holds other types, which the message names, or its file could not be read.
    sklearn.exceptions.NotFittedError
        If the model is not fitted.
    OSError
        If the file cannot be written.

    See Also
    --------
    load : Read the model again.

    Notes
    -----
    A named system is stored as its name. What a fitted map knows of any other robot is stored as numbers: neither its
    URDF file nor example-robot-data has to be there when the model is loaded. The path that was given as ``robot``
    stays in the parameters, as text that only another ``fit`` or `InverseDynamics.write_urdf` follows.

    Examples
    --------
    >>> import os, tempfile
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.io import load, save
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, y)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "toy.skevgp")
    ...     save(model, path)
    ...     again = load(path)
    >>> bool((again.predict(X) == model.predict(X)).all())
    True
    """
    skops = require("skops.io", "Saving a model")
    check_fitted(model[-1] if isinstance(model, Pipeline) else model)
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "made_with": _versions(),
        "model": model,
        "trial": _trial(model),
    }
    with replacing(path) as file:
        try:
            skops.dump(content, file)
            _loaded(file, os.fspath(path), trusted)
        except OSError:
            raise
        except Exception as error:
            raise ValueError(f"The model cannot be saved: {error}") from error


def load(path: str | os.PathLike[str], *, trusted: Sequence[str] = ()) -> Any:
    """Read a model from a file of `save`.

    Only types on a list are made: `TRUSTED_TYPES`, those that skops trusts, and ``trusted``. No code of the file is
    run, so that files of strangers may be read. Finally, the model has to predict what it predicted for a few rows when
    it was saved.

    Parameters
    ----------
    path : str or path-like
        File to read.
    trusted : sequence of str, default=()
        Names of further types to trust, such as transformers of yours: ``["my_package.MyMap"]``.

    Returns
    -------
    model : estimator
        As it was saved.

    Raises
    ------
    ValueError
        If the file is damaged, no such file, of another version, needs other types, or the model does not predict what
        it did, which may happen with other versions of scikit-learn. The message names the file and says what is wrong.
    ImportError
        If skops is not installed, or the model needs Pinocchio, or a package of data frames, that is not installed; the
        message gives the pip command.
    OSError
        If the file cannot be read.

    Warns
    -----
    skevgp.exceptions.InconsistentVersionWarning
        If the model was saved with another version of scikit-learn, and could not be tried when it was.

    See Also
    --------
    save : Write the file.

    Examples
    --------
    >>> import os, tempfile
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.io import load, save
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "toy.skevgp")
    ...     save(EVGPRegressor(n_inducing=10, random_state=0).fit(X, y), path)
    ...     load(path).n_inducing
    10
    """
    require("skops.io", "Loading a model")
    with open(path, "rb") as file:
        return _loaded(file, os.fspath(path), trusted)


def _loaded(file: IO[bytes], path: str, trusted: Sequence[str]) -> Any:
    """The model of a file that is open."""
    try:
        with ignored(), np.errstate(all="ignore"), parallel_config("sequential"):
            model, made_with, tried = _read(file, [*TRUSTED_TYPES, *trusted])
    except (ImportError, MemoryError):
        raise
    except Exception as error:
        # Whatever a damaged file makes of skops, of NumPy and of our classes.
        raise ValueError(f"{path!r} is not a file of skevgp.io.save, or damaged: {_said(error)}.") from error
    now = _versions()["scikit-learn"]
    if not tried and made_with.get("scikit-learn") != now:
        warn_user(
            f"{path!r} was saved with scikit-learn {made_with.get('scikit-learn')}, and this is {now}. What the model "
            "predicts could not be compared.",
            InconsistentVersionWarning,
        )
    return model


def _read(file: IO[bytes], trusted: list[str]) -> tuple[Any, dict[str, str], bool]:
    """The model, the versions it was made with, and whether it has been tried."""
    skops = require("skops.io", "Loading a model")
    file.seek(0)
    with ZipFile(file) as archive:
        if "model.json" in archive.namelist():
            raise ValueError("it is of skevgp 0.1, which this version does not read: fit the model again")
        # Not compressed, it takes no more memory than the file.
        if any(member.compress_type != ZIP_STORED for member in archive.infolist()):
            raise ValueError("it is compressed")
    file.seek(0)
    data = file.read()
    unknown = sorted(set(skops.get_untrusted_types(data=data)) - set(trusted))
    if unknown:
        raise ValueError(
            f"it holds {', '.join(unknown)}, of which loading may run code. If you trust that code, name the types in "
            "trusted=[...]"
        )
    content = skops.loads(data, trusted=trusted)
    if type(content) is not dict or content.get("format") != _FORMAT or type(content.get("version")) is not int:
        raise ValueError("it does not say that it is one")
    if content["version"] > _VERSION:
        raise ValueError(
            f"it is of version {content['version']}, and this skevgp ({__version__}) reads files of version "
            f"{_VERSION}; update skevgp"
        )
    model, made_with, trial = content["model"], content["made_with"], content["trial"]
    if not isinstance(model, BaseEstimator):
        raise ValueError(f"it has a {type(model).__name__} instead of a model")
    check_fitted(model[-1] if isinstance(model, Pipeline) else model)
    if trial is not None:
        _compare(model, trial, made_with)
    return model, made_with, trial is not None


def _said(error: Exception) -> str:
    text = str(error).rstrip(".")
    return text if type(error) in (ValueError, BadZipFile) else f"{type(error).__name__}: {text}"


# --- a few rows, and what is predicted of them -----------------------------------------------------------------------


def _trial(model: Any) -> dict[str, Any] | None:
    """Rows, mean and standard deviation; None for a model of which nobody knows what rows it takes."""
    rows = _rows_for(model)
    try:
        with ignored(), np.errstate(all="ignore"):
            mean, std = _predicted(model, rows)
    except Exception:
        return None
    if not np.isfinite(mean).all() or not np.isfinite(std).all():
        return None
    columns = FrameColumns.of(rows)
    return {"rows": rows if columns is None else columns, "mean": mean, "std": std}


def _rows_for(model: Any) -> Any:
    """A few rows that a fitted model has seen, or that look like them: a data frame if it was fitted to one."""
    posterior = getattr(model, "_posterior", None)
    example = getattr(model, "_example", None) if posterior is None else posterior.maps.example
    if example is not None:
        return take_rows(example, slice(0, _ROWS))
    numbers = np.random.RandomState(0).uniform(0.1, 1.0, (_ROWS, getattr(model, "n_features_in_", 1)))
    names = getattr(model, "feature_names_in_", None)
    package = next((name for name in ("pandas", "polars") if find_spec(name) is not None), None)
    if names is None or package is None:
        return numbers
    columns: list[np.ndarray] = list(numbers.T)
    for index, known in _categories(model, range(len(columns))):
        columns[index] = np.array([known[row % len(known)] for row in range(_ROWS)], dtype=object)
    return FrameColumns(package, list(names), columns).frame()


def _categories(transformer: Any, columns: Any) -> Iterator[tuple[int, Any]]:
    """Columns that an encoder takes, by index, and the values it knows of each."""
    if hasattr(transformer, "steps"):
        yield from _categories(transformer.steps[0][1], columns)
    elif hasattr(transformer, "transformers_"):
        for name, own, _ in transformer.transformers_:
            own_columns = transformer._transformer_to_input_indices.get(name, [])
            yield from _categories(own, [columns[index] for index in own_columns])
    elif hasattr(transformer, "categories_"):
        yield from zip(columns, transformer.categories_, strict=True)


def _predicted(model: Any, rows: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation, or 0 of what has none."""
    if not hasattr(model, "predict"):
        mean, std = model.transform(rows), 0.0
    else:
        try:
            mean, std = model.predict(rows, return_std=True)
        except TypeError:
            mean, std = model.predict(rows), 0.0
    mean = np.asarray(mean.toarray() if hasattr(mean, "toarray") else mean, dtype=np.float64)
    return mean, np.broadcast_to(np.asarray(std, dtype=np.float64), mean.shape).copy()


def _compare(model: Any, trial: Any, made_with: dict[str, str]) -> None:
    rows, expected, expected_std = trial["rows"], trial["mean"], trial["std"]
    mean, std = _predicted(model, rows.frame() if isinstance(rows, FrameColumns) else rows)
    if mean.shape != expected.shape or std.shape != expected_std.shape:
        raise ValueError(f"its model predicts the shape {mean.shape}, and {expected.shape} when it was saved")
    allowed = _OF_STD * expected_std + _OF_MEAN * np.abs(expected)
    of_std = allowed + _OF_LARGEST * np.abs(expected).max(axis=0, initial=0.0)
    near = (np.abs(mean - expected) <= allowed) & (np.abs(std - expected_std) <= of_std)
    if not (near & np.isfinite(allowed)).all():
        raise ValueError(
            f"its model does not predict what it did when it was saved, with {_told(made_with)} (here: "
            f"{_told(_versions())})"
        )


def _versions() -> dict[str, str]:
    return {
        "skevgp": __version__,
        "scikit-learn": sklearn.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


def _told(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in list(versions.items())[:5])[:200]
