"""Save and load models by skops, without running code of a file.

A file is a zip archive. It holds the model and a few rows with their predictions, as skops writes them, and
`skevgp.json` with the versions of the libraries. Versions are read first, so that errors can name them.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import platform
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from io import BytesIO
from typing import Any
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

import numpy as np
import scipy
import sklearn
from joblib import parallel_config
from sklearn import metrics as sklearn_metrics
from sklearn import model_selection
from sklearn.base import BaseEstimator
from sklearn.gaussian_process import kernels as sklearn_kernels
from sklearn.pipeline import Pipeline

from . import metrics
from ._version import __version__
from .data.maps import take_rows
from .exceptions import InconsistentVersionWarning, ignored, warn_user
from .utils.files import replacing
from .utils.frames import FrameColumns
from .utils.optional import require
from .utils.validation import check_fitted

__all__ = ["TRUSTED_TYPES", "load", "save"]

_ABOUT, _FORMAT = "skevgp.json", 2
# A file may unpack to this many times its size, plus this many bytes. Files of `save` unpack to about ten times.
_TIMES, _MORE = 100, 2**24
# Number of rows whose predictions are compared.
_ROWS = 4
# Allowed differences of predictions by other libraries, as shares of the standard deviation and of the mean. The
# standard deviation may differ by a share of the largest mean too, because it is a rounding error if there is no noise.
_OF_STD, _OF_MEAN, _OF_LARGEST = 1e-2, 1e-6, 1e-4
# Parts of the package whose classes do not occur in fitted models.
_WITHOUT_MODELS = (
    *("skevgp.datasets", "skevgp.exceptions", "skevgp.io", "skevgp.metrics", "skevgp.plotting"),
    *("skevgp.data.dask", "skevgp.data.threads", "skevgp.utils.files", "skevgp.utils.monitor"),
)
# Two functions of a covariance that select from a tuple. A range is a user's list of outputs.
_FUNCTIONS = ("builtins.range", "operator.itemgetter", "skevgp.kernels.base._all_of_it")
# Parts of ColumnTransformer, SplineTransformer, SimpleImputer and searches. Some exist in some versions only.
_OF_SCIKIT_LEARN = (
    "numpy.dtype",
    "numpy.number",
    "scipy._lib.array_api_compat.numpy._aliases.asarray",
    "scipy.interpolate._bsplines.BSpline",
    "scipy.interpolate._bsplines._BSpline",
    "sklearn.compose._column_transformer._RemainderColsList",
    "sklearn.compose._column_transformer.make_column_selector",
    "sklearn.metrics._scorer._PassthroughScorer",
    "sklearn.metrics._scorer._Scorer",
    "sklearn.utils._metadata_requests.MetadataRequest",
    "sklearn.utils._metadata_requests.MethodMetadataRequest",
)


def _names_of_types() -> Iterator[str]:
    """Names of the classes and functions that a fitted model may hold."""
    yield from (*_FUNCTIONS, *_OF_SCIKIT_LEARN)
    for found in pkgutil.walk_packages([os.path.dirname(__file__)], "skevgp."):
        if not found.ispkg and not found.name.startswith(_WITHOUT_MODELS):
            module = importlib.import_module(found.name)
            yield from (_name(one) for one in vars(module).values() if _is_class(one) and one.__module__ == found.name)
    # Kernels, splitters and scores are parameters of models and searches.
    yield from (_name(one) for one in vars(sklearn_kernels).values() if _is_class(one, sklearn_kernels.Kernel))
    yield from (_name(one) for one in vars(model_selection).values() if _is_class(one) and hasattr(one, "split"))
    of_regression = sklearn_metrics.r2_score.__module__
    yield from (_name(one) for one in vars(sklearn_metrics).values() if getattr(one, "__module__", "") == of_regression)
    yield from (_name(one) for one in vars(metrics).values() if getattr(one, "__module__", "") == metrics.__name__)


def _is_class(value: Any, parent: type = object) -> bool:
    return isinstance(value, type) and issubclass(value, parent)


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


TRUSTED_TYPES: list[str] = sorted(set(_names_of_types()))
"""Names of the types in a fitted model of skevgp, for ``skops.io.load(path, trusted=TRUSTED_TYPES)``.

