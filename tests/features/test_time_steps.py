"""Rows that end with their own time step: dt="column"."""

from functools import cache, partial

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.pipeline import make_union

from skevgp import EVGPRegressor, rollout
from skevgp.datasets import simulate
from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from skevgp.robots import layout_of

TERMS = ("acceleration", "gravity", "bias", "input")
PRIOR = {"known_rate": 0.6, "unknown_ratio": 5.0, "coupling_ratio": 0.5, "other_ratio": 0.02}
GUESSES = {"inverse_inertia": 2.0, **PRIOR}
# Each takes a robot and a dt: a number, which maps of gravity alone do not know, or "column".
MAPS = {
    "inertia": partial(InertiaForce, **GUESSES),
    "inertia and gravity": partial(InertiaForceGravity, gravity_gain=3.0, inverse_length=4.0, **GUESSES),
    "gravity": lambda robot, dt: LinkGravity(
        robot, inverse_length=4.0, unknown_ratio=5.0, coupling_ratio=0.5, dt=dt if dt == "column" else None
    ),
    "dynamics": partial(NominalDynamics, terms=TERMS, model_error=0.2, unknown_ratio=5.0, other_ratio=0.02),
}
each_map = pytest.mark.parametrize("kind", MAPS)
# A step that is not the default one, 0.03.
each_step = pytest.mark.parametrize("dt", [0.2, 0.002, pytest.param(0.03, marks=pytest.mark.long)])
ANY = {**MAPS, "angles": lambda robot, dt: AngleEncoder(robot, dt=dt)}
any_map = pytest.mark.parametrize("kind", ANY)


def rows(robot, n_rows=20, seed=0):
    """[q, q̇, u, Δt] of steps from 5 to 50 ms."""
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(-3.0, 3.0, (n_rows, layout_of(robot).n_columns)), rng.uniform(0.005, 0.05, n_rows)]
    )


def of_constant(kind, robot, X, dt):
    """The map with a number in place of the column, and its features."""
    features = MAPS[kind](robot, dt=dt)
    return features, features.fit_transform(X[:, :-1])


def kept(kind, robot):
    """How many columns of the state stand before what is multiplied by Δt."""
    return 2 * layout_of(robot).n_joints if "inertia" in kind else 0


# --- features ------------------------------------------------------------------------------------------------------


@each_map
@pytest.mark.parametrize("robot", ["cartpole", "acrobot", "iiwa14"])
def test_state_stays_and_features_are_multiplied_by_the_step_of_their_row(kind, robot):
    X, n_kept = rows(robot), kept(kind, robot)
    _, features = of_constant(kind, robot, X, 0.03)
    found = MAPS[kind](robot, dt="column").fit_transform(X)
    assert_array_equal(found[:, :n_kept], X[:, :n_kept])
    assert_allclose(found[:, n_kept:], X[:, -1:] * features, rtol=1e-14)


@pytest.mark.parametrize(
    ("features", "names"),
    [
        (InertiaForce, ["q", "dq/dt", "dt * q", "dt * dq/dt", "dt * u_q"]),
        (InertiaForceGravity, ["q", "dq/dt", "dt * q", "dt * dq/dt", "dt * u_q", "dt * sin(q)"]),
        (LinkGravity, ["dt * gravity(q, u_x)", "dt * gravity(q, u_y)"]),
        (NominalDynamics, ["dt * acc(q)"]),
        (AngleEncoder, ["sin(q)", "cos(q)", "dq/dt", "u_q", "dt"]),
    ],
)
def test_names_of_columns(features, names):
    X = rows("pendulum")
    fitted = features("pendulum", dt="column").fit(X)
    assert fitted.get_feature_names_out().tolist() == names
    frame = pd.DataFrame(X, columns=["q", "dq/dt", "u_q", "dt"])
    table = features("pendulum", dt="column").set_output(transform="pandas").fit_transform(frame)
    assert list(table.columns) == names
    assert_array_equal(table, fitted.transform(X))


@any_map
def test_without_a_robot_columns_are_what_they_were(kind):
    X = np.random.default_rng(0).normal(size=(5, 4))
    found = ANY[kind](None, dt="column").fit(X)
    plain = ANY[kind](None, dt=None if kind == "angles" else 0.03).fit(X)
    assert_array_equal(found.transform(X), plain.transform(X))
    assert_array_equal(found.jacobian(X), plain.jacobian(X))
    assert not hasattr(found, "coef_prior")


# --- derivatives ---------------------------------------------------------------------------------------------------


