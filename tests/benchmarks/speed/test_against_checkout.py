"""The comparison of two checkouts, of this one with itself."""

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.metrics import negative_log_predictive_density, prediction_error

from ..conftest import BENCHMARKS, read


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning")  # old checkouts know no groups
def test_runs_take_turns_and_tell_what_a_fit_tells(run_script, tmp_path):
    output = tmp_path / "pairs.csv"
    options = ("--quick", "--systems", "pendulum", "--max-iter", "pendulum=3", "--output", output)
    said = run_script("speed/against_checkout.py", BENCHMARKS.parent, *options)
    train, test = (make_dynamics("pendulum", 3, random_state=state) for state in (0, 1000))
    model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, max_iter=3, random_state=0)
    with pytest.warns(ConvergenceWarning):
        model.fit(train.data, train.target)
    mean, std = model.predict(test.data, return_std=True)
    expected = {
        "n_iter": 3,
        "bound": -model.loss_curve_[-1],
        "error": prediction_error(test.target, mean),
        "nlpd": negative_log_predictive_density(test.target, mean, std),
    }
    rows = read(output)
    assert [row["checkout"] for row in rows] == ["this", "other"]
    for row in rows:
        assert {name: float(row[name]) for name in expected} == pytest.approx(expected, rel=1e-6)
        assert "skevgp" in row["versions"]
    assert "| pendulum | 1 | " in said


def test_the_cost_of_an_iteration_is_that_of_a_fit_without_its_start(monkeypatch):
    from speed import checkout_job

    ticks = {"perf_counter": iter([0.0, 3.0, 0.0, 13.0]), "process_time": iter([0.0, 2.0, 0.0, 7.0])}
    monkeypatch.setattr(checkout_job.time, "perf_counter", lambda: next(ticks["perf_counter"]))
    monkeypatch.setattr(checkout_job.time, "process_time", lambda: next(ticks["process_time"]))
    with pytest.warns(ConvergenceWarning):
        result = checkout_job.cost(n_rows=60, n_inducing=3, max_iter=5, seed=0)
    assert (result["n_iter"], result["seconds"], result["cpu_seconds"]) == (5, 2.0, 1.0)


@pytest.mark.long
def test_a_checkout_that_fails_does_not_take_the_other_with_it(run_script, tmp_path, capsys):
    (tmp_path / "skevgp").mkdir()
    (tmp_path / "skevgp" / "__init__.py").touch()
    output = tmp_path / "pairs.csv"
    with pytest.raises(SystemExit, match="1 runs failed"):
        run_script("speed/against_checkout.py", tmp_path, "--quick", "--systems", "pendulum", "--output", output)
    assert "other: failed: ImportError: cannot import name 'EVGPRegressor'" in capsys.readouterr().out
    assert [row["checkout"] for row in read(output)] == ["this"]


def test_ratios_are_of_pairs():
    from speed.against_checkout import MEASURES, comparison

    def row(checkout, seed, seconds, error="0.5"):
        numbers = {**dict.fromkeys(MEASURES, "1"), "seconds": seconds, "cpu_seconds": seconds, "error": error}
        return {"job": "pendulum", "checkout": checkout, "seed": seed, "repeat": "0", **numbers}

    this = [row("this", "0", "2", "0.1"), row("this", "1", "30", "0.3"), row("this", "2", "5")]
    other = [row("other", "1", "10"), row("other", "0", "4"), row("other", "3", "7")]
    line = comparison([*this, *other]).splitlines()[-1]
    # Seeds 0 and 1 have both: 2 / 4 and 30 / 10.
    assert line.startswith(f"| pendulum | 2 | 16.0 / 7.00 | {np.median([0.5, 3.0]):.3f} |")
    assert "| 0.200 / 0.500 |" in line


@pytest.mark.parametrize(
    ("options", "named"),
    [(("nowhere",), "argument other: "), ((BENCHMARKS.parent, "--max-iter", "moon=3"), "'moon=3' must be SYSTEM=N")],
)
def test_wrong_options_are_named(run_script, capsys, options, named):
    with pytest.raises(SystemExit):
        run_script("speed/against_checkout.py", *options)
    assert named in capsys.readouterr().err
