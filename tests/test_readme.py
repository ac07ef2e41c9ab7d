"""What the README says works as it stands."""

import re
import shutil
from pathlib import Path

import dask.array as dask_array
import numpy as np
import pytest

from skevgp.features import RigidBodyRegressor
from skevgp.robots.loading import urdf_path

from .test_inverse_dynamics import trajectory

README = (Path(__file__).parents[1] / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.long
def test_toy_and_the_pendulum_run():
    for snippet in SNIPPETS[:2]:
        names = {}
        exec(snippet, names)
        assert names["mean"].shape == names["std"].shape
        X, y = (names["test"].data, names["test"].target) if "test" in names else (names["X"], names["y"])
        assert names["model"].score(X, y) > 0.95


def test_any_robot_runs():
    """With fewer moves."""
    names = {}
    exec(SNIPPETS[2].replace('"ur5", 60', '"ur5", 10').replace("n_inducing=30", "n_inducing=10"), names)
    assert names["train"].data.shape == (500, 18)
    assert names["model"].score(names["train"].data, names["train"].target) > 0.99


@pytest.mark.long
def test_real_arm_runs(tmp_path, monkeypatch, capsys):
    """On logs of a simulated one."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(urdf_path("ur10"), "arm.urdf")
    body = RigidBodyRegressor("ur10", friction=["coulomb"])
    gains = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])
    for seed, name in enumerate(["first.csv", "second.csv", "third.csv"]):
        X = trajectory(6, seed, dt=0.01)
        weights = body.fit(X).coef_prior(6)[0]
        weights[60:] = 3.0
        torque = body.transform(X) @ weights
        torque += 0.02 * torque.std(axis=0) * np.random.default_rng(seed).normal(size=torque.shape)
        time = 0.01 * np.arange(len(X))
        np.savetxt(name, np.column_stack([time, X[:, :12], torque / gains]), delimiter=",")
    names = {}
    exec(SNIPPETS[3], names)
    assert names["model"].score(names["log"].data, names["log"].target) > 0.98
    assert "wrist_3_joint" in capsys.readouterr().out
    assert (tmp_path / "identified.urdf").stat().st_size > 1000


@pytest.mark.long
def test_control_runs():
    names = {}
    exec(SNIPPETS[4], names)
    assert names["ahead"].mean.shape == (50, 4)
    assert names["A_B"].shape == (50, 4, 5)
    assert names["mean"].shape == names["std"].shape == (4,)


@pytest.mark.long
def test_files_and_chunks_run_as_written(tmp_path, monkeypatch):
    """With a threaded scheduler in place of the cluster, and stored arrays in place of Zarr's."""
    files, chunks = SNIPPETS[5:]
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