@any_map
@pytest.mark.parametrize("robot", ["pendulum", "cartpole", "acrobot", "iiwa14", "ur5"])
def test_central_differences_agree_by_all_columns(robot, kind):
    X = rows(robot, 30)
    features = ANY[kind](robot, dt="column").fit(X)
    columns = []
    for step in 1e-5 * np.minimum(1.0, np.abs(X).mean(axis=0)) * np.eye(X.shape[1]):
        columns.append((features.transform(X + step) - features.transform(X - step)) / (2.0 * step.max()))
    expected = np.stack(columns, axis=2)
    for own, by_differences in zip(features.jacobian(X), expected, strict=True):
        assert_allclose(own, by_differences, rtol=0.0, atol=1e-6 * np.abs(by_differences).max())
    assert np.abs(expected[:, :, -1]).max() > 0.0


# --- the prior -----------------------------------------------------------------------------------------------------


@each_map
@pytest.mark.parametrize("robot", ["pendulum", "cartpole", "acrobot", "iiwa14"])
@each_step
def test_at_a_constant_step_the_prior_mean_is_that_of_the_number(robot, kind, dt):
    X, n_states = rows(robot), 2 * layout_of(robot).n_joints
    X[:, -1] = dt
    constant, expected = of_constant(kind, robot, X, dt)
    features = MAPS[kind](robot, dt="column")
    found = features.fit_transform(X) @ features.coef_prior(n_states)[0].T
    expected = expected @ constant.coef_prior(n_states)[0].T
    assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * max(1.0, np.abs(expected).max()))


def covariances(features, H, left_over):
    """Prior covariance of each output between all rows, (n_states, n, n)."""
    _, scale = features.coef_prior(len(left_over))
    size = np.sqrt(np.mean(H**2, axis=0))
    in_units = features.coef_scale(left_over, np.where(size > 0.0, size, 1.0))
    assert_array_equal(np.isnan(in_units), ~np.isnan(scale))
    return np.einsum("np,op,mp->onm", H, np.where(np.isnan(scale), in_units, scale) ** 2, H)


@each_map
@pytest.mark.parametrize("robot", ["pendulum", "cartpole", "acrobot", "iiwa14"])
@each_step
def test_at_a_constant_step_the_prior_covariance_is_that_of_the_number(robot, kind, dt):
    X, n = rows(robot), layout_of(robot).n_joints
    X[:, -1] = dt
    left_of_velocity = np.random.default_rng(1).uniform(0.5, 2.0, n)
    if kind == "gravity":
        # Alone, gravity with the same step in all rows does not know it. So little is left that rates do not matter.
        left_of_velocity *= 1e-3
    left_over = np.hstack([dt * left_of_velocity, left_of_velocity])
    constant, H = of_constant(kind, robot, X, dt)
    expected, groups = covariances(constant, H, left_over), constant.coef_groups(2 * n)
    features = MAPS[kind](robot, dt="column")
    found = covariances(features, features.fit_transform(X), left_over)
    for own, of_number in zip(found, expected, strict=True):
        assert_allclose(own, of_number, rtol=1e-10, atol=1e-12 * of_number.max())
    if kept(kind, robot):
        # Newton's law gives the weight of a position for itself, but none to Δt times the position.
        groups[range(n), range(n)] = "other"
    assert_array_equal(features.coef_groups(2 * n)[:, kept(kind, robot) :], groups)


def test_weights_are_those_of_a_second():
    features = InertiaForceGravity(
        "cartpole", dt="column", inverse_inertia=0.1, gravity_gain=20.0, inverse_length=0.16, **PRIOR
    )
    X = rows("cartpole")
    step = X[:, -1].mean()
    features.fit(X)
    mean, own = features.coef_prior(4)
    rates = np.zeros((4, 6))
    rates[0, 2] = rates[1, 3] = 1.0
    rates[2, 4], rates[3, 5] = 0.1, -20.0
    assert_allclose(mean, np.hstack([np.eye(4), rates]), rtol=1e-12)
    # The weights of the state stay.
    groups = features.coef_groups(4)
    assert_array_equal(own[:, :4], 0.0)
    assert_array_equal(groups[:, :4], "")
    # For velocities x and theta; for positions, all is multiplied by the mean step.
    known, unknown, coupling, other = 0.6, 5.0, 0.5, 0.02
    nan = np.nan
    of_rates = np.array([[nan, nan, known, nan, nan, nan], [nan, nan, nan, known, nan, nan]])
    assert_allclose(own[:, 4:], np.vstack([step * of_rates, of_rates]), rtol=1e-12)
    left_over, size = np.array([1.0, 2.0, 3.0, 4.0]), np.arange(1.0, 11.0)
    all_but_gravity = [[other, other, nan, other, unknown], [other, other, other, nan, coupling * unknown]]
    ratios = np.column_stack([all_but_gravity, [coupling * unknown, unknown]])
    of_rates = ratios * [[3.0], [4.0]] / size[4:]
    # Gravity moves theta by at most g / l, but the data leave less of x than a share of that.
    assert of_rates[1, -1] > 9.81 * 0.16
    assert of_rates[0, -1] < coupling * 9.81 * 0.16
    of_rates[1, -1] = 9.81 * 0.16
    in_units = features.coef_scale(left_over, size)
    assert np.isnan(in_units[:, :4]).all()
    assert_allclose(in_units[:, 4:], np.vstack([step * of_rates, of_rates]), rtol=1e-12)


