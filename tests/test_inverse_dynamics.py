import pickle
import warnings

import numpy as np
import pandas as pd
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn import config_context
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GroupKFold, cross_val_score
from sklearn.preprocessing import StandardScaler

from skevgp import InverseDynamics
from skevgp.datasets import load_robot, perturb_robot
from skevgp.features import RigidBodyRegressor
from skevgp.identification.weights import _root
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

    def __init__(self, robot="ur5", seed=0, noise=0.02, n_groups=3, error=0.2, missed=None):
        self.nominal = load_robot(robot)
        self.model = perturb_robot(self.nominal, error, random_state=seed) if error else self.nominal
        rng, n = np.random.default_rng(seed), self.nominal.nv
        limit = np.minimum(np.where(self.nominal.upperEffortLimit > 0.0, self.nominal.upperEffortLimit, 10.0), 50.0)
        self.viscous, self.coulomb = rng.uniform(0.02, 0.1, (2, n)) * limit
        self.missed = missed or (lambda X: 0.0)
        self.X = np.concatenate([trajectory(n, 100 * seed + group) for group in range(n_groups)])
        self.groups = np.repeat(np.arange(n_groups), len(self.X) // n_groups)
        clean = self.torque(self.X)
        self.y = clean + noise * clean.std(axis=0) * rng.normal(size=clean.shape)
        self.new = trajectory(n, 99 + 100 * seed)

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
    return Arm()


@pytest.fixture(scope="module")
def rigid(arm):
    return arm.fit(n_inducing=0)


def identifiable(model, truth):
    """Distances, in standard deviations, of the combinations of which torques know more than the prior did."""
    root = _root(model._weights.prior.covariance)
    to_unit = np.linalg.pinv(root, rcond=1e-9)
    variance, directions = np.linalg.eigh(to_unit @ model.coef_cov_ @ to_unit.T)
    known = (variance < 0.25) & (variance > 1e-20)
    return (directions.T @ to_unit @ (truth - model.coef_))[known] / np.sqrt(variance[known])


def test_torques_of_a_new_trajectory_are_known_to_a_hundredth(arm, rigid):
    truth = arm.torque(arm.new)
    error = np.sqrt(np.mean((rigid.predict(arm.new) - truth) ** 2, axis=0)) / truth.std(axis=0)
    assert error.max() < 0.01
    model = RigidBodyRegressor(arm.nominal, stiction_velocity=0.01)
    before = model.fit_transform(arm.new) @ model.coef_prior(6)[0]
    assert (np.sqrt(np.mean((before - truth) ** 2, axis=0)) / truth.std(axis=0)).min() > 0.05


@pytest.mark.long
def test_intervals_of_what_torques_show_hold_the_truth():
    distances = []
    for seed in range(6):
        arm = Arm(seed=seed)
        distances.append(np.abs(identifiable(arm.fit(n_inducing=0), arm.weights)))
    inside = np.concatenate(distances) < 1.96
    assert len(inside) > 200
    assert 0.88 <= inside.mean() <= 0.995


def test_what_torques_do_not_show_stays_at_the_prior(arm, rigid):
    # The first link turns about a vertical axis: its mass does nothing.
    assert rigid.coef_[0] == pytest.approx(rigid.coef_prior_mean_[0], rel=1e-6)
    assert rigid.coef_std_[0] == pytest.approx(rigid.coef_prior_scale_[0], rel=1e-3)
    assert (rigid.coef_std_ <= rigid.coef_prior_scale_ * (1.0 + 1e-9)).all()


def test_friction_is_found(arm, rigid):
    found = dict(zip(rigid.coef_names_, rigid.coef_, strict=True))
    joints = list(arm.nominal.names)[1:]
    assert_allclose([found[f"coulomb({joint})"] for joint in joints], arm.coulomb, rtol=0.1)
    assert_allclose([found[f"viscous({joint})"] for joint in joints], arm.viscous, rtol=0.2)
    assert_allclose(rigid.standing_std_, arm.coulomb / np.sqrt(3.0), rtol=0.1)


def test_bands_hold_new_torques_and_are_wider_at_rest(arm, rigid):
    rng = np.random.default_rng(5)
    truth = arm.torque(arm.new)
    measured = truth + 0.02 * arm.y.std(axis=0) * rng.normal(size=truth.shape)
    mean, std = rigid.predict(arm.new, return_std=True)
    inside = np.mean(np.abs(measured - mean) < 2.0 * std, axis=0)
    assert (inside > 0.9).all()
    assert (rigid.predict(arm.new, return_std=True, include_noise=False)[1] < std).all()
    rest = np.zeros((1, 18))
    assert (rigid.predict(rest, return_std=True)[1] > std.min(axis=0)).all()


def gear(X):
    """Friction that grows with load, and a wave of the gear: what a rigid body does not have."""
    n = X.shape[1] // 3
    return 3.0 * np.sin(2.0 * X[:, :n]) * np.tanh(X[:, n : 2 * n])


@pytest.mark.long
def test_a_joints_own_columns_tell_what_physics_missed():
    arm = Arm(missed=gear)
    truth = arm.torque(arm.new)

    def error(model):
        return np.mean((model.predict(arm.new) - truth) ** 2, axis=0)

    model = arm.fit(n_jobs=2)
    assert np.exp(np.mean(np.log(error(model) / error(arm.fit(n_inducing=0))))) < 0.7
    mean, std = model.predict(arm.new, return_std=True)
    assert (np.mean(np.abs(truth - mean) < 2.0 * std, axis=0) > 0.85).all()
    assert (model.residual_std_ > 0.0).all()


@pytest.mark.long
def test_where_nothing_is_missed_nothing_is_made_worse(arm, rigid):
    truth = arm.torque(arm.new)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = arm.fit()
    ours, physics = (np.mean((one.predict(arm.new) - truth) ** 2, axis=0) for one in (model, rigid))
    noise = (0.02 * truth.std(axis=0)) ** 2
    assert (ours < physics + 0.1 * noise).all()


@pytest.mark.filterwarnings("ignore:The residuals of:sklearn.exceptions.ConvergenceWarning")
def test_the_same_bits_for_any_number_of_threads():
    arm = Arm("acrobot", missed=gear)
    one, two = (arm.fit(n_inducing=5, max_iter=10, n_jobs=jobs) for jobs in (1, 2))
    for first, second in zip(one.predict(arm.new, return_std=True), two.predict(arm.new, return_std=True), strict=True):
        assert_array_equal(first, second)


def test_gains_widen_masses_and_leave_torques(arm, rigid):
    arm_of_catalogue = arm.fit(n_inducing=0, gain_scale=0.1)
    assert_allclose(arm_of_catalogue.predict(arm.new), rigid.predict(arm.new), atol=0.02 * arm.y.std())
    mass = list(rigid.coef_names_).index(f"mcz({list(arm.nominal.names)[2]})")
    assert arm_of_catalogue.coef_std_[mass] >= rigid.coef_std_[mass]
    assert_allclose(rigid.gains_, 1.0)
    assert (arm_of_catalogue.gains_std_ > 0.0).all()


def carrying(arm, model, seed, gains=1.0, mass=2.0):
    """What a model of the arm says that it carries, and what it does carry."""
    loaded = Arm(seed=seed)
    body = pinocchio.Inertia(mass, np.array([0.02, -0.03, 0.1]), 0.01 * np.eye(3))
    loaded.model.inertias[loaded.model.njoints - 1] += body
    rng, X = np.random.default_rng(seed), trajectory(6, 1000 + seed)
    clean = gains * loaded.torque(X)
    return model.estimate_payload(X, clean + 0.02 * clean.std(axis=0) * rng.normal(size=clean.shape)), body


def test_a_payload_lies_in_its_interval(arm, rigid):
    payload, body = carrying(arm, rigid, 0)
    assert payload.mass_interval[0] < 2.0 < payload.mass_interval[1]
    assert payload.mass_std < 0.2
    assert (np.abs(payload.com - body.lever) < 3.0 * payload.com_std).all()
    nothing = rigid.estimate_payload(arm.X, arm.y, groups=arm.groups)
    assert nothing.mass_interval[0] < 0.0 < nothing.mass_interval[1]
    assert abs(nothing.mass) < 0.1


@pytest.mark.long
def test_unknown_gains_widen_a_payloads_interval_until_it_holds():
    distances, widths = [], []
    for seed in range(8):
        gains = 1.0 + 0.1 * np.random.default_rng(100 + seed).normal(size=6)
        arm = Arm(seed=seed)
        arm.y = gains * arm.y
        payload, _ = carrying(arm, arm.fit(n_inducing=0, gain_scale=0.1), seed, gains)
        distances.append(abs(payload.mass - 2.0) / payload.mass_std)
        widths.append(payload.mass_std)
    assert np.mean(np.array(distances) < 1.96) >= 0.75  # 6 of 8; fewer is one chance in 200
    assert 0.01 < np.median(widths) < 0.3


def test_the_model_that_was_found_moves_like_the_robot(arm, rigid, tmp_path):
    truth = arm.torque(arm.new)
    q, v, a = np.split(arm.new, 3, axis=1)

    def error(model):
        torque = RigidBody(model).forces(q, v, a)
        torque += np.array(model.damping) * v + np.array(model.friction) * np.tanh(v / 0.01)
        return (np.sqrt(np.mean((torque - truth) ** 2, axis=0)) / truth.std(axis=0)).max()

    found = rigid.robot_model()
    assert error(found) < 0.02
    assert (physical_consistency(inertial_parameters(found)) > 0.0).all()
    from_file = InverseDynamics("ur5", n_inducing=0).fit(arm.X, arm.y, groups=arm.groups)
    from_file.write_urdf(tmp_path / "found.urdf")
    assert "standard deviations: mass=" in (tmp_path / "found.urdf").read_text(encoding="utf-8")
    loaded = load_robot(tmp_path / "found.urdf")
    assert_allclose(inertial_parameters(loaded), inertial_parameters(found), rtol=1e-6, atol=1e-9)
    assert_allclose(loaded.damping, found.damping, rtol=1e-9)
    with pytest.raises(ValueError, match="file"):
        rigid.write_urdf(tmp_path / "none.urdf")


def test_links_are_told_with_their_uncertainty(arm, rigid):
    links = rigid.links()
    assert [link.joint for link in links] == list(arm.nominal.names)[1:]
    for link, true in zip(links, list(arm.model.inertias)[1:], strict=True):
        assert abs(link.mass - true.mass) < 4.0 * link.mass_std
        assert (np.abs(link.com - true.lever) < 5.0 * link.com_std).all()
    assert links[0].mass_std == pytest.approx(0.2 * arm.nominal.inertias[1].mass, rel=1e-3)


def test_consistent_weights_predict_as_well(arm, rigid):
    model = arm.fit(n_inducing=0, consistent=True)
    assert all(link.consistency > 0.0 for link in model.links())
    assert_allclose(model.predict(arm.new), rigid.predict(arm.new), atol=0.02 * arm.y.std())


@pytest.mark.filterwarnings("ignore:The residuals of:sklearn.exceptions.ConvergenceWarning")
def test_one_joint_and_a_sliding_one():
    arm = Arm("cartpole")
    assert arm.fit(n_inducing=5, max_iter=5).predict(arm.new).shape == (500, 2)
    one = Arm("pendulum")
    model = InverseDynamics("pendulum", n_inducing=0).fit(one.X, one.y[:, 0])
    mean, std = model.predict(one.new, return_std=True)
    assert mean.shape == std.shape == (500,)
    assert_allclose(mean, one.torque(one.new)[:, 0], atol=0.05 * one.y.std())
    column = InverseDynamics("pendulum", n_inducing=0).fit(one.X, one.y)
    assert_allclose(column.predict(one.new)[:, 0], mean)


def test_scikit_learn_knows_it():
    arm = Arm("acrobot")
    model = InverseDynamics(RigidBodyRegressor("acrobot", friction=["viscous", "coulomb"]), n_inducing=0)
    model.set_params(robot__mass_scale=0.5)
    scores = cross_val_score(model, arm.X, arm.y, cv=GroupKFold(3), groups=arm.groups)
    assert scores.min() > 0.99
    fitted = clone(model).fit(arm.X, arm.y)
    assert_array_equal(pickle.loads(pickle.dumps(fitted)).predict(arm.new), fitted.predict(arm.new))
    assert fitted.coef_.shape == (24,)


def test_frames_must_be_in_the_robots_order():
    arm = Arm("pendulum")
    frame = pd.DataFrame(arm.X, columns=["q", "dq/dt", "d2q/dt2"])
    model = InverseDynamics("pendulum", n_inducing=0).fit(frame, arm.y)
    assert_allclose(model.predict(frame), InverseDynamics("pendulum", n_inducing=0).fit(arm.X, arm.y).predict(arm.X))
    with pytest.raises(ValueError, match="order"):
        InverseDynamics("pendulum").fit(frame[["dq/dt", "q", "d2q/dt2"]], arm.y)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e6])