They are classes of skevgp, and some of scikit-learn, SciPy and NumPy. None of them runs code of a file. Your own
functions and transformers are not in the list; ``skops.io.get_untrusted_types(file=path)`` names them.
"""


def save(model: BaseEstimator, path: str | os.PathLike[str], *, trusted: Sequence[str] = ()) -> None:
    """Write a fitted model to a file that loads without running code.

    A loaded model predicts exactly the same values, and can continue with ``partial_fit``. Before the file is written,
    it is loaded once as a test. If anything fails, an existing file stays as it is.

    Parameters
    ----------
    model : estimator
        Fitted regressor or transformer of skevgp, or a scikit-learn estimator that contains one.
    path : str or path-like
        File to write, for example ``"arm.skevgp"``. An existing file is replaced.
    trusted : sequence of str, default=()
        Names of further types in the model, such as ``["my_package.MyMap"]`` for your own transformer. `load` needs the
        same list.

    Raises
    ------
    ImportError
        If skops is not installed.
    ValueError
        If the model contains other types, which the message names, or cannot be loaded again.
    sklearn.exceptions.NotFittedError
        If the model is not fitted.
    OSError
        If the file cannot be written.

    See Also
    --------
    load : Read the model again.

    Notes
    -----
    A named system is stored as its name, and any other robot as numbers. Loading the model needs neither its URDF file
    nor example-robot-data. A path that was given as ``robot`` is stored as text. Only another ``fit`` and
    `InverseDynamics.write_urdf` use it.

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
    buffer = BytesIO()
    try:
        skops.dump({"model": model, "trial": _trial(model)}, buffer, compression=ZIP_DEFLATED)
        with ZipFile(buffer, "a") as archive:
            archive.writestr(_ABOUT, json.dumps(_about()))
        _opened(buffer.getvalue(), trusted)
    except Exception as error:
        advice = " Save its best_estimator_ instead." if hasattr(model, "best_estimator_") else ""
        raise ValueError(f"The model cannot be saved: {_said(error)}.{advice}") from error
    with replacing(path) as file:
        file.write(buffer.getbuffer())


