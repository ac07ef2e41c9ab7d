"""What the README says works as it stands."""

import re
from pathlib import Path

import dask.array as dask_array
import numpy as np
import pytest

README = (Path(__file__).parents[1] / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.slow
def test_the_toy_and_the_pendulum_run():
    for snippet in SNIPPETS[:2]:
        names = {}
        exec(snippet, names)
        assert names["mean"].shape == names["std"].shape
        X, y = (names["test"].data, names["test"].target) if "test" in names else (names["X"], names["y"])
        assert names["model"].score(X, y) > 0.95


def test_any_robot_runs():
    """With fewer moves."""
    names = {}
    exec(SNIPPETS[2].replace('"ur5", 60', '"ur5", 10').replace("n_inducing=30", "n_inducing=5"), names)
    assert names["train"].data.shape == (500, 18)
    assert names["model"].score(names["train"].data, names["train"].target) > 0.99


@pytest.mark.slow
def test_control_runs():
    names = {}
    exec(SNIPPETS[3], names)
    assert names["ahead"].mean.shape == (50, 4)
    assert names["A_B"].shape == (50, 4, 5)
    assert names["mean"].shape == names["std"].shape == (4,)


@pytest.mark.slow
def test_files_and_chunks_run_as_written(tmp_path, monkeypatch):
    """With a threaded scheduler in place of the cluster, and stored arrays in place of Zarr's."""
    files, chunks = SNIPPETS[4:]
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (500, 2))
    np.save(tmp_path / "X.npy", X)
    np.save(tmp_path / "y.npy", np.sin(X[:, 0]) + 0.1 * rng.randn(500))
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(files, names)
    assert names["model"].score(names["X"], names["y"]) > 0.95
    chunks = chunks.replace('client = Client("tcp://host:8786")', "client = None")
    stored = {name: dask_array.from_array(np.load(name.replace("zarr", "npy")), 250) for name in ("X.zarr", "y.zarr")}
    monkeypatch.setattr(dask_array, "from_zarr", lambda name: stored[name].rechunk({0: 250}))
    exec(chunks, names)
    np.testing.assert_allclose(names["mean"].compute(), names["model"].predict(X))
    assert names["std"].shape == (500,)


@pytest.mark.parametrize("name", ["main", "test"])
def test_there_is_one_command_line_for_each_job(name):
    commands = re.findall(rf"<!-- command: {name} -->\n```bash\n(.*?)\n```", README, flags=re.DOTALL)
    assert len(commands) == 1
    assert "\n" not in commands[0]
    assert commands[0].startswith("python3 -m venv .venv && .venv/bin/pip install ")


def test_links_and_pictures_exist():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (Path(__file__).parents[1] / target).exists(), target
