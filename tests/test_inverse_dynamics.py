import copy
import warnings

import numpy as np
import pandas as pd
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import butter, filtfilt
from sklearn.exceptions import ConvergenceWarning, NotFittedError
from sklearn.preprocessing import StandardScaler

from skevgp import InverseDynamics
from skevgp.datasets import load_robot, perturb_robot
from skevgp.features import LogNormal, RigidBodyRegressor
from skevgp.io import load, save
from skevgp.robots import RigidBody, inertial_parameters, physical_consistency


def trajectory(n_joints, seed, seconds=10.0, dt=0.02):
    """Positions, velocities and accelerations of random harmonics."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, dt)
    q, v, a = np.zeros((3, len(t), n_joints))
    for harmonic in range(1, 7):
        w, (sine, cosine) = 0.6 * harmonic, rng.normal(size=(2, n_joints)) / harmonic
        wave, slope = np.sin(w * t)[:, np.newaxis], np.cos(w * t)[:, np.newaxis]
        q += sine * wave + cosine * slope
        v += w * (sine * slope - cosine * wave)
        a -= w**2 * (sine * wave + cosine * slope)
    return np.hstack([q, v, a])


class Arm:
    """A robot whose model is wrong, with friction, and its log."""

    def __init__(self, robot="ur5", seed=0, noise=0.02, n_groups=3, error=0.2, missed=None, dt=0.05):
        self.nominal = load_robot(robot)
        self.model = perturb_robot(self.nominal, error, random_state=seed) if error else self.nominal
        rng, n = np.random.default_rng(seed), self.nominal.nv
        limit = np.minimum(np.where(self.nominal.upperEffortLimit > 0.0, self.nominal.upperEffortLimit, 10.0), 50.0)
        self.viscous, self.coulomb = rng.uniform(0.02, 0.1, (2, n)) * limit
        self.missed = missed or (lambda X: 0.0)
        self.X = np.concatenate([trajectory(n, 100 * seed + group, dt=dt) for group in range(n_groups)])
        self.groups = np.repeat(np.arange(n_groups), len(self.X) // n_groups)
        clean = self.torque(self.X)
        self.y = clean + noise * clean.std(axis=0) * rng.normal(size=clean.shape)
        self.new = trajectory(n, 99 + 100 * seed, dt=dt)

    def torque(self, X):
        q, v, a = np.split(X, 3, axis=1)
        torque = RigidBody(self.model).forces(q, v, a) + self.viscous * v + self.coulomb * np.tanh(v / 0.01)
        return torque + self.missed(X)

    @property
    def weights(self):
        links = [link.toDynamicParameters() for link in list(self.model.inertias)[1:]]
        return np.concatenate([*links, self.viscous, self.coulomb, np.zeros(2 * self.model.nv)])

    def fit(self, **options):
        return InverseDynamics(self.nominal, random_state=0, **options).fit(self.X, self.y, groups=self.groups)


@pytest.fixture(scope="module")
def arm():
    return Arm(dt=0.1)


@pytest.fixture(scope="module")
def rigid(arm):
    """By the robot's name, and so with a file."""
    return InverseDynamics("ur5", n_inducing=0, random_state=0).fit(arm.X, arm.y, groups=arm.groups)


def precise_first_joints(seed, robot, cutoff):
    """Four seconds of an arm: two precise joints with friction that no feature has, and four with filtered noise."""
    rng, n = np.random.default_rng(seed), 6
    X = trajectory(n, seed, seconds=4.0, dt=0.01)
    body = RigidBodyRegressor(robot).fit(X)
    y = body.transform(X)[:, :, : 10 * n] @ body.coef_prior(n)[0][: 10 * n]
    size, v = np.abs(y).max(axis=0) + 0.1, X[:, n : 2 * n]
    y += size * (0.05 * np.tanh(v / 0.05) + 0.05 * v)
    y += size * [0.1, 0.1, 0.0, 0.0, 0.0, 0.0] * np.sin(X[:, :n]) * np.tanh(v / 0.05)
    noise = filtfilt(*butter(2, cutoff / 50.0), rng.normal(size=(len(y) + 400, n)), axis=0)[200:-200]
    return X, y + size * [0.001, 0.001, 0.05, 0.05, 0.05, 0.05] * noise / noise.std(axis=0)


