"""The benchmark of tracking: rows per arm, resumable, its tables; and the arm that it simulates."""

import numpy as np
import pytest

from .conftest import BENCHMARKS, read


@pytest.fixture
def tracking(benchmarks, monkeypatch):
    pytest.importorskip("pinocchio")
    monkeypatch.syspath_prepend(str(BENCHMARKS.parent / "examples"))
    import tracking

    return tracking


@pytest.mark.long
def test_it_runs_resumes_and_writes_its_page(tracking, run_script, tmp_path):
    output = tmp_path / "tracking.csv"
    run_script("tracking.py", "--quick", "--output", output)
    rows = read(output)
    for case in tracking.CASES:
        nominal, weights, both = (
            tracking.values(rows, "error", model, case) for model in (tracking.NOMINAL, tracking.WEIGHTS, tracking.BOTH)
        )
        assert both < weights < 0.5 * nominal
    broken = [tracking.values(rows, "broken", tracking.BOTH, case) for case in ("mean", "Boole")]
    assert broken[1] < broken[0]
    assert "| + learned weights and GP |" in output.with_suffix(".md").read_text()
    assert "1 of 1 cells are in" in run_script("tracking.py", "--quick", "--output", output)


def a_row(measure, model, case, value, payload="2.0"):
    return {"payload": payload, "seed": "0", "measure": measure, "model": model, "case": case, "value": str(value)}


def test_ratios_are_of_the_same_arm_and_run(tracking):
    errors = dict.fromkeys(tracking.NAMES, (9.0, 9.0))
    errors |= {tracking.NOMINAL: (10.0, 40.0), tracking.BOTH: (1.0, 2.0)}
    rows = [
        a_row("error", model, case, value, payload)
        for model, both in errors.items()
        for payload, value in zip(("2.0", "5.0"), both, strict=True)
        for case in tracking.CASES
    ]
    costs = [("step", tracking.NOMINAL, "ahead", 8.0), ("step", tracking.BOTH, "ahead", 10.0)]
    costs += [("batch", tracking.BOTH, "per row", 20.0), ("step", tracking.BOTH, "in the loop", 80.0)]
    rows += [a_row(*cost) for cost in costs]
    lines = {line[0]: line[1:] for line in tracking.error_lines(rows)}
    assert lines["+ learned weights and GP"] == ["1.50", "1.50", "1.50", "0.075 (0.050 to 0.100)"]
    lines = {line[0]: line[1:] for line in tracking.payload_lines(rows)}
    assert lines["PD + nominal model"] == ["10.0", "40.0"]
    lines = {line[0]: line[1:] for line in tracking.cost_lines(rows)}
    assert lines["+ learned weights and GP"] == ["10.0", "1.25", "20.0", "80.0", "10.00"]
    assert lines["PD + nominal model"] == ["8.00", "1.00", "", "", ""]


def test_moves_of_all_arms_count_together(tracking):
    rows = []
    for payload, n, broken in (("2.0", 10, 4), ("5.0", 30, 6), ("1.0", 0, None)):
        rows.append(a_row("moves", tracking.BOTH, "mean", n, payload))
        if n:
            found = {"broken": broken, "broken where tightest": 2, "broken as logged": 1, "moves as logged": 5}
            found |= {"duration": n / 10.0, "within 2 std": 0.95}
            rows += [a_row(measure, tracking.BOTH, "mean", value, payload) for measure, value in found.items()]
    assert tracking.limit_lines(rows)[0] == [
        "mean",
        "40",
        "25.0%",
        "10.0%",
        "20.0% of 10",
        "50 % where tightest",
        "2.50",
        "0.950",
    ]
    assert tracking.limit_lines(rows)[2][:2] == ["Boole", "0"]


def test_a_page_of_nothing_is_nothing(tracking):
    assert tracking.paragraphs([]) == []


