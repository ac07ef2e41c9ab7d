"""Snelson's one-dimensional data: from a folder, or from where he published them."""

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
# The folder in the archive, and of the copy that is kept.
_FOLDER = "SPGP_dist"
# SHA-256 of each file's numbers as little-endian doubles: spaces, line ends and the archive around them do not count.
_CHECKSUMS = {
    "train_inputs": "8b1ccec300735c351479d24671c60dbbef4ddb2e0a1fb74eb98ce9419f8f9c7d",
    "train_outputs": "b4f62516c01db0d2b3c1d558d8db71766cd385cc81bc411fe4cd744eba314837",
    "test_inputs": "2b52ebe713c8f1d316c60689e8a1e2529c88ef17afe5a8507095fc49a00d0a49",
}
# In bytes, far above the true sizes: no server can fill the memory.
_LARGEST = 10_000_000
_SECONDS = 30.0


def _numbers(content: bytes, name: str, where: str) -> np.ndarray:
    """Those of one file, if they are Snelson's."""
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
    """The numbers of the files in a folder; None if one is missing."""
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
    """The files by name. They are read, not extracted: no path in the archive reaches the disk."""
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
    """Download the files, check them and keep them in a folder."""
    try:
        contents = _unpack(_download(n_retries, delay))
        numbers = {name: _numbers(content, name, f"{_FOLDER}/{name}") for name, content in contents.items()}
    except (OSError, HTTPException, tarfile.TarError, EOFError, zlib.error) as problem:
        reason = str(problem).rstrip(".")
        raise OSError(
            f"Snelson's data could not be fetched from {_ADDRESS} ({reason}). Put the files {', '.join(_CHECKSUMS)} "
            f"(with or without .dat) into {folder}, or give a folder that holds them as data_home."
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
    """Load Snelson's one-dimensional data, as the paper's toy figure shows them.

    200 noisy observations of a wave at x between 0.06 and 5.97, of Snelson & Ghahramani (2006), which the paper puts on
    a line: (y, x) <- (6 y + 3 x, x). They are downloaded once, from
    http://www.gatsby.ucl.ac.uk/~snelson/SPGP_dist.tgz, and kept.

    Parameters
    ----------
    data_home : str or path-like, default=None
        A folder that holds the files ``train_inputs``, ``train_outputs`` and ``test_inputs`` (with or without
        ``.dat``), or has a folder ``SPGP_dist`` that does. If neither is so, the files are downloaded into that
        ``SPGP_dist``. By default scikit-learn's folder of data sets, see :func:`sklearn.datasets.get_data_home`.
    download_if_missing : bool, default=True
        Whether to download what is not there.
    trend : bool, default=True
        Whether the target is the paper's, 6 y + 3 x, or Snelson's y.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` in place of a Bunch.
    n_retries : int, default=3
        How often to try again if the server does not answer, at least 0.
    delay : float, default=1.0
        Seconds between tries, not negative.

    Returns
    -------
    snelson : :class:`~sklearn.utils.Bunch`
        With ``data`` of shape (200, 1), in the order of the file; ``target`` (200,); ``test_data`` (301, 1), evenly
        spaced from -3 to 10, for which there is no target; ``feature_names``, ``target_names`` and ``DESCR``.
    (data, target) : tuple of ndarray
        If ``return_X_y``.

    Raises
    ------
    OSError
        If the files are not there and cannot be downloaded, or must not be; if a file's numbers do not have the right
        SHA-256 checksum.
    ValueError, TypeError
        If an argument is out of its range or of the wrong type.

    See Also
    --------
    make_toy : Points of the same shape, drawn at random.

    References
    ----------
    - E. Snelson, Z. Ghahramani (2006): Sparse Gaussian processes using pseudo-inputs. Advances in Neural Information
      Processing Systems 18.

    Examples
    --------
    Where there is neither a copy nor a network, `make_toy` has the same shape:

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
    from sklearn.datasets import get_data_home  # here, since it loads all of scikit-learn's data sets

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