@pytest.mark.parametrize(("cutoff", "seed"), [(2.5, 0), (5.0, 1), (20.0, 0)])
def test_no_joint_loses_to_least_squares_on_another_move(cutoff, seed):
    robot = perturb_robot("ur5", 0.2, random_state=seed)
    logs = [precise_first_joints(100 * seed + move, robot, cutoff) for move in range(4)]
    X, y = (np.concatenate(parts) for parts in zip(*logs[:3], strict=True))
    model = InverseDynamics("ur5", n_inducing=0).fit(X, y, groups=np.repeat(np.arange(3), 400))
    body = RigidBodyRegressor("ur5").fit(X)
    coef = np.linalg.lstsq(body.transform(X).reshape(y.size, -1), y.ravel(), rcond=None)[0]
    new, truth = logs[3]
    ratios = np.mean((model.predict(new) - truth) ** 2, axis=0)
    ratios /= np.mean((body.transform(new) @ coef - truth) ** 2, axis=0)
    assert ratios.max() < 1.1
    assert np.exp(np.mean(np.log(ratios))) < 0.6


def test_usual_differences_between_days_widen_intervals_of_another_day():
    # Moves of one day are alike. On another day, friction is larger.
    def log(seed, factor):
        X = trajectory(1, seed)
        friction = factor * (0.3 * np.tanh(X[:, 1] / 0.05) + 0.2 * X[:, 1])
        noise = 0.01 * np.random.default_rng(seed).normal(size=len(X))
        return X, X[:, 2] / 4.0 + 9.81 / 2.0 * np.sin(X[:, 0]) + friction + noise

    logs = [log(seed, 1.0) for seed in range(4)]
    X, y = (np.concatenate(parts) for parts in zip(*logs, strict=True))
    moves, (new, torque) = np.repeat(np.arange(4), len(logs[0][1])), log(9, 1.07)

    def inside(model):
        mean, std = model.predict(new, return_std=True)
        return np.mean(np.abs(mean - torque) < 2.0 * std)

    only_moves = InverseDynamics("pendulum", n_inducing=0, move_scale_prior=np.zeros(4)).fit(X, y, groups=moves)
    usual = InverseDynamics("pendulum", n_inducing=0).fit(X, y, groups=moves)
    assert inside(only_moves) < 0.7 < 0.9 < inside(usual)
    assert (usual.move_scale_ >= only_moves.move_scale_).all()
    for wrong in ([0.1, 0.1], [0.1, 0.1, 0.1, -0.1], [np.nan] * 4, [None] * 4, [1e160] * 4):
        with pytest.raises(ValueError, match="move_scale_prior must be 4 numbers from 0 to 1e"):
            InverseDynamics("pendulum", move_scale_prior=wrong).fit(X, y)


def test_torques_of_a_new_trajectory_are_known_to_a_hundredth(arm, rigid):
    truth = arm.torque(arm.new)
    error = np.sqrt(np.mean((rigid.predict(arm.new) - truth) ** 2, axis=0)) / truth.std(axis=0)
    assert error.max() < 0.01
    model = RigidBodyRegressor(arm.nominal, stiction_velocity=0.01)
    before = model.fit_transform(arm.new) @ model.coef_prior(6)[0]
    assert (np.sqrt(np.mean((before - truth) ** 2, axis=0)) / truth.std(axis=0)).min() > 0.05


def test_friction_is_found(arm, rigid):
    found = dict(zip(rigid.coef_names_, rigid.coef_, strict=True))
    joints = list(arm.nominal.names)[1:]
    assert_allclose([found[f"coulomb({joint})"] for joint in joints], arm.coulomb, rtol=0.1)
    assert_allclose([found[f"viscous({joint})"] for joint in joints], arm.viscous, rtol=0.2)
    assert_allclose(rigid.standing_std_, arm.coulomb / np.sqrt(3.0), rtol=0.1)


def gear(X):
    """Friction that grows with load, and a wave of the gear: what a rigid body does not have."""
    n = X.shape[1] // 3
    return 3.0 * np.sin(2.0 * X[:, :n]) * np.tanh(X[:, n : 2 * n])


