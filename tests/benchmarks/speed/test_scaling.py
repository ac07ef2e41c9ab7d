"""The benchmark of time and memory over rows, with few of them."""

import numpy as np
import pytest

from skevgp import EVGPRegressor


@pytest.mark.parametrize("engine", ["1 thread", "2 threads"])
def test_a_cell_is_a_fit_of_a_file(tmp_path, engine):
    from speed import scaling

    row = scaling.run(scaling.Cell(300, engine, 4, tmp_path))
    X, y = (np.load(tmp_path / f"{name}300.npy") for name in "Xy")
    assert X.shape == (300, 8)
    assert row["n_evaluations"] >= 4
    with pytest.warns(UserWarning, match="max_iter"):
        model = EVGPRegressor(max_iter=4, noise_cv=None, random_state=0).fit(X, y)
    assert row["noise_sd"] == pytest.approx(np.sqrt(model.noise_variance_), rel=1e-9)
    assert not row["converged"]


def test_rows_of_a_larger_file_go_on(tmp_path, monkeypatch):
    from speed import scaling

    monkeypatch.setattr(scaling, "CHUNK", 7)
    paths = scaling.make_files(tmp_path, 20)
    X, y = (np.load(path) for path in paths)
    assert len(np.unique(X[:, 0])) == len(np.unique(y)) == 20
