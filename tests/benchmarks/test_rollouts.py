"""The benchmark of many steps ahead: resumable, all ways of a fit in its CSV, scores that are right."""

import numpy as np
import pytest
from scipy.stats import norm
from sklearn.utils import Bunch

from skevgp import EVGPRegressor, rollout

from .conftest import read


@pytest.fixture
def rollouts(benchmarks):
    import rollouts

    return rollouts


def test_it_runs_resumes_and_writes_its_page(run_script, tmp_path):
    output = tmp_path / "rollouts.csv"
    arguments = ("--quick", "--models", "EVGP-IFG", "RES-VGP", "RES-DBNN", "--jobs", "1", "--output", output)
    run_script("rollouts.py", *arguments)
    rows = read(output)
    models = {("EVGP-IFG", "10"), ("RES-VGP", "40"), ("RES-DBNN", "0")}
    assert {(row["model"], row["n_inducing"]) for row in rows} == models
    assert {(row["noise"], row["share"]) for row in rows} == {(a, b) for a in ("0.0", "0.01") for b in ("1", "0.1")}
    of_one = [row for row in rows if (row["model"], row["noise"], row["share"]) == ("EVGP-IFG", "0.0", "1")]
    assert len({(row["method"], row["steps"]) for row in of_one}) == len(of_one) == 5 * 4
    assert {row["method"] for row in rows if row["model"] == "RES-DBNN"} == {"independent", "mean"}
    # What has no noise to draw has less of a band.
    first = {row["method"]: float(row["errors_in_std"]) for row in of_one if row["steps"] == "1"}
    assert first["consistent, no noise"] > first["consistent"]
    page = output.with_suffix(".md").read_text()
    assert "| pendulum m=10 | EVGP-IFG | none | 1 | consistent, no noise |" in page
    assert "| pendulum m=40 | RES-VGP | 1 % | 0.1 | consistent |" in page
    assert "| pendulum | RES-DBNN | 1 % | 0.1 | independent |" in page
    assert "| 1 % | 0.1 | consistent | CR-2 from 0.9 to 0.99 |" in page
    assert "12 of 12 cells are in" in run_script("rollouts.py", *arguments)


def test_scores_of_samples_are_those_of_their_distribution(rollouts):
    rng = np.random.RandomState(0)
    truth, mean, std = rng.randn(3), rng.randn(3), rng.uniform(0.5, 2.0, 3)
    exact = rollouts.crps_of_normal(truth, mean, std)
    assert rollouts.crps_of_samples(truth, mean + std * rng.randn(40_000, 3)) == pytest.approx(exact, rel=0.05)
    # The integral of (F(x) - 1{x >= y})², its definition.
    x = np.linspace(-20.0, 20.0, 40_001)[:, np.newaxis]
    integral = np.sum((norm.cdf(x, mean, std) - (x >= truth)) ** 2, axis=0) * (x[1] - x[0])
    assert exact == pytest.approx(integral, rel=1e-3)


def test_few_samples_score_as_many_on_average(rollouts):
    samples = np.random.RandomState(0).randn(4, 20_000)
    expected = rollouts.crps_of_normal(np.array([0.3]), np.zeros(1), np.ones(1))[0]
    assert rollouts.crps_of_samples(0.3, samples).mean() == pytest.approx(expected, rel=0.03)


def test_errors_are_of_positions_in_units_of_their_scatter(rollouts):
    scatter = np.array([2.0, 4.0, 1.0, 1.0])
    truth = np.zeros((5, 3, 4))
    mean, std = truth.copy(), np.ones_like(truth)
    mean[:, 1] = [2.0, 4.0, 100.0, -1.5]
    found = rollouts.measures(truth, Bunch(mean=mean, std=std), 2, scatter)
    assert found["error_median"] == pytest.approx(1.0)
    assert [found[f"cr{k}"] for k in (1, 2, 3)] == [0.0, 0.5, 0.5]
    assert rollouts.measures(truth, Bunch(mean=mean, std=std), 1, scatter)["error_p90"] == 0.0


def test_an_independent_regressor_hides_its_functions(rollouts):
    X = np.random.RandomState(0).randn(40, 2)
    model = EVGPRegressor(n_inducing=5, max_iter=0, random_state=0).fit(X, X[:, :1])
    hidden = rollouts.Independent(model)
    assert not hasattr(hidden, "_functions")
    np.testing.assert_array_equal(hidden.predict(X, return_std=True), model.predict(X, return_std=True))
    ahead = rollout(hidden, X[0, :1], X[:3, 1:], n_samples=4, random_state=0)
    assert ahead.samples.shape == (4, 3, 1)


@pytest.mark.long
def test_the_arm_is_tested_on_slower_moves(rollouts):
    train, test = rollouts.data(rollouts.Cell("iiwa14", "EVGP-IFG", 350, "0.0", "0.1", 0, "quick", 0))
    assert train.data.shape == (6 * 50, 21)
    assert test.trajectories.shape == (4, 101, 14)


def test_what_runs_away_covers_nothing(rollouts, monkeypatch):
    def unstable(*arguments, **options):
        raise ValueError("States grow beyond 1e+100 at step 3: the learned system is unstable.")

    monkeypatch.setattr(rollouts, "rollout", unstable)
    truth = np.zeros((2, 4, 2))
    test = Bunch(trajectories=np.zeros((2, 5, 2)), data=np.zeros((8, 3)), target=np.zeros((8, 2)))
    cell = rollouts.Cell("pendulum", "EVGP-IFG", 10, "0.0", "1", 0, "quick", 0)
    ahead, _ = rollouts.rolled_out(None, "consistent", test, cell)
    found = rollouts.measures(truth, ahead, 4, np.ones(2))
    assert found["cr3"] == 0.0
    assert np.isnan(found["error_median"])