@pytest.mark.long
def test_joints_own_columns_tell_what_physics_missed():
    arm = Arm(missed=gear, dt=0.02)
    truth = arm.torque(arm.new)

    def error(model):
        return np.mean((model.predict(arm.new) - truth) ** 2, axis=0)

    model = arm.fit(n_jobs=2)
    assert np.exp(np.mean(np.log(error(model) / error(arm.fit(n_inducing=0))))) < 0.7
    mean, std = model.predict(arm.new, return_std=True)
    assert (np.mean(np.abs(truth - mean) < 2.0 * std, axis=0) > 0.85).all()
    # Where few moves do not confirm a Gaussian process at 5 %, there is none.
    assert (model.residual_std_ > 0.0).sum() >= 4


def carrying(arm, model, seed, gains=1.0, mass=2.0):
    """What a model of the arm says that it carries, and what it does carry."""
    loaded = Arm(seed=seed, n_groups=1)
    body = pinocchio.Inertia(mass, np.array([0.02, -0.03, 0.1]), 0.01 * np.eye(3))
    loaded.model.inertias[loaded.model.njoints - 1] += body
    rng, X = np.random.default_rng(seed), trajectory(6, 1000 + seed, dt=0.05)
    clean = gains * loaded.torque(X)
    return model.estimate_payload(X, clean + 0.02 * clean.std(axis=0) * rng.normal(size=clean.shape)), body


def test_frames_must_be_in_the_robots_order():
    arm = Arm("pendulum", dt=0.2)
    frame = pd.DataFrame(arm.X, columns=["q", "dq/dt", "d2q/dt2"])
    model = InverseDynamics("pendulum", n_inducing=0).fit(frame, arm.y)
    assert_allclose(model.predict(frame), InverseDynamics("pendulum", n_inducing=0).fit(arm.X, arm.y).predict(arm.X))
    with pytest.raises(ValueError, match="order"):
        InverseDynamics("pendulum").fit(frame[["dq/dt", "q", "d2q/dt2"]], arm.y)


def test_payload_lies_in_its_interval(arm, rigid):
    payload, body = carrying(arm, rigid, 0)
    assert payload.mass_interval[0] < 2.0 < payload.mass_interval[1]
    assert payload.mass_std < 0.2
    assert (np.abs(payload.com - body.lever) < 3.0 * payload.com_std).all()
    nothing = rigid.estimate_payload(arm.X, arm.y, groups=arm.groups)
    assert nothing.mass_interval[0] < 0.0 < nothing.mass_interval[1]
    assert abs(nothing.mass) < 0.1


def test_payload_of_one_group_is_that_without_groups(changing, fitted):
    first = changing.groups == 0
    one, other = (
        fitted.estimate_payload(changing.X[first], changing.y[first], groups=labels)
        for labels in (None, changing.groups[first])
    )
    assert_array_equal(one.parameters, other.parameters)


def test_model_that_was_found_moves_like_the_robot(arm, rigid, tmp_path):
    truth = arm.torque(arm.new)
    q, v, a = np.split(arm.new, 3, axis=1)

    def error(model):
        torque = RigidBody(model).forces(q, v, a)
        torque += np.array(model.damping) * v + np.array(model.friction) * np.tanh(v / 0.01)
        return (np.sqrt(np.mean((torque - truth) ** 2, axis=0)) / truth.std(axis=0)).max()

    found = rigid.robot_model()
    assert error(found) < 0.02
    assert (physical_consistency(inertial_parameters(found)) > 0.0).all()
    rigid.write_urdf(tmp_path / "found.urdf")
    assert "standard deviations: mass=" in (tmp_path / "found.urdf").read_text(encoding="utf-8")
    loaded = load_robot(tmp_path / "found.urdf")
    assert_allclose(inertial_parameters(loaded), inertial_parameters(found), rtol=1e-6, atol=1e-9)
    assert_allclose(loaded.damping, found.damping, rtol=1e-9)
    with pytest.raises(ValueError, match="file"):
        Arm("pendulum", n_groups=1, dt=0.2).fit(n_inducing=0).write_urdf(tmp_path / "none.urdf")


def with_masses(arm, factor):
    model = arm.nominal.copy()
    for link in range(1, model.njoints):
        body = model.inertias[link]
        model.inertias[link] = pinocchio.Inertia(factor * body.mass, body.lever, factor * body.inertia)
    return model


@pytest.mark.parametrize("factor", [0.01, 0.15])
def test_placeholder_masses_warn(factor):
    arm = Arm("acrobot", n_groups=1, dt=0.2)
    with pytest.warns(ConvergenceWarning, match="model does not fit the torques"):
        InverseDynamics(with_masses(arm, factor), n_inducing=0).fit(arm.X, arm.y, groups=arm.groups)


