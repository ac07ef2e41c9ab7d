from functools import partial
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

from skevgp.datasets import ComputedTorqueController, simulate
from skevgp.datasets.plant import Plant
from skevgp.robots import SYSTEMS, layout_of, load_robot

G = 9.81
DT = 0.03
REFERENCE = Path(__file__).parents[1] / "data"


def pendulum(q, v, u):
    """m l² q̈ + b q̇ + m g l sin q = u."""
    mass, length, damping = 1.0, 0.5, 0.1
    torque = u[:, 0] - damping * v[:, 0] - mass * G * length * np.sin(q[:, 0])
    return (torque / (mass * length**2))[:, np.newaxis]


def cartpole(q, v, u, damping=0.0):
    """M(θ) [ẍ, θ̈] = [u + m l s θ̇² - b ẋ, -m g l s - b θ̇], a force on the cart."""
    cart, mass, length = 10.0, 1.0, 0.5
    sine, cosine = np.sin(q[:, 1]), np.cos(q[:, 1])
    M = np.empty((len(q), 2, 2))
    M[:, 0, 0] = cart + mass
    M[:, 0, 1] = M[:, 1, 0] = mass * length * cosine
    M[:, 1, 1] = mass * length**2
    force = np.column_stack([u[:, 0] + mass * length * sine * v[:, 1] ** 2, -mass * G * length * sine]) - damping * v
    return np.linalg.solve(M, force[:, :, np.newaxis])[:, :, 0]


def acrobot(q, v, u):
    """Spong's acrobot: relative elbow angle, a torque on the elbow, viscous damping on both joints."""
    m1, m2, l1, com1, com2, damping = 1.0, 1.0, 1.0, 0.5, 1.0, 0.1
    J1, J2 = 0.083 + m1 * com1**2, 0.33 + m2 * com2**2
    coupling, s2 = m2 * l1 * com2, np.sin(q[:, 1])
    c2 = np.cos(q[:, 1])
    M = np.empty((len(q), 2, 2))
    M[:, 0, 0] = J1 + J2 + m2 * l1**2 + 2.0 * coupling * c2
    M[:, 0, 1] = M[:, 1, 0] = J2 + coupling * c2
    M[:, 1, 1] = J2
    tip = m2 * G * com2 * np.sin(q[:, 0] + q[:, 1])
    shoulder = G * (m1 * com1 + m2 * l1) * np.sin(q[:, 0]) + tip
    force = np.column_stack(
        [
            coupling * s2 * (2.0 * v[:, 0] * v[:, 1] + v[:, 1] ** 2) - shoulder - damping * v[:, 0],
            u[:, 0] - coupling * s2 * v[:, 0] ** 2 - tip - damping * v[:, 1],
        ]
    )
    return np.linalg.solve(M, force[:, :, np.newaxis])[:, :, 0]


CLOSED_FORM = {
    "pendulum": pendulum,
    "cartpole": cartpole,
    "cartpole_damped": partial(cartpole, damping=0.1),
    "acrobot": acrobot,
}
INPUT_SCALE = {"pendulum": 1.0, "cartpole": 100.0, "cartpole_damped": 100.0, "acrobot": 0.5}
STORED = sorted(set(SYSTEMS) - {"cartpole_damped"})


def random_states(name, n_states, seed):
    rng = np.random.default_rng(seed)
    n = layout_of(name).n_joints
    q, v = rng.uniform(-np.pi, np.pi, (n_states, n)), rng.uniform(-3.0, 3.0, (n_states, n))
    return q, v, INPUT_SCALE[name] * rng.standard_normal((n_states, 1))


