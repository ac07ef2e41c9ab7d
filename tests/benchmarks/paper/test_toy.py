"""The benchmark of the paper's Figure 5 in short mode."""

import numpy as np
import pytest
from matplotlib import pyplot
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor
from skevgp.datasets import make_toy

from ..conftest import read


@pytest.fixture
def run(run_script, tmp_path):
    def run(*arguments):
        options = ("--quick", "--jobs", 1, "--output", tmp_path / "toy.csv")
        return run_script("paper/toy.py", *options, *arguments)

    return run


@pytest.mark.long
def test_it_runs_and_resumes(run, tmp_path):
    table, page, picture = (tmp_path / f"toy.{suffix}" for suffix in ("csv", "md", "png"))
    assert "[4/4] toy" in run("--data", "toy")
    rows = {row["model"]: row for row in read(table)}
    assert set(rows) == {"GP", "VGP", "EGP", "EVGP"}

    toy = make_toy(random_state=0)
    model = EVGPRegressor(PolynomialFeatures(1), n_inducing=10, noise_cv=None, random_state=0).fit(toy.data, toy.target)
    mean, std = model.predict([[9.0]], return_std=True)
    expected = {
        "log_likelihood_or_bound": model.lower_bound_,
        "signal_std": np.sqrt(model.kernel_.k1.constant_value),
        "noise_std": np.sqrt(model.noise_variance_),
        "intercept": model.coef_[0],
        "slope": model.coef_[1],
        "slope_std": model.coef_std_[1],
        "far_mean": mean[0],
        "far_std": std[0],
        "rmse_of_truth": np.sqrt(np.mean((toy.mean - model.predict(toy.data)) ** 2)),
    }
    for name, value in expected.items():
        assert float(rows["EVGP"][name]) == pytest.approx(value, rel=1e-6), name
    for name, exact in (("VGP", "GP"), ("EVGP", "EGP")):
        sparse, full = (float(rows[other]["log_likelihood_or_bound"]) for other in (name, exact))
        assert full - 10.0 < sparse < full
        assert np.isnan(float(rows[name]["slope"])) == (name == "VGP")
    assert all(1.5 < float(row["rmse"]) < 2.5 for row in rows.values())  # the noise has 1.7

    text = page.read_text()
    assert "make_toy" in text
    assert "A quick run" in text
    assert f"{mean[0]:.2f} ± {std[0]:.2f}" in text
    assert picture.stat().st_size > 10_000

    before = table.read_text()
    assert "4 of 4 cells" in run("--systems", "toy", "toy")
    assert table.read_text() == before


@pytest.mark.long
def test_without_snelsons_points_those_of_make_toy_are_taken(run, tmp_path, monkeypatch):
    import harness
    from skevgp.datasets import snelson

    monkeypatch.setattr(snelson, "_ADDRESS", (tmp_path / "moved.tgz").as_uri())
    monkeypatch.setattr(harness, "run_missing", lambda cells, *_, **__: print({cell.data for cell in cells}) or 0)
    home = ("--data-home", tmp_path / "home")
    said = run(*home)
    assert "could not be fetched" in said
    assert "{'toy'}" in said
    with pytest.raises(SystemExit, match="could not be fetched"):
        run("--data", "snelson", *home)


@pytest.mark.long
def test_a_panel_shows_data_inducing_points_and_line(tmp_path, monkeypatch):
    from paper import toy

    data = make_toy(30, random_state=0)
    models = {
        name: toy.build(toy.Cell("toy", name, 0, "quick", None)).set_params(**limit).fit(data.data, data.target)
        for name, limit in (
            ("GP", {"optimizer": None}),
            ("VGP", {"max_iter": 0}),
            ("EGP", {"max_iter": 0}),
            ("EVGP", {"max_iter": 0}),
        )
    }
    displays = toy.plot(models, data, "title", tmp_path / "toy.png")
    assert not pyplot.get_fignums()
    for name, display in displays.items():
        lines = {line.get_label(): line for line in display.ax_.lines}
        np.testing.assert_array_equal(lines["training data"].get_xdata(), data.data[:, 0])
        assert ("inducing points" in lines) == (name in {"VGP", "EVGP"})
        straight = lines["explicit part: h(x)ᵀb, or 0"].get_ydata()
        line = models[name].coef_ if name in {"EGP", "EVGP"} else (0.0, 0.0)
        np.testing.assert_allclose(straight, line[0] + line[1] * toy.GRID[:, 0], rtol=1e-12)
    limits = {(display.ax_.get_xlim(), display.ax_.get_ylim()) for display in displays.values()}
    assert len(limits) == 1


def test_seeds_of_make_toy_are_other_points():
    from paper import toy

    first, second = (toy.load(toy.Cell("toy", "GP", seed, "quick", None)) for seed in (0, 1))
    assert (first.data != second.data).all()
