"""The double pendulum of the examples, its feedback, and the limits in which both are known."""

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import solve_discrete_are

from skevgp.datasets.plant import Plant

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def own(monkeypatch):
    """The module, with the folder of examples on the path."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield importlib.import_module("double_pendulum")
    for name in ("double_pendulum", "follow_plans"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_accelerations_are_those_of_the_librarys_system(own, robot):
    z = np.random.RandomState(0).uniform(-3.0, 3.0, (50, 4))
    u = np.random.RandomState(1).uniform(-6.0, 6.0, (50, 1))
    found = own.Plants(robot).accelerations(z.T, *own.Plants(robot).torques(u[:, 0]))
    system = own.system(robot, seed=0, error=0.0)
    assert_allclose(np.transpose(found), Plant(system).accelerations(z[:, :2], z[:, 2:], u), rtol=1e-9, atol=1e-9)


def test_energy_is_kept_without_friction_and_lost_with_it(own):
    starts = np.random.RandomState(0).uniform(-2.0, 2.0, (2, 4))
    plants = own.Plants("acrobot", b2=np.array([0.0, 0.1]), cf1=np.array([0.0, 0.1]))
    states, _ = own.simulate_plants(plants, lambda step, Z: np.zeros(2), starts, n_steps=1000)
    energy = plants.energy(np.moveaxis(states, -1, 0))
    assert_allclose(energy[:, 0], energy[0, 0], rtol=1e-6)
    assert energy[-1, 1] < energy[0, 1] - 0.1


def test_disturbances_are_those_asked_for(own):
    """A late measurement, a slow motor and a pulse, each on its own plant."""
    pulses = np.zeros((2, 20, 3))
    pulses[0, 5, 2] = 1.0
    disturbances = own.Disturbances(
        delay=np.array([3, 0, 0]), response=np.array([1.0, 0.5, 1.0]), pulses=pulses, velocity_noise=0.0
    )
    seen = []

    def controller(step, Z):
        seen.append(Z)
        return np.full(len(Z), 1.0)

    states, _ = own.simulate_plants(own.Plants("pendubot"), controller, np.zeros((3, 4)), disturbances, 20)
    usual, _ = own.simulate_plants(own.Plants("pendubot"), controller, np.zeros((1, 4)), n_steps=20)
    seen = np.array(seen[:20])
    assert_allclose(seen[3:, 0], states[:-4, 0])
    assert_allclose(seen[:, 1:], states[:-1, 1:])
    assert_allclose(states[:, 0], usual[:, 0])
    assert_allclose(states[1, 1, 2], 0.5 * usual[1, 0, 2], rtol=1e-6)
    assert_allclose(states[:6, 2], usual[:6, 0])
    assert_allclose(states[6, 2, 2] - states[5, 2, 2], 2.0 * (usual[6, 0, 2] - usual[5, 0, 2]), rtol=0.01)


def test_feedback_at_rest_is_lqr_and_more_cautious_with_doubt(own):
    control = importlib.import_module("follow_plans")
    F = own.Truth(own.Plants("acrobot")).value_and_jacobian(np.append(own.GOAL, 0.0)[np.newaxis])[1]
    Q, R = own.TASK.dt * np.diag(own.TASK.top_state_cost), own.TASK.dt * own.TASK.top_input_cost
    A, B = F[0, :, :4], F[0, :, 4:]
    P = solve_discrete_are(A, B, Q, [[R]])
    lqr = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)[0]
    plans = own.Bunch(Z=np.tile(own.GOAL, (1, 3, 1)), U=np.zeros((1, 2)))
    model = own.Truth(own.Plants("acrobot"))
    certain = control.Library(model, own.TASK, plans.Z, plans.U)
    assert_allclose(certain.top_gain, lqr, rtol=1e-5)
    deviations = np.zeros((2, 4, 5))
    deviations[:, 3, 1] = 0.02, -0.02
    doubtful = control.Library(model, own.TASK, plans.Z, plans.U, deviations)
    assert np.linalg.norm(doubtful.top_gain) > 1.05 * np.linalg.norm(lqr)
    # The expected cost to go of the closed loop is what the Riccati equation says.
    closed = [D[:, :4] + np.outer(D[:, 4], doubtful.top_gain) for D in F[0] + deviations]
    cost = Q + R * np.outer(doubtful.top_gain, doubtful.top_gain)
    cost = cost + np.mean([D.T @ doubtful.top_cost @ D for D in closed], axis=0)
    assert_allclose(doubtful.top_cost, cost, rtol=1e-4, atol=1e-6)
    # No gain is safe against a doubt of this size: half of it, again and again, is taken.
    assert np.isfinite(control.Library(model, own.TASK, plans.Z, plans.U, 1e3 * deviations).top_gain).all()


def test_filtered_rows_are_those_of_the_true_robot(own):
    runs = own.explore("acrobot", 6.0, seed=0)
    rows, truth = own.transitions("acrobot", runs), own.Truth(own.Plants("acrobot"))
    assert rows.data.shape == (len(rows.target), 5)
    assert len(np.unique(rows.groups)) == 6
    errors = np.abs(rows.target - truth.predict(rows.data))
    assert (np.median(errors, axis=0) < [1e-3, 1e-3, 0.02, 0.02]).all()  # noise of 0.05 rad/s before the filter


@pytest.mark.long
@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_the_true_model_swings_up_and_survives_a_delay(own, robot):
    control = importlib.import_module("follow_plans")
    model = own.Truth(own.Plants(robot))
    library = own.controller_of(model, own.plan_swing_ups(model, np.random.RandomState(0)))
    disturbances = replace(own.Disturbances(), delay=np.array([0, 10]), velocity_noise=np.array([0.0, 0.2]))
    follower = control.Follower(library, 2, own.STEP)
    states, _ = own.simulate_plants(own.Plants(robot), follower, np.zeros((2, 4)), disturbances)
    assert own.is_upright(states[-1]).all()
    # A plant alone finds its delay as it does next to others.
    assert follower.delay.tolist() == [0, 10]
    alone = control.Follower(library, 1, own.STEP)
    noisy = replace(own.Disturbances(), delay=np.array([10]), velocity_noise=np.array([0.5]))
    own.simulate_plants(own.Plants(robot), alone, np.zeros((1, 4)), noisy)
    assert alone.delay.tolist() == [10]