def test_torques_that_are_mostly_noise_warn():
    """Two thirds of the variance of the second joint are noise."""
    arm = Arm("acrobot", n_groups=1, dt=0.2)
    y = arm.y + [0.0, np.sqrt(2.0) * arm.y[:, 1].std()] * np.random.RandomState(0).randn(*arm.y.shape)
    with pytest.warns(ConvergenceWarning, match=r"half of the variance of the torques of \[[^,]*\] is explained"):
        InverseDynamics("acrobot", n_inducing=0).fit(arm.X, y, groups=arm.groups)


# Where no Gaussian process is confirmed, a fit with one ends as a fit without.
@pytest.mark.parametrize(
    ("robot", "scale", "n_inducing"),
    [("pendulum", 0.0, 5), ("pendulum", 1e-100, 5), ("cartpole", 1.0, 5), ("cartpole", 1.0, 0)],
)
def test_torques_that_are_the_models_own(robot, scale, n_inducing):
    arm = Arm(robot, n_groups=1, dt=0.2)
    body = RigidBodyRegressor(robot)
    y = scale * (body.fit_transform(arm.X) @ body.coef_prior(arm.nominal.nv)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = InverseDynamics(robot, n_inducing=n_inducing, max_iter=4).fit(arm.X, y)
    mean, std = model.predict(arm.X, return_std=True)
    assert_allclose(mean, y, atol=1e-4 * y.std() + 1e-6)
    assert np.isfinite(std).all()
    assert np.isfinite(model.coef_).all()


def test_invalid_input_raises(arm):
    model = InverseDynamics("ur5", n_inducing=0)
    with pytest.raises(ValueError, match="X has 12 columns.*needs 18"):
        model.fit(arm.X[:, :12], arm.y)
    with pytest.raises(ValueError, match="y has 4 columns.*6 joints"):
        model.fit(arm.X, arm.y[:, :4])
    with pytest.raises(ValueError, match="groups"):
        model.fit(arm.X, arm.y, groups=arm.groups[:-1])
    with pytest.raises(ValueError, match="gain_scale"):
        InverseDynamics("ur5", gain_scale=-0.1).fit(arm.X, arm.y)
    with pytest.raises(ValueError, match="NaN"):
        model.fit(np.where(arm.X > 0.5, np.nan, arm.X), arm.y)
    with pytest.raises(ValueError, match="Unknown robot"):
        InverseDynamics("ur55").fit(arm.X, arm.y)
    body = RigidBodyRegressor("ur5", parameters={"stiction_velocity": LogNormal(0.01, 1.0)})
    with pytest.raises(ValueError, match=r"Leave parameters .* at None; got \['stiction_velocity'\]"):
        InverseDynamics(body).fit(arm.X, arm.y)
    assert not hasattr(model, "coef_")


def test_velocities_of_friction_lie_in_their_intervals(tmp_path):
    arm, velocity = Arm("acrobot", noise=0.01), np.array([0.1, 0.03])
    blurred = np.tanh(arm.X[:, 2:4] / velocity) - np.tanh(arm.X[:, 2:4] / 0.01)
    y = arm.y + arm.coulomb * blurred

    def fitted(**options):
        return InverseDynamics(arm.nominal, n_inducing=0, **options).fit(arm.X, y, groups=arm.groups)

    model = fitted()
    names = [f"stiction_velocity({joint})" for joint in list(arm.nominal.names)[1:]]
    assert list(model.theta_) == list(model.theta_std_) == names
    found, std = (np.array(list(values.values())) for values in (model.theta_, model.theta_std_))
    assert (np.abs(found - velocity) < 3.0 * std).all()
    assert (std < 0.3 * velocity).all()
    # It is the map's up to the last step.
    assert_allclose(model.feature_map_.stiction_velocity, found, rtol=0.05)
    friction = dict(zip(model.coef_names_, zip(model.coef_, model.coef_std_, strict=True), strict=True))
    for joint, coulomb in zip(list(arm.nominal.names)[1:], arm.coulomb, strict=True):
        mean, own = friction[f"coulomb({joint})"]
        assert abs(mean - coulomb) < 3.0 * own
    table = model.summary().to_frame()
    assert_allclose(table[table["part"] == "parameter"]["std"], std)
    save(model, tmp_path / "arm.skevgp")
    loaded = load(tmp_path / "arm.skevgp")
    assert loaded.theta_ == model.theta_
    for before, after in zip(model.predict(arm.new, True), loaded.predict(arm.new, True), strict=True):
        assert_allclose(after, before)
    given = fitted(stiction_velocity=None)
    assert given.theta_ == {}
    assert given.feature_map_.stiction_velocity == 0.01


def test_uncertain_velocity_of_friction_widens_std_at_low_speed():
    arm = Arm("pendulum", noise=0.5, n_groups=1, dt=0.02)
    X = np.array([[0.0, 0.02, 0.0], [0.0, 2.0, 0.0]])
    std = {
        velocity: InverseDynamics("pendulum", n_inducing=0, stiction_velocity=velocity)
        .fit(arm.X, arm.y)
        .predict(X, True, include_noise=False)[1]
        for velocity in ("auto", None)
    }
    assert std["auto"][0] > 1.2 * std[None][0]
    assert std["auto"][1] < 1.2 * std[None][1]


def test_other_transformers_are_no_robots():
    with pytest.raises(TypeError, match="robot must be a name"):
        InverseDynamics(StandardScaler()).fit(np.zeros((5, 3)), np.zeros(5))


def test_invalid_payloads_raise(arm, rigid):
    with pytest.raises(ValueError, match="y must have 6 columns"):
        rigid.estimate_payload(arm.X, arm.y[:, :2])
    with pytest.raises(ValueError, match="link=6"):
        rigid.estimate_payload(arm.X, arm.y, link=6)
    with pytest.raises(ValueError, match="link"):
        rigid.estimate_payload(arm.X, arm.y, link=-7)
    with pytest.raises(TypeError, match="link"):
        rigid.estimate_payload(arm.X, arm.y, link=1.5)
    with pytest.raises(ValueError, match="mass_scale"):
        rigid.estimate_payload(arm.X, arm.y, mass_scale=1e300)
    with pytest.raises(ValueError, match="pieces"):
        rigid.estimate_payload(arm.X, arm.y, pieces=[0, 1])
    for name in ("mass_scale", "size"):
        with pytest.raises(ValueError, match=name):
            rigid.estimate_payload(arm.X, arm.y, **{name: 0.0})
    free = InverseDynamics(n_inducing=0).fit(arm.X[:50, :3], arm.y[:50, 0])
    assert not hasattr(free, "estimate_payload")


# --- moves that differ -----------------------------------------------------------------------------------------------


def test_torque_that_differs_from_move_to_move_makes_nothing_worse_than_physics():
    """A Gaussian process fits it in each training move."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 20.0, 0.05)
    X = np.concatenate([0.5 * trajectory(1, seed, dt=0.1) for seed in range(6)])
    moves = np.repeat(np.arange(6), 100)
    own = rng.uniform(0.0, 2.0 * np.pi, (6, 2))[moves]

    def torque(X):
        return X[:, 2] / 4.0 + 9.81 / 2.0 * np.sin(X[:, 0]) + 0.3 * np.tanh(X[:, 1] / 0.01)

    y = torque(X) + 0.5 * np.sin(2.0 * X[:, 0] + own[:, 0]) + 0.3 * np.sin(X[:, 1] + own[:, 1])
    y += 0.05 * rng.normal(size=len(y))
    model, physics = (
        InverseDynamics("pendulum", n_inducing=n_inducing, max_iter=10, random_state=0).fit(X, y, groups=moves)
        for n_inducing in (10, 0)
    )
    wave = np.column_stack([2.0 * np.sin(3.0 * t), 6.0 * np.cos(3.0 * t), -18.0 * np.sin(3.0 * t)])
    for new in (wave, 0.5 * trajectory(1, 99, dt=0.05)):
        error, least = (np.sqrt(np.mean((one.predict(new) - torque(new)) ** 2)) for one in (model, physics))
        assert error <= 1.02 * least


class Changing:
    """An acrobot whose offset, friction and gain differ from move to move."""

    def __init__(self, offset, n_moves=16, dt=0.05):
        self.dt = dt
        self.robot = load_robot("acrobot")
        self.scale = np.array([[offset], [0.03], [0.1], [0.01]])
        moves = [self.move(seed) for seed in range(n_moves)]
        self.X, self.y = (np.concatenate(part) for part in zip(*moves, strict=True))
        self.groups = np.repeat(np.arange(n_moves), len(self.X) // n_moves)

    def move(self, seed, load=0.0):
        """Return X and y of a move, in which gravity is larger in the first joint."""
        X, rng = trajectory(2, seed, dt=self.dt), np.random.default_rng([seed, 1])
        offset, viscous, coulomb, gain = self.scale * rng.normal(size=(4, 2))
        q, v, a = np.split(X, 3, axis=1)
        rigid = RigidBody(self.robot).forces(q, v, a)
        rigid[:, 0] += load * RigidBody(self.robot).forces(q, 0.0 * v, 0.0 * a)[:, 0]
        y = (1.0 + gain) * rigid + (0.1 + viscous) * v + (0.3 + coulomb) * np.tanh(v / 0.01) + offset
        return X, y + 0.1 * rng.normal(size=y.shape)

    def fit(self, model=None):
        return (model or InverseDynamics("acrobot", n_inducing=0)).fit(self.X, self.y, groups=self.groups)


@pytest.fixture(scope="module")
def changing():
    return Changing(1.0)


@pytest.fixture(scope="module")
def fitted(changing):
    return changing.fit()


def test_update_lowers_the_error_of_the_rest_of_a_move(changing, fitted):
    squares = []
    assert fitted.move_scale_.shape == fitted.move_.shape == (2, 4)
    assert_allclose(fitted.move_, 0.0)
    for seed in range(100, 110):
        X, y = changing.move(seed)
        before, wide = fitted.predict(X[60:], return_std=True)
        after, narrow = copy.deepcopy(fitted).update(X[:60], y[:60]).predict(X[60:], return_std=True)
        squares.append([np.mean((torque - y[60:]) ** 2, axis=0) for torque in (before, after)])
        assert (narrow < wide).all()
        assert np.mean(((after - y[60:]) / narrow) ** 2) < 2.0
    first, rest = np.sqrt(np.mean(squares, axis=0))
    assert (rest < 0.5 * first).all()


def test_fewer_than_three_moves_do_not_say_how_moves_differ(changing):
    few = changing.groups < 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = InverseDynamics("acrobot", n_inducing=0).fit(
            changing.X[few], changing.y[few], groups=changing.groups[few]
        )
    for method in (model.update, model.check_log):
        with pytest.raises(ValueError, match=r"at least 3 groups; got 2\. With load_log, one file is one group"):
            method(changing.X[:50], changing.y[:50])


def test_a_fit_without_a_group_has_rows_where_few_are_taken():
    """Every third row is of the same group."""
    X = trajectory(1, 0)[:148]
    y = X[:, 2] / 4.0 + 9.81 / 2.0 * np.sin(X[:, 0]) + 0.1 * np.random.default_rng(0).normal(size=len(X))
    model = InverseDynamics("pendulum", max_rows=50, n_inducing=5, max_iter=3).fit(X, y, groups=np.arange(len(X)) % 3)
    assert np.isfinite(model.predict(X)).all()


def test_update_begins_anew_and_fit_resets_it():
    changing = Changing(1.0, n_moves=3, dt=0.1)
    fitted = changing.fit()
    model = copy.deepcopy(fitted)
    first, second = changing.move(200), changing.move(201)
    alone = copy.deepcopy(fitted).update(*second)
    mean, std = alone.predict(changing.X, return_std=True)
    model.update(*first)
    assert np.abs(model.move_ - alone.move_).max() > 0.1
    for found, expected in zip(model.update(*second).predict(changing.X, return_std=True), (mean, std), strict=True):
        assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    assert_allclose(model.move_, alone.move_, rtol=1e-6)
    # If no row follows another, rows have at least as much information.
    model.update(*second, pieces=np.arange(len(second[1])))
    assert (model.predict(changing.X, return_std=True)[1] <= (1.0 + 1e-9) * std).all()
    changing.fit(model)
    assert_allclose(model.move_, 0.0)
    assert_allclose(model.predict(changing.X), fitted.predict(changing.X), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("method", ["update", "check_log"])
def test_log_of_a_wrong_shape_raises(rigid, arm, method):
    call = getattr(rigid, method)
    for wrong in ((arm.X[:, :12], arm.y), (arm.X, arm.y[:, :4]), (arm.X[:-1], arm.y), (np.nan * arm.X, arm.y)):
        with pytest.raises(ValueError, match="X|y|samples"):
            call(*wrong)
    with pytest.raises(ValueError, match="pieces"):
        call(arm.X, arm.y, pieces=[0, 1])
    with pytest.raises(NotFittedError):
        getattr(InverseDynamics("ur5"), method)(arm.X, arm.y)


def test_ordinary_logs_fail_the_check_as_often_as_stated_and_loads_are_found():
    machine = Changing(0.1, n_moves=10)
    model = machine.fit()

    def check(log, rate):
        return model.check_log(*log, dt=machine.dt, false_alarms_per_minute=rate)

    # A log has 10 s, so that a rate of 0.6 a minute is a probability of 0.1.
    checks = [check(machine.move(seed), 0.6) for seed in range(300, 340)]
    assert np.mean([not one.fits for one in checks]) <= 0.3
    for one in checks:
        assert one.fits == (one.p_value >= 0.1) == (not one.joints)
        assert one.p_value == pytest.approx(min(1.0, 2.0 * one.p_values.min()))
    loaded = [check(machine.move(seed, load=0.1), 0.01) for seed in range(400, 405)]
    assert [one.joints for one in loaded] == 5 * [["q1"]]
    assert not any(one.fits for one in loaded)
    # An update does not count.
    log = machine.move(500)
    before = check(log, 0.6).p_values
    model.update(*machine.move(501))
    assert_allclose(check(log, 0.6).p_values, before, rtol=1e-6)


def test_shift_that_hardly_changes_the_size_of_errors_does_not_fit():
    machine = Changing(0.005, n_moves=12, dt=0.02)
    model = machine.fit()
    logs = [machine.move(seed) for seed in range(400, 405)]
    checks = [model.check_log(X, y + [0.0, 0.1], dt=machine.dt) for X, y in logs]  # as large as the noise
    assert [one.joints for one in checks] == 5 * [["q2"]]


@pytest.mark.parametrize("name", ["dt", "false_alarms_per_minute"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_invalid_rates_of_checks_raise(rigid, arm, name, value):
    with pytest.raises(ValueError, match=name):
        rigid.check_log(arm.X, arm.y, **{name: value})


# --- what a log cannot tell ------------------------------------------------------------------------------------------


def warnings_of(X, y, **data):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        InverseDynamics("acrobot", n_inducing=0).fit(X, y, **data)
    assert all(one.category is ConvergenceWarning for one in caught)
    return [str(one.message) for one in caught]


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_robot_at_rest_with_equal_rows_is_fitted():
    """At rest the cart needs no force, and the pole does."""
    X = np.repeat([0.1, 0.0, 0.0], 2) * np.ones((40, 1))
    body = RigidBodyRegressor("cartpole").fit(X)
    y = body.transform(X) @ body.coef_prior(2)[0]
    model = InverseDynamics("cartpole", n_inducing=5, max_iter=5, random_state=0).fit(
        X, y.round(2), groups=np.arange(40) // 10
    )
    mean, std = model.predict(X[:1], return_std=True)
    assert_allclose(mean, y[:1], atol=0.02)
    assert ((std > 0.0) & (std < 1.0)).all()


def test_weaknesses_of_a_log_are_named():
    arm = Arm("acrobot", error=0.05, dt=0.1)
    assert warnings_of(arm.X, arm.y, groups=arm.groups) == []
    still = arm.X.copy()
    still[:, [1, 3, 5]] = [0.3, 0.0, 0.0]
    said = warnings_of(still, arm.torque(still) + 0.02 * np.random.default_rng(0).normal(size=arm.y.shape))
    assert any(one.startswith("['q2'] never move") for one in said)
    assert not any("opposite sign" in one for one in said)
    said = warnings_of(arm.X, arm.y * [0.01, -1.0], groups=arm.groups)
    assert any(one.startswith("Torques of ['q1'] are at most") for one in said)
    assert any(one.startswith("Torques of ['q2'] have the opposite sign") for one in said)
    # A filter as long as a fifth of the log: few independent rows.
    few = Arm("acrobot", error=0.05, n_groups=1, dt=0.02)
    slow = np.apply_along_axis(np.convolve, 0, np.random.default_rng(0).normal(size=(549, 2)), np.ones(50), "valid")
    said = warnings_of(few.X, few.torque(few.X) + 0.1 * slow)
    assert any("Record more motion." in one for one in said)
