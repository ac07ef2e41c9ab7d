"""Snelson's one-dimensional data, from a folder or from where he published them."""

from __future__ import annotations

import hashlib
import io
import os
import tarfile
import time
import zlib
from http.client import HTTPException
from pathlib import Path, PurePosixPath
from typing import Literal, overload
from urllib.request import urlopen

import numpy as np
from sklearn.utils import Bunch

from ..utils.files import replacing
from ..utils.validation import check_integer, check_real

_ADDRESS = "http://www.gatsby.ucl.ac.uk/~snelson/SPGP_dist.tgz"
# Name of the folder in the archive, and of that with the copy.
_FOLDER = "SPGP_dist"
# SHA-256 of the numbers of each file as little-endian doubles, so that white space and the archive do not count.
_CHECKSUMS = {
    "train_inputs": "8b1ccec300735c351479d24671c60dbbef4ddb2e0a1fb74eb98ce9419f8f9c7d",
    "train_outputs": "b4f62516c01db0d2b3c1d558d8db71766cd385cc81bc411fe4cd744eba314837",
    "test_inputs": "2b52ebe713c8f1d316c60689e8a1e2529c88ef17afe5a8507095fc49a00d0a49",
}
# Largest size in bytes, far above the true sizes, so that a server cannot fill the memory.
_LARGEST = 10_000_000
_SECONDS = 30.0


def _numbers(content: bytes, name: str, where: str) -> np.ndarray:
    """Return the numbers of one file, or raise an error if they are not Snelson's."""
    try:
        values = np.array(content.split(), dtype="<f8")
    except ValueError:
        raise OSError(f"{where} is not a list of numbers.") from None
    found = hashlib.sha256(values.tobytes()).hexdigest()
    if found != _CHECKSUMS[name]:
        raise OSError(
            f"The numbers in {where} are not Snelson's: their SHA-256 checksum is {found}, expected {_CHECKSUMS[name]}."
        )
    return values.astype(np.float64)


def _load(folder: Path) -> dict[str, np.ndarray] | None:
    """Return the numbers of the files in a folder, or None if one is missing."""
    numbers = {}
    for name in _CHECKSUMS:
        path = next((path for path in (folder / name, folder / f"{name}.dat") if path.is_file()), None)
        if path is None:
            return None
        numbers[name] = _numbers(path.read_bytes(), name, f"{path} (remove it to fetch the data again)")
    return numbers


def _download(n_retries: int, delay: float) -> bytes:
    try:
        with urlopen(_ADDRESS, timeout=_SECONDS) as response:
            return response.read(_LARGEST)
    except (OSError, HTTPException):
        if n_retries == 0:
            raise
    time.sleep(delay)
    return _download(n_retries - 1, delay)


def _unpack(archive: bytes) -> dict[str, bytes]:
    """Return the files by name. They are read, not extracted, so that no path in the archive is used on the disk."""
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as members:
        found = {PurePosixPath(member.name): member for member in members if member.isfile()}
        contents = {}
        for name in _CHECKSUMS:
            path = PurePosixPath(_FOLDER, name)
            if path not in found:
                raise OSError(f"the archive has no file {path}")
            file = members.extractfile(found[path])
            assert file is not None  # since it is a file
            contents[name] = file.read(_LARGEST)
    return contents


def _fetch(folder: Path, n_retries: int, delay: float) -> dict[str, np.ndarray]:
    """Download the files, check them and store them in a folder."""
    try:
        contents = _unpack(_download(n_retries, delay))
        numbers = {name: _numbers(content, name, f"{_FOLDER}/{name}") for name, content in contents.items()}
    except (OSError, HTTPException, tarfile.TarError, EOFError, zlib.error) as problem:
        reason = str(problem).rstrip(".")
        raise OSError(
            f"Snelson's data could not be fetched from {_ADDRESS} ({reason}). Put the files {', '.join(_CHECKSUMS)} "
            f"(with or without .dat) into {folder}, or pass their folder as data_home."
        ) from problem
    folder.mkdir(exist_ok=True)
    for name, content in contents.items():
        with replacing(folder / name) as file:
            file.write(content)
    return numbers


