"""Models as files that hold data alone."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from importlib.util import find_spec
from typing import IO, Any
from zipfile import BadZipFile

import numpy as np
import scipy
import sklearn
from joblib import parallel_config
from sklearn.base import BaseEstimator
from sklearn.pipeline import Pipeline

from .._version import __version__
from ..data.maps import take_rows
from ..exceptions import InconsistentVersionWarning, ignored, warn_user
from ..utils.files import replacing
from ..utils.frames import FrameColumns
from ..utils.validation import check_fitted
from . import of_maps, of_models
from .container import Container, write
from .fields import MalformedError
from .records import Record, by_name
from .values import Reader, Writer, refusal

FORMAT, VERSION = "skevgp", 1
_ROWS = 4
# What a prediction may differ by where other libraries compute it: shares of its standard deviation, and of itself; its
# standard deviation by a share of the largest mean too, since it is rounding where there is no noise.
_OF_STD, _OF_MEAN, _OF_LARGEST = 1e-2, 1e-6, 1e-4


def _records() -> dict[str, Record]:
    return by_name([*of_models.RECORDS, *of_maps.RECORDS])


def save(model: BaseEstimator, path: str | os.PathLike[str]) -> None:
    """Write a fitted model to a file that holds data alone.

    The file is a zip archive of a JSON text and arrays. A model that is loaded from it predicts the same to the bit,
    and goes on with ``partial_fit``. The file is written beside ``path`` and read again before it takes its place: if
    anything fails, what was at ``path`` is still there.

    Parameters
    ----------
    model : estimator
        Fitted: any regressor or map of skevgp, and scikit-learn's pipelines, unions and column transformers of these
        with scikit-learn's common scalers and encoders.
    path : str or path-like
        Of the file, for example ``"arm.skevgp"``. It is replaced.

    Raises
    ------
    ValueError
        If part of the model is code or of a class that the file does not hold, such as a map of yours, a kernel that is
        a function, or a callback; the message names it.
    sklearn.exceptions.NotFittedError
        If the model is not fitted.
    OSError
        If the file cannot be written.

    See Also
    --------
    load : The way back.

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
    check_fitted(model[-1] if isinstance(model, Pipeline) else model)
    writer = Writer({record.kind: record for record in _records().values()})
    root = writer.value(model, "model")
    if type(root) is not dict or "object" not in root:
        raise ValueError(refusal(model, "model"))
    content = {
        "format": FORMAT,
        "version": VERSION,
        "made_with": _versions(),
        "objects": writer.objects,
        "model": root,
        "trial": None,
    }
    content["trial"] = writer.value(_trial(model), "trial")
    with replacing(path) as file:
        write(file, content, writer.arrays)
        try:
            _loaded(file, os.fspath(path))
        except ValueError as error:
            raise ValueError(f"The model cannot be saved, for its file could not be read: {error}") from error


def load(path: str | os.PathLike[str]) -> Any:
    """Read a model from a file of `save`.

    Nothing in the file is run or imported, and nothing outside of it is opened, so that files of strangers may be
    read. All that it says is checked. At last the model has to predict again what it predicted for a few rows when it
    was saved.

    Parameters
    ----------
    path : str or path-like
        Of the file.

    Returns
    -------
    model : estimator
        As it was saved.

    Raises
    ------
    ValueError
        If the file is damaged, no such file, of a later version, or the model does not predict what it did, as may be
        with other versions of scikit-learn. The message names the file and says what is wrong.
    ImportError
        If the model needs Pinocchio, or was fitted to a data frame of a package, that is not installed; the message
        gives the pip command.
    OSError
        If the file cannot be read.

    Warns
    -----
    skevgp.exceptions.InconsistentVersionWarning
        If the model was saved with another version of scikit-learn, and could not be tried when it was.

    See Also
    --------
    save : The way there; it has an example.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from skevgp.io import load
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "notes.skevgp"
    ...     _ = path.write_text("no model")
    ...     load(path)  # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
    ValueError: '.../notes.skevgp' is not a file of skevgp.io.save, or damaged: File is not a zip file.
    """
    with open(path, "rb") as file:
        return _loaded(file, os.fspath(path))


def _loaded(file: IO[bytes], path: str) -> Any:
    try:
        with ignored(), np.errstate(all="ignore"), parallel_config("sequential"):
            model, made_with, tried = _read(file)
    except ImportError:
        raise
    except (MalformedError, BadZipFile) as error:
        raise ValueError(f"{path!r} is not a file of skevgp.io.save, or damaged: {error}.") from error
    except Exception as error:
        # What a class makes of fields that are good one by one.
        raise ValueError(f"{path!r} is damaged: {type(error).__name__}: {error}") from error
    now = _versions()["scikit-learn"]
    if not tried and made_with.get("scikit-learn") != now:
        warn_user(
            f"{path!r} was saved with scikit-learn {made_with.get('scikit-learn')}, and this is {now}. What the model "
            "predicts could not be compared.",
            InconsistentVersionWarning,
        )
    return model


def _read(file: IO[bytes]) -> tuple[Any, dict[str, str], bool]:
    """The model, the versions it was made with, and whether it has been tried."""
    container = Container(file)
    content = container.text()
    if type(content) is not dict or content.get("format") != FORMAT or type(content.get("version")) is not int:
        raise MalformedError("it does not say that it is one")
    if content["version"] > VERSION:
        raise MalformedError(
            f"it is of version {content['version']}, and this skevgp ({__version__}) reads files up to version "
            f"{VERSION}: update skevgp"
        )
    if content.keys() != {"format", "version", "made_with", "objects", "model", "trial"} or content["version"] < 1:
        raise MalformedError("it has other parts than such a file")
    made_with = content["made_with"]
    if type(made_with) is not dict or not all(type(name) is str for name in made_with.values()):
        raise MalformedError("it does not say what it was made with")
    reader = Reader(container, _records())
    reader.objects(content["objects"])
    model, trial = reader.value(content["model"]), reader.value(content["trial"])
    if not isinstance(model, BaseEstimator):
        raise MalformedError(f"it has a {type(model).__name__} in place of a model")
    check_fitted(model)
    if trial is not None:
        _compare(model, trial, made_with)
    return model, made_with, trial is not None


def _trial(model: Any) -> dict[str, Any] | None:
    """A few rows, and what is predicted of them; None for a model of which nobody knows what rows it takes."""
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
    example = getattr(model, "_example", None)
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
    arrays = [trial.get(name) if type(trial) is dict else None for name in ("mean", "std")]
    if type(trial) is not dict or trial.keys() != {"rows", "mean", "std"}:
        raise MalformedError("its trial is not rows, their mean and their standard deviation")
    if not all(isinstance(each, np.ndarray) and each.dtype == np.float64 for each in arrays):
        raise MalformedError("its trial has predictions that are no numbers")
    rows = trial["rows"].frame() if isinstance(trial["rows"], FrameColumns) else trial["rows"]
    mean, std = _predicted(model, rows)
    if mean.shape != trial["mean"].shape or std.shape != trial["std"].shape:
        raise MalformedError(f"its model predicts the shape {mean.shape}, and {trial['mean'].shape} when it was saved")
    allowed = _OF_STD * trial["std"] + _OF_MEAN * np.abs(trial["mean"])
    of_std = allowed + _OF_LARGEST * np.abs(trial["mean"]).max(axis=0, initial=0.0)
    near = (np.abs(mean - trial["mean"]) <= allowed) & (np.abs(std - trial["std"]) <= of_std)
    if not (near & np.isfinite(allowed)).all():
        raise MalformedError(
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
