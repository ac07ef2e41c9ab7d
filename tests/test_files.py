"""Files that are written whole or not at all: where the disk is full, and where there is no file to write."""

import os
from threading import Thread

import numpy as np
import pytest

from skevgp import EVGPRegressor
from skevgp.io import save
from skevgp.robots import inertial_parameters, load_robot, write_urdf
from skevgp.utils.files import replacing


@pytest.fixture(scope="module")
def model():
    rows = np.linspace(0.0, 1.0, 20)[:, np.newaxis]
    return EVGPRegressor(n_inducing=3, max_iter=0, random_state=0).fit(rows, rows[:, 0])


WRITERS = {
    "model.skevgp": lambda model, path: save(model, path),
    "arm.urdf": lambda model, path: write_urdf("ur5", path, inertial_parameters(load_robot("ur5"))),
    "code.c": lambda model, path: model.to_c(path),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("there", [True, False], ids=["there", "new"])
def test_full_disk_keeps_old_file(name, there, model, tmp_path, monkeypatch):
    if there:
        for file in (name, "code.h"):
            (tmp_path / file).write_bytes(b"before")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device"):
        WRITERS[name](model, tmp_path / name)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", ["model.skevgp", "arm.urdf"])
def test_saving_to_folder_raises(name, model, tmp_path):
    (tmp_path / name).mkdir()
    with pytest.raises(IsADirectoryError, match=rf"Is a directory: '{tmp_path / name}'$"):
        WRITERS[name](model, tmp_path / name)
    assert list(tmp_path.iterdir()) == [tmp_path / name]


def test_folder_missing_is_told_by_the_path_that_was_given(model, tmp_path):
    path = tmp_path / "none" / "model.skevgp"
    with pytest.raises(FileNotFoundError, match=rf"No such file or directory: '{path}'$"):
        save(model, path)


def test_pipe_stays_one(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    read = []
    reader = Thread(target=lambda: read.append(path.read_bytes()))
    reader.start()
    with replacing(path) as file:
        file.write(b"through it")
    reader.join()
    assert read == [b"through it"]
    assert path.is_fifo()
    assert list(tmp_path.iterdir()) == [path]


def test_long_names_are_names(tmp_path):
    path = tmp_path / ("x" * 250)
    with replacing(path) as file:
        file.write(b"data")
    assert path.read_bytes() == b"data"