def assert_accelerations(actual, expected):
    assert_allclose(actual, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("name", CLOSED_FORM)
def test_accelerations_equal_the_closed_form(name):
    q, v, u = random_states(name, 100, seed=0)
    assert_accelerations(Plant(name).accelerations(q, v, u), CLOSED_FORM[name](q, v, u))


@pytest.mark.parametrize("name", STORED)
def test_one_step_equals_the_stored_reference(name):
    stored = np.load(REFERENCE / f"{name}.npz")
    before = stored["Z"][:, :-1].reshape(-1, stored["Z"].shape[2])
    after = stored["Z"][:, 1:].reshape(before.shape)
    U = stored["U"].reshape(len(before), 1, -1)
    assert_allclose(simulate(name, before, U, float(stored["dt"]))[:, 1], after, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", STORED)
def test_accelerations_equal_the_stored_reference(name):
    stored = np.load(REFERENCE / f"{name}.npz")
    accelerations = Plant(name).accelerations(stored["acc_q"], stored["acc_v"], stored["acc_u"])
    assert_accelerations(accelerations, stored["acc_qddot"])


@pytest.mark.parametrize(
    ("name", "z0"),
    [
        ("pendulum", [2.5, 0.4]),
        ("cartpole", [0.2, 2.5, 0.3, -0.4]),
        ("acrobot", [2.5, 0.5, 0.3, -0.4]),
        ("iiwa14", [0.4, 0.9, -0.3, 1.2, 0.5, -0.7, 0.2] + [0.1] * 7),
    ],
)
def test_without_damping_and_inputs_energy_is_kept(name, z0):
    model = load_robot(name)
    model.damping = np.zeros(model.nv)
    data, n = model.createData(), model.nv
    Z = simulate(model, z0, np.zeros((50, layout_of(model).n_inputs)))
    rotors = 0.5 * Z[:, n:] ** 2 @ model.armature  # Pinocchio's energy leaves them out
    links = [pinocchio.computeKineticEnergy(model, data, z[:n], z[n:]) for z in Z]
    potential = np.array([pinocchio.computePotentialEnergy(model, data, z[:n]) for z in Z])
    kinetic = np.array(links) + rotors
    assert min(np.ptp(kinetic), np.ptp(potential)) > 1.0
    assert np.ptp(kinetic + potential) < 1e-6 * min(np.ptp(kinetic), np.ptp(potential))


ZEROS = np.zeros((3, 1))


def test_controller_acts_like_the_inputs_it_gives():
    z0, U = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 4)), np.random.default_rng(1).standard_normal((3, 5, 1))
    assert_array_equal(simulate("acrobot", z0, lambda step, Z: U[:, step], n_steps=5), simulate("acrobot", z0, U))


def test_motors_give_no_more_than_their_limits():
    effort = load_robot("iiwa14").upperEffortLimit
    U = np.random.default_rng(0).uniform(-2.0, 2.0, (2, 3, 7)) * effort
    clipped = np.clip(U, -effort, effort)
    z0 = np.zeros((2, 14))
    Z, acted = simulate("iiwa14", z0, U, return_inputs=True)
    assert_array_equal(acted, clipped)
    assert_array_equal(Z, simulate("iiwa14", z0, clipped))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pendulum", [0.0], ZEROS), r"z0 must have 2 columns .*'pendulum'.* \(1,\)"),
        (("cartpole", [[0.0, 0.0]], ZEROS[np.newaxis]), r"z0 must have 4 columns .*'cartpole'.* \(1, 2\)"),
        (("pendulum", np.zeros((1, 1, 2)), ZEROS), r"z0 must have 2 columns .* \(1, 1, 2\)"),
        (("pendulum", [0.0, 0.0], np.zeros((3, 2))), r"U must have the shape \(n_steps, 1\).* \(3, 2\)"),
        (("pendulum", [0.0, 0.0], np.zeros(3)), r"U must have the shape \(n_steps, 1\).* \(3,\)"),
        (("pendulum", np.zeros((2, 2)), ZEROS), r"U must have the shape \(2, n_steps, 1\).* \(3, 1\)"),
        (("pendulum", np.zeros((2, 2)), np.zeros((3, 3, 1))), r"U must have the shape \(2, n_steps, 1\)"),
        (("pendulum", [np.nan, 0.0], ZEROS), "z0 and U must be finite"),
        (("pendulum", [0.0, 0.0], ZEROS + np.inf), "z0 and U must be finite"),
        (("pendulum", [0.0, 0.0], ZEROS, 0.0), "dt must be .*0.0"),
        (("pendulum", [0.0, 0.0], ZEROS, -0.03), "dt must be .*-0.03"),
        (("pendulum", [0.0, 0.0], ZEROS, np.nan), "dt must be .*nan"),
        (("pendulum", [0.0, 0.0], ZEROS, np.inf), "dt must be .*inf"),
        (("pendulum", [0.0, 0.0], lambda step, Z: [[0.0]]), "A controller needs n_steps"),
        (
            ("robot", [0.0, 0.0], ZEROS),
            r"Unknown robot 'robot'.*'acrobot', 'cartpole', .*'iiwa14', 'pendulum'",
        ),
        (("pendulm", [0.0, 0.0], ZEROS), "Did you mean 'pendulum'"),
    ],
)
def test_invalid_arguments_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        simulate(*arguments)


def test_integration_that_gives_up_raises():
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="'pendulum' overflow|failed in step 0"):
        simulate("pendulum", [1.0, 1e200], ZEROS)


