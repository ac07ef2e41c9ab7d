"""The state of estimators in pickles and files: the version of skevgp and plain data only.

Data frames and models of Pinocchio, which skops cannot store, become arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import PurePath
from typing import Any

from sklearn.base import BaseEstimator

from .._version import __version__
from ..exceptions import InconsistentVersionWarning, warn_user
from .doc_links import DocumentedEstimator
from .frames import FrameColumns

_KEY = "_skevgp_version"
# Classes of plain data, each with a function that converts an object (None if it cannot) and one that converts it back.
_STORED: dict[type, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    FrameColumns: (FrameColumns.of, FrameColumns.frame)
}


def stored_as(kind: type, of: Callable[[Any], Any], back: Callable[[Any], Any]) -> None:
    """Let states store objects that ``of`` converts as plain data of the class ``kind``."""
    _STORED[kind] = of, back


class StatefulEstimator(DocumentedEstimator, BaseEstimator):
    """An estimator whose state holds the version, with a warning if it is loaded by another version."""

    def __getstate__(self) -> dict[str, Any]:
        state = {name: _as_data(value) for name, value in super().__getstate__().items()}
        # The version says nothing about a class of the user. scikit-learn does the same.
        return {**state, _KEY: __version__} if _is_ours(self) else state

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = {name: _from_data(value) for name, value in state.items()}
        version = state.pop(_KEY, None)
        if _is_ours(self) and version != __version__:
            warn_user(
                f"{type(self).__name__} is a pickle of skevgp {version or '(version unknown)'}, and this is "
                f"{__version__}. It may fail, or predict other values. Fit it again, or load it with that version "
                "and save it with skevgp.io.save.",
                InconsistentVersionWarning,
            )
        super().__setstate__(state)


def _is_ours(estimator: object) -> bool:
    return type(estimator).__module__.startswith("skevgp.")


def _as_data(value: Any) -> Any:
    if isinstance(value, PurePath):
        # A path of another operating system could not be restored.
        return str(value)
    found = (of(value) for of, _ in _STORED.values())
    return next((data for data in found if data is not None), value)


def _from_data(value: Any) -> Any:
    return _STORED[type(value)][1](value) if type(value) in _STORED else value