@overload
def fetch_snelson(
    data_home: str | os.PathLike[str] | None = ...,
    download_if_missing: bool = ...,
    *,
    trend: bool = ...,
    return_X_y: Literal[False] = ...,
    n_retries: int = ...,
    delay: float = ...,
) -> Bunch: ...
@overload
def fetch_snelson(
    data_home: str | os.PathLike[str] | None = ...,
    download_if_missing: bool = ...,
    *,
    trend: bool = ...,
    return_X_y: Literal[True],
    n_retries: int = ...,
    delay: float = ...,
) -> tuple[np.ndarray, np.ndarray]: ...
def fetch_snelson(
    data_home: str | os.PathLike[str] | None = None,
    download_if_missing: bool = True,
    *,
    trend: bool = True,
    return_X_y: bool = False,
    n_retries: int = 3,
    delay: float = 1.0,
) -> Bunch | tuple[np.ndarray, np.ndarray]:
    """Load Snelson's one-dimensional data, as in the toy figure of the paper.

    The data are 200 noisy observations of a wave (Snelson & Ghahramani 2006). The paper adds a line to the target, 6 y
    + 3 x. The files are downloaded once from http://www.gatsby.ucl.ac.uk/~snelson/SPGP_dist.tgz.

    Parameters
    ----------
    data_home : str or path-like, default=None
        Folder with the files ``train_inputs``, ``train_outputs`` and ``test_inputs`` (with or without ``.dat``). A
        folder ``SPGP_dist`` inside of it may hold them too, and downloaded files go there. If None, scikit-learn's
        folder of data sets (:func:`sklearn.datasets.get_data_home`).
    download_if_missing : bool, default=True
        Whether to download missing files.
    trend : bool, default=True
        Whether the target is 6 y + 3 x, as in the paper. If False, it is Snelson's y.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` instead of a Bunch.
    n_retries : int, default=3
        Number of retries if the server does not answer, at least 0.
    delay : float, default=1.0
        Time between tries, in seconds, at least 0.

    Returns
    -------
    snelson : :class:`~sklearn.utils.Bunch`
        Dictionary-like object with

        - ``data`` : ndarray of shape (200, 1), in the order of the file;
        - ``target`` : ndarray of shape (200,);
        - ``test_data`` : ndarray of shape (301, 1), evenly spaced from -3 to 10, without targets;
        - ``feature_names``, ``target_names``, ``DESCR``.
    (data, target) : tuple of ndarray
        Returned only if ``return_X_y`` is True.

    Raises
    ------
    OSError
        If files are missing and cannot or must not be downloaded, or if their numbers have another SHA-256 checksum.
    ValueError, TypeError
        If an argument is out of its range or of the wrong type.

    See Also
    --------
    make_toy : Random points of the same shape.

    References
    ----------
    - E. Snelson, Z. Ghahramani (2006): Sparse Gaussian processes using pseudo-inputs. Advances in Neural Information
      Processing Systems 18.

    Examples
    --------
    Use `make_toy` if there is neither a copy nor a network:

    >>> from skevgp.datasets import fetch_snelson, make_toy
    >>> try:
    ...     toy = fetch_snelson(download_if_missing=False)
    ... except OSError:
    ...     toy = make_toy(random_state=0)
    >>> toy.data.shape, toy.target.shape
    ((200, 1), (200,))
    """
    check_integer(n_retries, "n_retries", minimum=0)
    check_real(delay, "delay", minimum=0.0)
    from sklearn.datasets import get_data_home  # here, because it loads all data sets of scikit-learn

    home = Path(get_data_home(data_home))
    folder = home / _FOLDER
    numbers = _load(home) or _load(folder)
    if numbers is None and not download_if_missing:
        raise OSError(
            f"Snelson's data are neither in {home} nor in {folder}, and download_if_missing is False. They are the "
            f"files {', '.join(_CHECKSUMS)} (with or without .dat) from {_ADDRESS}."
        )
    if numbers is None:
        numbers = _fetch(folder, n_retries, delay)
    x, y = numbers["train_inputs"], numbers["train_outputs"]
    data, target = x[:, np.newaxis], 6.0 * y + 3.0 * x if trend else y
    if return_X_y:
        return data, target
    return Bunch(
        data=data,
        target=target,
        test_data=numbers["test_inputs"][:, np.newaxis],
        feature_names=["x"],
        target_names=["y"],
        DESCR=f"Snelson's 200 one-dimensional points{', with y <- 6 y + 3 x' if trend else ''}; from {_ADDRESS}.",
    )