@pytest.mark.parametrize("system", ["cartpole", "acrobot"])
def test_states_whose_accelerations_overflow_raise(system):
    with pytest.raises(ValueError, match="accelerations of .* overflow"), np.errstate(all="ignore"):
        simulate(system, [0.3, 0.3, 1e200, 1e200], np.zeros((1, 1)))


@pytest.mark.parametrize("dt", ["a", None, [0.1, 0.2], True])
def test_step_that_is_no_number_raises(dt):
    with pytest.raises(TypeError, match="dt must be a number"):
        simulate("pendulum", [0.0, 0.0], np.zeros((1, 1)), dt=dt)


def test_complex_states_raise():
    with pytest.raises(ValueError, match="z0 must be real numbers"):
        simulate("pendulum", [0.0, 1j], np.zeros((1, 1)))


def test_no_trajectory_raises():
    with pytest.raises(ValueError, match="and some rows"):
        simulate("pendulum", np.zeros((0, 2)), np.zeros((0, 3, 1)))


def test_controller_sees_each_state_once():
    z0, seen = np.array([[0.3, 0.0], [0.1, 0.2]]), []

    def brake(step, Z):
        seen.append((step, Z))
        return -0.5 * Z[:, 1:]

    Z, U = simulate("pendulum", z0, brake, n_steps=4, return_inputs=True)
    assert [step for step, _ in seen] == [0, 1, 2, 3]
    assert_array_equal(np.stack([states for _, states in seen], axis=1), Z[:, :-1])
    assert_array_equal(U, -0.5 * Z[:, :-1, 1:])


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros(2), r"must return finite inputs of shape \(2, 1\); got the shape \(2,\) in step 0"),
        (np.zeros((1, 1)), r"shape \(2, 1\); got the shape \(1, 1\)"),
        ([[0.0], [np.nan]], "got NaN or infinity in step 0"),
        ([[0.0], [1j]], "inputs must be real numbers"),
    ],
)
def test_invalid_controller_output_raises(answer, message):
    with pytest.raises(ValueError, match=message):
        simulate("pendulum", np.zeros((2, 2)), lambda step, Z: answer, n_steps=1)


def test_number_of_steps_is_for_controllers():
    with pytest.raises(ValueError, match="n_steps=3 only with a controller"):
        simulate("pendulum", [0.0, 0.0], ZEROS, n_steps=3)


@pytest.mark.long
def test_number_of_jobs_does_not_change_a_bit():
    rng = np.random.default_rng(0)
    z0, U = rng.uniform(-1.0, 1.0, (130, 4)), rng.standard_normal((130, 2, 1))
    assert_array_equal(simulate("acrobot", z0, U, n_jobs=2), simulate("acrobot", z0, U, n_jobs=1))


def test_wrapped_angles_differ_by_whole_turns():
    z0, U = [0.0, 3.0, 0.0, 8.0], np.zeros((40, 1))
    Z, wrapped = simulate("cartpole", z0, U), simulate("cartpole", z0, U, wrap_angles=True)
    assert np.abs(Z[:, 1]).max() > np.pi
    assert (wrapped[:, 1] >= -np.pi).all()
    assert (wrapped[:, 1] < np.pi).all()
    whole = (Z - wrapped)[:, 1] / (2.0 * np.pi)
    assert_allclose(whole, np.round(whole), rtol=0, atol=1e-12)
    assert_array_equal(np.delete(wrapped, 1, axis=1), np.delete(Z, 1, axis=1))


@pytest.mark.parametrize("name", ["panda", "ur5", "kinova", "double_pendulum"])
def test_one_step_of_any_robot_equals_plain_pinocchio(name):
    model = load_robot(name)
    data, n, rng = model.createData(), model.nv, np.random.default_rng(0)
    q, v = rng.uniform(-0.5, 0.5, n), rng.uniform(-0.5, 0.5, n)
    u = np.array(pinocchio.computeGeneralizedGravity(model, data, q))

    def derivative(_t, state):
        force = u - np.array(model.damping) * state[n:]
        return np.r_[state[n:], pinocchio.aba(model, data, state[:n], state[n:], force)]

    exact = solve_ivp(derivative, (0.0, DT), np.r_[q, v], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert_allclose(simulate(name, np.r_[q, v], u[np.newaxis])[1], exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dt", [0.01, 0.06])
def test_controller_of_another_step_raises(dt):
    controller = ComputedTorqueController("ur5", np.zeros(6), np.ones(6), duration=1.0, dt=0.03)
    with pytest.raises(ValueError, match=rf"dt must be that of the controller, 0.03; got {dt}"):
        simulate("ur5", np.zeros(12), controller, dt, n_steps=2)