def test_torques_of_any_size(scale):
    """Without a prior that knows their units."""
    arm = Arm("acrobot")
    wide = RigidBodyRegressor(arm.nominal, mass_scale=1e8, com_scale=1.0, inertia_scale=1e8, friction_scale=1e8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = InverseDynamics(wide, n_inducing=5, max_iter=5).fit(arm.X, scale * arm.y)
    mean, std = model.predict(arm.new, return_std=True)
    assert np.isfinite(std).all()
    assert (std >= 0.0).all()
    assert_allclose(mean, scale * arm.torque(arm.new), atol=0.05 * scale * arm.y.std() + 1e-12)


def with_masses(arm, factor):
    model = arm.nominal.copy()
    for link in range(1, model.njoints):
        body = model.inertias[link]
        model.inertias[link] = pinocchio.Inertia(factor * body.mass, body.lever, factor * body.inertia)
    return model


@pytest.mark.parametrize("factor", [0.01, 0.1])
def test_masses_that_are_placeholders_are_told(factor):
    arm = Arm()
    with pytest.warns(ConvergenceWarning, match="far from what torques say"):
        InverseDynamics(with_masses(arm, factor), n_inducing=0).fit(arm.X, arm.y, groups=arm.groups)


@pytest.mark.parametrize("factor", [0.3, 5.0])
def test_masses_that_are_far_off_are_found(factor):
    arm = Arm()
    found = InverseDynamics(with_masses(arm, factor), n_inducing=0).fit(arm.X, arm.y, groups=arm.groups)
    truth = arm.torque(arm.new)
    error = np.sqrt(np.mean((found.predict(arm.new) - truth) ** 2, axis=0)) / truth.std(axis=0)
    assert error.max() < 0.01


def test_limits_of_effort_that_are_placeholders_lose_no_digits():
    arm = Arm(noise=1e-3)
    model = arm.nominal.copy()
    model.upperEffortLimit, model.lowerEffortLimit = np.full(6, 1e8), np.full(6, -1e8)
    found = InverseDynamics(RigidBodyRegressor(model), n_inducing=0).fit(arm.X, arm.y, groups=arm.groups)
    truth = arm.torque(arm.new)
    error = np.sqrt(np.mean((found.predict(arm.new) - truth) ** 2, axis=0)) / truth.std(axis=0)
    assert error.max() < 0.005


def test_torques_without_noise_and_joints_that_do_not_move():
    arm = Arm("ur5", noise=0.0)
    arm.X[:, [2, 8, 14]] = [0.3, 0.0, 0.0]
    y = arm.torque(arm.X)
    model = InverseDynamics(arm.nominal, n_inducing=0).fit(arm.X, y)
    assert_allclose(model.predict(arm.X), y, atol=1e-3 * y.std())
    assert np.isfinite(model.predict(arm.X, return_std=True)[1]).all()


@pytest.mark.parametrize("n_inducing", [0, 5])
@pytest.mark.parametrize("scale", [0.0, 1e-100, 1.0])
def test_torques_that_are_the_models_own(scale, n_inducing):
    arm = Arm("cartpole")
    body = RigidBodyRegressor("cartpole")
    y = scale * (body.fit_transform(arm.X) @ body.coef_prior(2)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = InverseDynamics("cartpole", n_inducing=n_inducing, max_iter=10).fit(arm.X, y)
    mean, std = model.predict(arm.X, return_std=True)
    assert_allclose(mean, y, atol=1e-4 * y.std() + 1e-6)
    assert np.isfinite(std).all()
    assert np.isfinite(model.coef_).all()


def test_bad_input_is_named(arm):
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
    assert not hasattr(model, "coef_")


def test_the_speed_at_which_friction_has_a_sign_is_found_from_several_trajectories():
    arm = Arm("acrobot", noise=0.01)
    blurred = np.tanh(arm.X[:, 2:4] / 0.1) - np.tanh(arm.X[:, 2:4] / 0.01)
    y = arm.y + arm.coulomb * blurred

    def velocity(groups, **options):
        return InverseDynamics(arm.nominal, n_inducing=0, **options).fit(arm.X, y, groups=groups).feature_map_

    assert (np.array(velocity(arm.groups).stiction_velocity) > 0.04).all()
    assert velocity(None).stiction_velocity == 0.01
    assert velocity(arm.groups, stiction_velocity=None).stiction_velocity == 0.01


def test_the_robot_that_was_fitted_is_kept():
    arm = Arm("acrobot")
    model = arm.nominal.copy()
    fitted = InverseDynamics(model, n_inducing=0).fit(arm.X, arm.y)
    model.gravity.linear = np.zeros(3)
    assert fitted.robot_model().gravity.linear[2] < -9.0


def test_frames_of_output_are_no_matter():
    arm = Arm("acrobot")
    with config_context(transform_output="pandas"):
        model = InverseDynamics(arm.nominal, n_inducing=0).fit(arm.X, arm.y)
        assert model.predict(arm.new).shape == arm.new[:, :2].shape


def test_other_transformers_are_no_robots():
    with pytest.raises(TypeError, match="robot must be a name"):
        InverseDynamics(StandardScaler()).fit(np.zeros((5, 3)), np.zeros(5))


def test_two_trajectories_that_differ_widen_what_is_known(arm):
    rows = arm.groups < 2
    X, y, groups = arm.X[rows], arm.y[rows].copy(), arm.groups[rows]
    same = InverseDynamics("ur5", n_inducing=0).fit(X, y, groups=groups)
    y += np.where(groups == 0, 3.0, -3.0)[:, np.newaxis] * np.sin(X[:, :6])
    other = InverseDynamics("ur5", n_inducing=0).fit(X, y, groups=groups)
    seen = same.coef_std_ < 0.5 * same.coef_prior_scale_
    assert np.median(other.coef_std_[seen] / same.coef_std_[seen]) > 2.0


def test_bad_payloads_are_named(arm, rigid):
    with pytest.raises(ValueError, match="y has 2 columns"):
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
    free = InverseDynamics(n_inducing=0).fit(arm.X, arm.y)
    assert not hasattr(free, "estimate_payload")