def load(path: str | os.PathLike[str], *, trusted: Sequence[str] = ()) -> Any:
    """Read a model from a file that `save` has written.

    Files from unknown sources are safe to load, because no code of the file is run. Only types in `TRUSTED_TYPES` and
    in ``trusted``, and types that skops trusts, are created. The model must predict the same for a few rows as when it
    was saved.

    Parameters
    ----------
    path : str or path-like
        File to read.
    trusted : sequence of str, default=()
        Names of further types to trust, such as ``["my_package.MyMap"]`` for your own transformer.

    Returns
    -------
    model : estimator
        The model as it was saved.

    Raises
    ------
    ValueError
        If the file is damaged, was not written by `save`, has another format, or needs other types. If the model
        predicts other values than before, which may happen with another version of scikit-learn.
    ImportError
        If skops, Pinocchio or a package of data frames is needed and not installed.
    OSError
        If the file cannot be read.

    Warns
    -----
    skevgp.exceptions.InconsistentVersionWarning
        If the model was saved with another version of scikit-learn, and its predictions could not be compared.

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
        data = file.read()
    try:
        model, tried, made_with = _opened(data, trusted)
    except ImportError:
        raise
    except Exception as error:
        # A damaged file may cause any error in skops, NumPy and this package.
        raise ValueError(f"{os.fspath(path)!r} cannot be loaded: {_said(error)}.") from error
    if not tried and made_with.get("scikit-learn") != sklearn.__version__:
        warn_user(
            f"{os.fspath(path)!r} was saved with {_told(made_with)} (here: {_told(_about())}). Its predictions could "
            "not be compared.",
            InconsistentVersionWarning,
        )
    return model


def _opened(data: bytes, trusted: Sequence[str]) -> tuple[Any, bool, dict[str, Any]]:
    """Return the model of a file, whether its predictions were compared, and the versions that wrote the file."""
    with ZipFile(BytesIO(data)) as archive:
        names, size = archive.namelist(), sum(member.file_size for member in archive.infolist())
        if "model.json" in names:
            raise ValueError("it is a file of skevgp 0.1, which this version does not read: fit the model again")
        if size > _TIMES * len(data) + _MORE:
            raise ValueError(f"it has {len(data)} bytes and unpacks to {size}, which no file of skevgp.io.save does")
        about = json.loads(archive.read(_ABOUT)) if _ABOUT in names else None
    if type(about) is not dict or type(about.get("format")) is not int:
        raise ValueError("it is not a file of skevgp.io.save")
    if about["format"] != _FORMAT:
        raise ValueError(f"it has format {about['format']} of {_told(about)}, and skevgp {__version__} reads {_FORMAT}")
    try:
        with ignored(), np.errstate(all="ignore"), parallel_config("sequential"):
            return *_made(data, [*TRUSTED_TYPES, *trusted], about), about
    except ImportError:
        raise
    except Exception as error:
        if about == _about():
            raise
        raise ValueError(f"{_said(error)} (saved with {_told(about)}; here: {_told(_about())})") from error


def _made(data: bytes, trusted: list[str], about: dict[str, Any]) -> tuple[Any, bool]:
    """Return the model of a file, and whether its predictions were compared."""
    skops = require("skops.io", "Loading a model")
    needed = skops.get_untrusted_types(data=data)
    if unknown := sorted(set(needed) - set(trusted)):
        held = f"it holds {', '.join(unknown[:20])}, which"
        if about.get("skevgp") != __version__ and any(name.startswith("skevgp.") for name in unknown):
            raise ValueError(f"{held} this version does not have. Fit the model again, or load it with the old version")
        raise ValueError(f"{held} is not trusted by default. If you trust its code, name it in trusted=[...]")
    content = skops.loads(data, trusted=needed)  # skops copies the list for each part of the model
    if type(content) is not dict or content.keys() != {"model", "trial"}:
        raise ValueError("it is not a file of skevgp.io.save")
    model, trial = content["model"], content["trial"]
    if not isinstance(model, BaseEstimator):
        raise ValueError(f"it holds a {type(model).__name__} instead of a model")
    check_fitted(model[-1] if isinstance(model, Pipeline) else model)
    if trial is not None:
        _compare(model, trial)
    return model, trial is not None


def _said(error: Exception) -> str:
    text = str(error).rstrip(".")
    return text if type(error) in (ValueError, BadZipFile) else f"{type(error).__name__}: {text}"


# --- a few rows and their predictions --------------------------------------------------------------------------------


def _trial(model: Any) -> dict[str, Any] | None:
    """Return rows, mean and standard deviation, or None if no valid rows are known for the model."""
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
    """Return a few rows that a fitted model has seen, or similar ones; a data frame if it was fitted to one."""
    model = getattr(model, "best_estimator_", model)
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
    """Yield the indices of the columns of an encoder, and the values that it knows for each."""
    if hasattr(transformer, "steps"):
        yield from _categories(transformer.steps[0][1], columns)
    elif hasattr(transformer, "transformers_"):
        for name, own, _ in transformer.transformers_:
            own_columns = transformer._transformer_to_input_indices.get(name, [])
            yield from _categories(own, [columns[index] for index in own_columns])
    elif hasattr(transformer, "categories_"):
        yield from zip(columns, transformer.categories_, strict=True)


def _predicted(model: Any, rows: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation, which is 0 if the model has none."""
    if not hasattr(model, "predict"):
        mean, std = model.transform(rows), 0.0
    else:
        try:
            mean, std = model.predict(rows, return_std=True)
        except Exception:
            # Estimators without return_std raise various errors.
            mean, std = model.predict(rows), 0.0
    mean = np.asarray(mean.toarray() if hasattr(mean, "toarray") else mean, dtype=np.float64)
    return mean, np.broadcast_to(np.asarray(std, dtype=np.float64), mean.shape).copy()


def _compare(model: Any, trial: Any) -> None:
    rows, expected, expected_std = trial["rows"], trial["mean"], trial["std"]
    mean, std = _predicted(model, rows.frame() if isinstance(rows, FrameColumns) else rows)
    if mean.shape != expected.shape or std.shape != expected_std.shape:
        raise ValueError(f"its model predicts the shape {mean.shape}, and {expected.shape} when it was saved")
    allowed = _OF_STD * expected_std + _OF_MEAN * np.abs(expected)
    of_std = allowed + _OF_LARGEST * np.abs(expected).max(axis=0, initial=0.0)
    near = (np.abs(mean - expected) <= allowed) & (np.abs(std - expected_std) <= of_std)
    if not (near & np.isfinite(allowed)).all():
        raise ValueError("its model predicts other values than when it was saved")


def _about() -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "skevgp": __version__,
        "scikit-learn": sklearn.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


def _told(about: dict[str, Any]) -> str:
    return ", ".join(f"{name} {about.get(name, '(unknown)')}" for name in [*_about()][1:])[:200]