# --- errors --------------------------------------------------------------------------------------------------------


@any_map
@pytest.mark.parametrize("bad", [0.0, -0.01, np.nan, np.inf, -np.inf])
def test_invalid_time_step_raises(kind, bad):
    X = rows("pendulum")
    features = ANY[kind]("pendulum", dt="column").fit(X)
    X[3, -1] = bad
    for method in (features.transform, features.jacobian, features.fit):
        with pytest.raises(
            ValueError, match=rf"dt, the last column of X.* must be positive and finite; row 3 has {bad}"
        ):
            method(X)


@any_map
def test_invalid_width_says_what_the_last_column_is(kind):
    X = rows("pendulum")
    message = r"X has 3 columns, but .* needs 4: \['q', 'dq/dt', 'u_q', 'dt'\]; the last one, dt, is the time step"
    with pytest.raises(ValueError, match=message):
        ANY[kind]("pendulum", dt="column").fit(X[:, :-1])
    plain = ANY[kind]("pendulum", dt=None if kind == "angles" else 0.03)
    with pytest.raises(
        ValueError, match=r"needs 3: \['q', 'dq/dt', 'u_q'\]\. .* the time step of each row, pass dt=\"column\""
    ):
        plain.fit(X)


@any_map
@pytest.mark.parametrize("columns", [["dt", "q", "dq/dt", "u_q"], ["a", "dt", "b", "c"]])
def test_step_must_be_the_last_column(kind, columns):
    with pytest.raises(ValueError, match=r"in the robot's order \['q', 'dq/dt', 'u_q', 'dt'\]; got \["):
        ANY[kind]("pendulum", dt="column").fit(pd.DataFrame(np.abs(rows("pendulum")), columns=columns))


@any_map
def test_any_other_word_raises(kind):
    with pytest.raises(ValueError, match="The 'dt' parameter of .* must be .*'column'.* Got 'row' instead"):
        ({**ANY, "gravity": LinkGravity}[kind]("pendulum", dt="row")).fit(rows("pendulum"))


def test_step_of_gravity_is_that_of_the_map_around_it():
    X = rows("acrobot")
    with pytest.raises(ValueError, match=r"gravity=LinkGravity\(dt='column'\) must leave dt to InertiaForceGravity"):
        InertiaForceGravity("acrobot", dt="column", gravity=LinkGravity(dt="column")).fit(X)
    levers = InertiaForceGravity("acrobot", dt="column", gravity=LinkGravity(axes="x")).fit_transform(X)
    assert_array_equal(levers[:, 9:], LinkGravity("acrobot", axes="x", dt="column").fit_transform(X))


# --- models of logs ------------------------------------------------------------------------------------------------

# Of dq/dt' = dq/dt + Δt (4 u - 0.4 dq/dt - 19.62 sin q): weights of Δt q, Δt q̇, Δt u and Δt sin q.
PENDULUM = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, -0.4, 4.0, -19.62]])


