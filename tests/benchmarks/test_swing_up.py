"""The benchmark of swing-ups: a row per run, resumable, successes of so many seeds; and its planner."""

import numpy as np
import pytest

from skevgp.solvers import LBFGS

from .conftest import BENCHMARKS, read


@pytest.fixture
def swing_up(benchmarks, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS.parent / "examples"))
    import swing_up

    return swing_up


@pytest.mark.long
def test_it_runs_resumes_and_writes_its_page(run_script, tmp_path):
    output = tmp_path / "swing_up.csv"
    run_script("swing_up.py", "--quick", "--jobs", "1", "--output", output)
    rows = read(output)
    assert {(row["model"], row["success"]) for row in rows} == {("evgp-ifg", "True"), ("gp", "True")}
    assert all(float(row["last_distance"]) < 0.1 and float(row["upright_from"]) < 4.0 for row in rows)
    assert "| pendulum, EVGP-IFG | 0% | 10 | 1 of 1 |" in output.with_suffix(".md").read_text()
    assert "2 of 2 cells are in" in run_script("swing_up.py", "--quick", "--jobs", "1", "--output", output)


def test_successes_are_counted(swing_up):
    rows = [
        {"system": "cartpole", "model": model, "noise": "0.0", "length": length, "seconds": seconds, "success": success}
        | {"upright_from": "2.0" if success == "True" else "5.01", "control_seconds": "4.0"}
        for model, length, seconds, success in [
            ("evgp-ifg", "10", "4.5", "True"),
            ("evgp-ifg", "10", "4.5", "False"),
            ("evgp-ifg", "10", "30.0", "True"),
            ("gp", "25", "4.5", "False"),
            ("truth", "0", "0.0", "True"),
        ]
    ]
    assert swing_up.lines(rows) == [
        ["cartpole, EVGP-IFG", "0%", "10", "1 of 2", "1 of 1", "2.00", "4.0"],
        ["cartpole, without physics", "0%", "25", "0 of 1", "", "", "4.0"],
        ["cartpole, the truth", "0%", "", "1 of 1", "1 of 1", "2.00", "4.0"],
    ]


@pytest.mark.parametrize("system", ["pendulum", "cartpole"])
def test_a_firm_prior_doubts_forces_and_gravity_only(swing_up, system):
    prior = swing_up.firm(system)
    mean, scale = prior["coef_prior"].mean, prior["coef_prior"].scale
    n_states = len(mean)
    kinematics = mean[:, :n_states]
    assert scale[:, :n_states].max() < 0.05 < scale[:, n_states:].min()
    half = n_states // 2
    np.testing.assert_allclose(kinematics, np.eye(n_states) + swing_up.mpc.DT * np.eye(n_states, k=half), atol=1e-12)
    learned = swing_up.mpc.learn(system, 1.5, True, 0.01, **prior, n_inducing=5, solver=LBFGS(tol=1e6))
    assert (np.abs(learned.model.coef_ - mean) < 4.0 * scale)[:, :n_states].all()


def test_the_truth_is_what_is_simulated(swing_up):
    from skevgp.datasets import make_dynamics

    data = make_dynamics("cartpole", 3, 5, random_state=0)
    truth = swing_up.Truth("cartpole")
    np.testing.assert_allclose(truth.predict(data.data), data.target, rtol=0, atol=1e-4)
    mean, slopes = truth.value_and_jacobian(data.data)
    step = np.array([0.0, 1e-3, 0.0, 1e-3, 0.1])
    np.testing.assert_allclose(truth.predict(data.data + step), mean + slopes @ step, rtol=0, atol=1e-5)


@pytest.mark.parametrize("caution", [0.0, 10.0])
def test_plans_keep_the_limit_and_become_cheaper(swing_up, caution):
    """A step of iLQR never makes a plan worse, and what the planner keeps is where the model says it leads."""
    from dataclasses import replace

    task = replace(swing_up.mpc.TASKS["pendulum"], horizon=20, caution=caution)
    model = swing_up.mpc.learn("pendulum", 1.5, True, n_inducing=20, solver=LBFGS(tol=10.0)).model.compile(
        include_noise=False
    )
    planner = swing_up.mpc.Planner(model, task)
    z = np.array([0.3, -0.2])
    planner.start(z, np.random.RandomState(0), n_starts=1, n_iter=0)
    costs = [planner.cost]
    for _ in range(5):
        planner.improve(z, n_iter=1)
        costs.append(planner.cost)
    assert costs[-1] < costs[0]
    assert (np.diff(costs) <= 1e-9 * costs[0]).all()
    assert np.abs(planner.U).max() == pytest.approx(task.limit)
    rows = np.hstack([planner.Z[:-1], planner.U])
    np.testing.assert_allclose(model.predict(rows), planner.Z[1:], rtol=0, atol=1e-9)