def test_the_arm_that_is_known_is_tracked(tracking):
    """With a model of the true inertias, and the friction along the reference, errors are those of time steps."""
    arms = tracking.arms
    arm, reference = arms.make_arm(3.0, 0), arms.waves(2, 0.5, 0)
    q, v, a = np.split(reference.reshape(-1, 21), 3, axis=1)
    friction = arm.friction(v, arm.body.forces(q, v, a)).reshape(*reference.shape[:2], 7)
    known = arms.track(arm, tracking.ComputedTorque(arm.body, reference, friction), 0)
    unknown = arms.track(arm, tracking.ComputedTorque(arm.body, reference), 0)
    assert np.abs(known.error).max() < 0.3 * np.abs(unknown.error).max()
    # What was measured is what the arm's equation says of the motion, to the sensors' noise and the length of a step.
    q, v, a = np.split(unknown.motion.reshape(-1, 21), 3, axis=1)
    torque = unknown.torque.reshape(-1, 7)
    off = torque - arm.body.forces(q, v, a) - arm.friction(v, torque)
    fast = np.abs(v) > 0.2
    assert (np.abs(off) < 6.0 * arm.noise)[fast].mean() > 0.99
    X, y, groups = arms.log_of(unknown)
    assert X.shape == (50, 21)
    assert y.shape == (50, 7)
    np.testing.assert_array_equal(np.bincount(groups), [25, 25])
    np.testing.assert_array_equal(X[25], unknown.motion[0, 1])


def test_references_are_consistent_and_what_is_missed_may_be_a_function(tracking):
    arms = tracking.arms
    starts, ends = arms.positions(3, 0)
    for path in (arms.waves(3, 1.0, 1), arms.moves(starts, ends, np.array([0.5, 0.7, 0.9]), 1.0)):
        q, v, a = np.split(path, 3, axis=2)
        np.testing.assert_allclose((q[2:] - q[:-2]) / (2.0 * arms.DT), v[1:-1], rtol=0, atol=5e-3)
        np.testing.assert_allclose((v[2:] - v[:-2]) / (2.0 * arms.DT), a[1:-1], rtol=0, atol=0.5)
    body = tracking.RigidBody(tracking.load_robot("iiwa14"))
    known = tracking.ComputedTorque(body, path, 2.0 * path[:, :, :7])
    asked = tracking.ComputedTorque(body, path, lambda wanted: 2.0 * wanted[:, :7])
    state = path[3, :, :7] + 0.1, path[3, :, 7:14]
    np.testing.assert_array_equal(known(3, *state), asked(3, *state))


def test_the_fastest_moves_are_those_at_the_limit(tracking):
    """By a model whose torques are the accelerations of unit masses, with a known std."""

    class Unit:
        def predict(self, X, return_std):
            return X[:, 14:], np.full((len(X), 7), 0.1)

    starts, ends = np.zeros((3, 7)), np.diag([1.0, 0.5, 2.0, 0.0, 0.0, 0.0, 0.0])[:3]
    limits = np.full(7, 2.0)
    durations, decided = tracking.arms.fastest(Unit(), starts, ends, limits, k=5.0)
    peak = 10.0 / np.sqrt(3.0)  # of the acceleration of a unit move in a unit of time
    np.testing.assert_allclose(durations, np.sqrt(peak * np.array([1.0, 0.5, 2.0]) / 1.5), rtol=0.01)
    assert decided.all()
    assert not tracking.arms.fastest(Unit(), starts, ends, 1000.0 * limits, k=5.0)[1].any()  # the speed decides
    assert not tracking.arms.fastest(Unit(), starts, ends, 0.2 * limits, k=5.0)[1].any()  # it cannot even stand


def test_the_caution_of_a_move_is_booles(tracking):
    from scipy.stats import norm

    k = tracking.arms.cautious(0.95, 7, 400)
    assert 7 * 400 * norm.sf(k) == pytest.approx(0.05)