def log(n_trajectories, n_steps, seed, shortest=0.005, longest=0.05):
    """A pendulum under random torques: X with a step for each time, next states, and trajectories."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(-1.5, 1.5, (n_trajectories, 2))
    X, y = [], []
    for dt in rng.uniform(shortest, longest, n_steps):
        u = rng.uniform(-2.0, 2.0, (n_trajectories, 1))
        X.append(np.column_stack([z, u, np.full(n_trajectories, dt)]))
        z = simulate("pendulum", z, u[:, np.newaxis], dt)[:, 1]
        y.append(z)
    return np.vstack(X), np.vstack(y), np.tile(np.arange(n_trajectories), n_steps)


QUICK = {"n_inducing": 10, "sharing": "none", "noise_cv": None, "max_iter": 30}


def model(features, **settings):
    """With or without features the kernel sees Δt."""
    encoder = AngleEncoder("pendulum", dt="column")
    return EVGPRegressor(features, kernel_map=encoder, random_state=0, **settings)


def with_physics(**settings):
    return model(InertiaForceGravity("pendulum", dt="column"), **settings)


@cache
def of_log():
    """A log and a model of it, fitted once."""
    X, y, groups = log(8, 25, seed=0)
    return X, y, groups, with_physics(**QUICK).fit(X, y, groups=groups)


def errors(physics, X, y, groups, X_new, y_new, **settings):
    """Root mean square errors (2,) with physics, and of a Gaussian process of what changes in a step."""
    physics = physics.predict(X_new)
    plain = model(None, **settings).fit(X, y - X[:, :2], groups=groups).predict(X_new) + X_new[:, :2]
    return (np.sqrt(np.mean((mean - y_new) ** 2, axis=0)) for mean in (physics, plain))


of_short_fits = [
    pytest.mark.filterwarnings("ignore:The bound was still rising"),
    pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning"),
]


class TestLogs:
    pytestmark = of_short_fits

    def test_physics_learns_from_uneven_steps_what_a_column_alone_does_not_tell(self):
        X, y, groups, fitted = of_log()
        physics, plain = errors(fitted, X, y, groups, *log(20, 20, seed=1)[:2], **QUICK)
        assert physics[0] < 1.2 * plain[0]
        assert physics[1] < 0.6 * plain[1]

    @pytest.mark.long
    def test_what_short_steps_tell_holds_for_long_ones(self):
        """Geometric mean of three logs: what a kernel alone says of longer steps is chance, and may be good."""
        ratios = []
        for seed in (0, 10, 20):
            X, y, groups = log(8, 25, seed, longest=0.02)
            settings = {"n_inducing": 20, "max_iter": 60}
            fitted = with_physics(**settings).fit(X, y, groups=groups)
            new = log(20, 50, seed + 1, shortest=0.04)[:2]
            physics, plain = errors(fitted, X, y, groups, *new, **settings)
            ratios.append(physics / plain)
        assert (np.exp(np.mean(np.log(ratios), axis=0)) < 0.7).all()

    def test_weights_are_physics_within_their_std_and_what_eulers_rule_neglects(self):
        """What it neglects is ½ Δt times the rate of the rates: 19.62 of the angle's, 4 of the torque's."""
        X, y, groups, _ = of_log()
        y = y + [0.002, 0.02] * np.random.default_rng(0).standard_normal(y.shape)
        fitted = with_physics(**QUICK).fit(X, y, groups=groups)
        assert_array_equal(fitted.coef_[:, :2], np.eye(2))
        weights, std = fitted.coef_[:, 2:], fitted.coef_std_[:, 2:]
        neglected = 0.05 * np.array([[19.62, 0.4, 4.0, 19.62], [8.0, 19.62, 1.6, 8.0]])
        assert (np.abs(weights - PENDULUM) < 4.0 * std + neglected).all()
        # All of it is far less than what there is to know.
        assert std[1, 2] < 0.2
        assert std[1, 3] < 5.0

    def test_a_controller_gives_its_steps_too_and_rollouts_follow_the_pendulum(self):
        *_, fitted = of_log()
        path, states, _ = log(1, 30, seed=2)
        U = path[:, 2:]
        for method in ("sample", "linearized", "mean"):
            ahead = rollout(fitted, path[0, :2], U, method=method, n_samples=20, random_state=0)
            assert (np.abs(ahead.mean - states).max(axis=0) < 0.1 * np.ptp(states, axis=0)).all()
        played = rollout(fitted, path[0, :2], lambda z, t: U[t], n_steps=30, method="mean")
        assert_allclose(played.mean, ahead.mean, rtol=1e-12)
        with pytest.raises(ValueError, match=r"U must be of shape \(n_steps, 2\).*rows of the regressor are \[z, u\]"):
            rollout(fitted, path[0, :2], U[:, :1])
        for method in ("sample", "linearized", "mean"):
            with pytest.raises(ValueError, match=r"dt, the last column of X.*row 0 has 0\.0"):
                rollout(fitted, path[0, :2], U * [1.0, 0.0], method=method)

    def test_what_is_compiled_predicts_and_is_differentiated_by_the_step_too(self):
        X, y, groups = log(6, 15, seed=0)
        union = make_union(InertiaForceGravity("pendulum", dt="column"), NominalDynamics("pendulum", dt="column"))
        fitted = model(union, **QUICK).fit(X, y, groups=groups)
        rows, h = X[:5], 1e-6
        mean, slopes = fitted.compile().value_and_jacobian(rows)
        assert_allclose(mean, fitted.predict(rows), rtol=1e-10)
        both = [fitted.predict(rows + sign * h * np.eye(4)[3]) for sign in (1.0, -1.0)]
        assert_allclose(slopes[:, :, 3], (both[0] - both[1]) / (2.0 * h), rtol=1e-4, atol=1e-5)
        assert np.abs(slopes[:, 1, 3]).max() > 1.0

    def test_a_step_that_is_none_is_named_by_the_regressor(self):
        X, y, groups = log(6, 5, seed=0)
        X[7, 3] = 0.0
        with pytest.raises(ValueError, match=r"dt, the last column of X.* must be positive and finite"):
            with_physics().fit(X, y, groups=groups)
