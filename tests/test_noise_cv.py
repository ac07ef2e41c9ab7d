"""noise_cv and groups: noise and signal variance, and so a std, that holds for what was left out."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import CoefPrior, EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.exceptions import DependentRowsWarning
from skevgp.features import InertiaForceGravity
from skevgp.metrics import containing_ratios, negative_log_predictive_density
from skevgp.solvers import LBFGS, SOLVERS

# A few iterations are enough.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def trajectories(n, seed, length=100):
    """Slow walks through a square, one after the other, over a function too rough for few inducing points."""
    rng = np.random.RandomState(seed)
    t = np.linspace(0.0, 1.0, length)[:, np.newaxis]
    X = np.vstack([rng.uniform(-2, 2, 2) + t * rng.uniform(-1, 1, 2) for _ in range(n)])
    Y = np.column_stack([np.sin(4 * X[:, 0]) * np.cos(3 * X[:, 1]), np.cos(3 * X.sum(axis=1)) + X[:, 1]])
    return X, Y + 0.01 * rng.randn(*Y.shape), np.repeat(np.arange(n), length)


X, Y, GROUPS = trajectories(20, 0)
X_NEW, Y_NEW, _ = trajectories(40, 1)


def model(**arguments):
    # What outputs share is another subject, and trial fits of it would take most of the time.
    defaults = {"feature_map": PolynomialFeatures(1), "n_inducing": 12, "sharing": "all", "max_iter": 30}
    defaults |= {"random_state": 0}
    return EVGPRegressor(**{**defaults, **arguments})


def fitted(groups=GROUPS, X=X, Y=Y, **arguments):
    return model(**arguments).fit(X, Y, groups=groups)


def independent(n=2000, noise=(0.1, 0.5), seed=0):
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2, 2, (n, 2))
    return X, np.column_stack([np.sin(X[:, 0]), X[:, 0] * X[:, 1]]) + np.array(noise) * rng.randn(n, 2)


def mean_square_z(m):
    """Of each output on new trajectories; 1 if std is honest."""
    mean, std = m.predict(X_NEW, return_std=True)
    return np.mean(((Y_NEW - mean) / std) ** 2, axis=0)


def nlpd(m, X, Y):
    return negative_log_predictive_density(Y, *m.predict(X, return_std=True))


def test_on_new_trajectories_as_many_rows_as_should_lie_within_the_std():
    normal = np.array([0.683, 0.954, 0.997])
    plain, calibrated = (fitted(noise_cv=noise_cv) for noise_cv in (None, 10))
    ratios = [containing_ratios(Y_NEW, *m.predict(X_NEW, return_std=True)) for m in (plain, calibrated)]
    assert (ratios[0] < normal).all()
    assert (np.abs(ratios[1] - normal) < 0.7 * np.abs(ratios[0] - normal)).all()
    assert nlpd(calibrated, X_NEW, Y_NEW) < nlpd(plain, X_NEW, Y_NEW)


def test_what_few_points_cannot_represent_is_not_taken_for_noise():
    rng = np.random.RandomState(0)
    X = rng.uniform(-3, 3, (1600, 2))
    y = np.sin(4 * X[:, 0]) * np.cos(3 * X[:, 1]) + 0.05 * rng.randn(1600)
    train, test = slice(0, 800), slice(800, None)
    plain, calibrated = (model(n_inducing=60, noise_cv=cv).fit(X[train], y[train]) for cv in (None, 5))
    assert calibrated.noise_variance_ < 0.9 * plain.noise_variance_
    assert nlpd(calibrated, X[test], y[test]) < nlpd(plain, X[test], y[test])


# Each pair of sharing, solver and posterior is quick. Their other products are long.
@pytest.mark.parametrize(
    ("sharing", "feature_map", "solver", "posterior"),
    [
        ("all", None, "lbfgs", "full"),
        ("all", None, "adam", "diagonal"),
        ("none", PolynomialFeatures(1), "lbfgs", "diagonal"),
        ("none", PolynomialFeatures(1), "adam", "full"),
        pytest.param("all", None, "lbfgs", "diagonal", marks=pytest.mark.long),
        pytest.param("all", None, "adam", "full", marks=pytest.mark.long),
        pytest.param("none", PolynomialFeatures(1), "lbfgs", "full", marks=pytest.mark.long),
        pytest.param("none", PolynomialFeatures(1), "adam", "diagonal", marks=pytest.mark.long),
    ],
)
def test_it_calibrates_whatever_is_fitted_and_leaves_the_rest(feature_map, sharing, solver, posterior):
    settings = {"feature_map": feature_map, "sharing": sharing, "solver": SOLVERS[solver](posterior=posterior)}
    # Too few rows for a sample, and iterations for a good fit: there is much to calibrate.
    settings |= {"max_iter": 10, "X": X[:1900], "Y": Y[:1900], "groups": GROUPS[:1900]}
    plain, calibrated = (fitted(**settings, noise_cv=noise_cv) for noise_cv in (None, 5))
    np.testing.assert_array_equal(calibrated.inducing_points_, plain.inducing_points_)
    np.testing.assert_array_equal(*([k.k2.theta for k in m.kernel_] for m in (calibrated, plain)))
    np.testing.assert_array_equal(calibrated.loss_curve_, plain.loss_curve_)
    before, z = mean_square_z(plain), mean_square_z(calibrated)
    assert (before > 2.0).all()
    assert (z > 0.3).all()
    assert (z < 2.5).all()
    assert (z < before).all()


@pytest.mark.parametrize("posterior", ["full", "diagonal"])
def test_bound_of_data_without_noise_keeps_its_digits(posterior):
    """Taken from sums over the rows, where digits cancel, it was off by 0.02 nats here, and by 50 at less noise."""
    x = np.linspace(0.0, 1.0, 200)[:, np.newaxis]
    y = 3.0 + 2.0 * x[:, 0]
    m = EVGPRegressor(n_inducing=10, solver=LBFGS(posterior=posterior), random_state=0).fit(x, y)
    kernel = m.kernel_ + WhiteKernel(m.noise_variance_, "fixed")
    same = EVGPRegressor(
        kernel=kernel, inducing_init=m.inducing_points_, solver=LBFGS(posterior=posterior), max_iter=0
    ).fit(x, y)
    assert m.lower_bound_ == pytest.approx(same.lower_bound_, abs=1e-3)


def test_calibration_of_independent_outputs():
    """What suits each given the others as fitted, suits none once all have moved: a noise 1e5 times too large."""
    rng = np.random.RandomState(0)

    def targets(X):
        waves = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], np.cos(X[:, 1]), X[:, 2] ** 2])
        return waves + np.array([0.1, 0.1, 0.01]) * rng.randn(len(X), 3)

    X, X_new = rng.uniform(-2, 2, (60, 3)), rng.uniform(-2, 2, (300, 3))
    Y, Y_new = targets(X), targets(X_new)
    arguments = {"feature_map": PolynomialFeatures(4), "coef_prior": CoefPrior(shared=True), "max_iter": 20}
    arguments["sharing"] = "none"
    plain, calibrated = (model(noise_cv=noise_cv, **arguments).fit(X, Y) for noise_cv in (None, 5))
    assert nlpd(calibrated, X_new, Y_new) < nlpd(plain, X_new, Y_new) + 1.0


def test_fixed_noise_and_signal_are_kept():
    kernel = ConstantKernel() * RBF([1.0, 1.0]) + WhiteKernel(0.3, "fixed")
    plain, noise_fixed = (fitted(None, kernel=kernel, max_iter=5, noise_cv=noise_cv) for noise_cv in (None, 5))
    np.testing.assert_allclose(noise_fixed.noise_variance_, 0.3)
    # The lowest noise counts as none, and then the signal does not rise.
    signals, calibrated = ([kernel.k1.constant_value for kernel in own.kernel_] for own in (plain, noise_fixed))
    assert (np.array(calibrated) <= (1.0 + 1e-9) * np.array(signals)).all()
    signal_fixed = fitted(kernel=ConstantKernel(1.0, "fixed") * RBF([1.0, 1.0]), max_iter=5)
    np.testing.assert_allclose([k.k1.constant_value for k in signal_fixed.kernel_], 1.0)
    plain, both = (
        fitted(
            kernel=ConstantKernel(1.0, "fixed") * RBF([1.0, 1.0]) + WhiteKernel(0.3, "fixed"), max_iter=5, noise_cv=cv
        )
        for cv in (None, 5)
    )
    np.testing.assert_array_equal(both.predict(X_NEW), plain.predict(X_NEW))


@pytest.mark.parametrize("n_rows", [49, 2000])
def test_without_iterations_or_with_few_rows_it_is_left_out(n_rows):
    settings = {"X": X[:n_rows], "Y": Y[:n_rows], "groups": GROUPS[:n_rows], "max_iter": 0 if n_rows > 49 else 5}
    plain, same = (fitted(**settings, noise_cv=noise_cv) for noise_cv in (None, 5))
    np.testing.assert_array_equal(same.noise_variance_, plain.noise_variance_)


def test_points_at_all_rows_leave_nothing_to_folds_but_to_groups():
    X, Y = independent(60)
    plain, m = (model(n_inducing=60, max_iter=5, noise_cv=cv).fit(X, Y) for cv in (None, 5))
    np.testing.assert_array_equal(m.noise_variance_, plain.noise_variance_)
    grouped = model(n_inducing=60, max_iter=5).fit(X, Y, groups=np.arange(60) // 6)
    assert (grouped.noise_variance_ != plain.noise_variance_).all()
    assert np.isfinite(grouped.predict(X_NEW, return_std=True)).all()


def test_labels_may_be_anything():
    some = {"X": X[:600], "Y": Y[:600, 0], "noise_cv": 6, "max_iter": 5}
    m = fitted([None if g == 0 else f"{g}" for g in GROUPS[:600]], **some)
    expected = fitted(GROUPS[:600], **some)
    # One group is one fold, whatever it is called; which of them comes first is a matter of rounding.
    np.testing.assert_allclose(m.noise_variance_, expected.noise_variance_, rtol=1e-6)


@pytest.mark.parametrize("groups", [GROUPS[:-1], np.column_stack([GROUPS, GROUPS]), 3, "words"])
def test_groups_of_a_wrong_length_raise(groups):
    with pytest.raises(ValueError, match=r"groups must have the shape \(n_samples,\) = \(2000,\); got \("):
        fitted(groups)


def test_labels_are_one_for_each_row():
    with pytest.raises(ValueError, match="groups must be one label for each row"):
        fitted([[1], [1, 2]] * 1000)


@pytest.mark.parametrize("noise_cv", [1, 0, -3, True, 2.0, "10"])
def test_invalid_number_of_folds_raises(noise_cv):
    with pytest.raises(ValueError, match="The 'noise_cv' parameter of EVGPRegressor must be"):
        fitted(noise_cv=noise_cv)


@pytest.mark.parametrize(("sharing", "groups"), [("all", None), ("none", GROUPS[:300])])
@pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning")
def test_same_bits_for_any_n_jobs(sharing, groups, monkeypatch):
    monkeypatch.setattr("skevgp.data.blocks._MIN_BLOCK_ROWS", 64)
    monkeypatch.setattr("skevgp.data.blocks._WORTH_THREADS", 0)
    monkeypatch.setattr("skevgp.data.blocks._BLOCK_NUMBERS", 64)
    options = {"X": X[:300], "Y": Y[:300], "sharing": sharing, "max_iter": 3, "noise_cv": 3}
    fits = [fitted(groups, n_jobs=n_jobs, **options) for n_jobs in (1, 3)]
    np.testing.assert_array_equal(fits[0].noise_variance_, fits[1].noise_variance_)
    np.testing.assert_array_equal(fits[0].predict(X_NEW), fits[1].predict(X_NEW))


@pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning")
def test_partial_fit_keeps_noise_and_signal():
    rows_new, targets_new = X_NEW[:600], Y_NEW[:600]
    m = model(max_iter=5).partial_fit(X[:600], Y[:600])
    noise, std = m.noise_variance_, m.predict(rows_new, return_std=True, include_noise=False)[1]
    np.testing.assert_array_equal(noise, fitted(None, X[:600], Y[:600], max_iter=5).noise_variance_)
    theta = [k.theta for k in m.kernel_]
    m.partial_fit(rows_new, targets_new)
    np.testing.assert_array_equal(m.noise_variance_, noise)
    np.testing.assert_array_equal([k.theta for k in m.kernel_], theta)
    assert (m.predict(rows_new, return_std=True, include_noise=False)[1] < std).all()


@pytest.mark.parametrize("sharing", ["all", "none"])
def test_ctrl_c_leaves_it_out(sharing):
    def interrupt(iteration, bound, outputs):
        if iteration == 3:
            raise KeyboardInterrupt

    noise = []
    for noise_cv in (None, 5):
        with pytest.warns(ConvergenceWarning, match="interrupted after 3 iterations"):
            m = fitted(sharing=sharing, noise_cv=noise_cv, solver=LBFGS(callback=interrupt))
        noise.append(m.noise_variance_)
    np.testing.assert_array_equal(*noise)


def test_rows_of_trajectories_without_groups_are_warned_of_once():
    with pytest.warns(DependentRowsWarning, match=r"Pass groups to fit\(X, y, groups=\.\.\.\)") as caught:
        fitted(None, sharing="none", max_iter=10)
    assert len([own for own in caught if own.category is DependentRowsWarning]) == 1


def test_trajectories_are_warned_of_even_if_their_noise_would_not_be_much_larger():
    """Where nothing is known, std is large anyway: log density tells."""
    data = make_dynamics("pendulum", 10, random_state=0)
    with pytest.warns(DependentRowsWarning):
        model(feature_map=InertiaForceGravity("pendulum"), n_inducing=60, max_iter=10).fit(data.data, data.target)


def _one_output():
    X, Y = independent(500)
    return X, Y[:, 0]


def _sorted_by_y():
    """Of a function whose highest values are in a corner, where blocks of rows are predicted worse."""
    X, _ = independent(400)
    y = np.exp(X[:, 0]) + 0.3 * np.random.RandomState(1).randn(400)
    return X[np.argsort(y)], np.sort(y)


def test_group_of_most_rows_is_not_predicted_from_the_few_others():
    rng = np.random.RandomState(0)
    X = rng.uniform(-3, 3, (400, 2))
    y = np.sin(3 * X[:, 0]) * np.cos(2 * X[:, 1]) + 0.1 * rng.randn(400)
    m = EVGPRegressor(n_inducing=80, max_iter=50, random_state=0).fit(X, y, groups=np.repeat([0, 1, 2], [380, 10, 10]))
    assert 0.05 < np.sqrt(m.noise_variance_) < 0.2


@pytest.mark.parametrize(
    "fit",
    [
        lambda: fitted(sharing="none", max_iter=10),
        lambda: fitted(None, *_sorted_by_y()),
        lambda: fitted(None, noise_cv=None, max_iter=10),
        lambda: fitted(None, *(part[np.random.RandomState(0).permutation(len(X))] for part in (X, Y[:, 0]))),
        lambda: fitted(None, *_one_output()),
        lambda: fitted(None, *(part[np.argsort(_one_output()[0][:, 0])] for part in _one_output())),
    ],
    ids=["groups", "sorted by y", "not calibrated", "shuffled", "independent", "sorted"],
)
def test_unrelated_rows_do_not_warn(fit):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DependentRowsWarning)
        fit()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 3))])
def test_signal_falls_if_it_does_not_hold_for_other_groups(seed):
    """Groups overlap, and each has a phase of its own."""
    rng = np.random.RandomState(seed)
    groups = np.repeat(np.arange(12), 25)
    X = rng.uniform(-1, 1, (12, 2))[groups] + 0.4 * rng.randn(300, 2)
    y = np.sin(2 * X[:, 0] + rng.uniform(0, 2 * np.pi, 12)[groups]) + 0.1 * rng.randn(300)
    alone = EVGPRegressor(n_inducing=60, noise_cv=None, random_state=0).fit(X, y)
    m = EVGPRegressor(n_inducing=60, random_state=0).fit(X, y, groups=groups)
    assert m.kernel_.k1.constant_value < 0.5 * alone.kernel_.k1.constant_value
    assert m.noise_variance_ > alone.noise_variance_


@pytest.mark.parametrize("apart", [True, False])
def test_gaussian_process_that_no_other_group_confirms_warns(apart):
    """Groups far apart say nothing about each other, though the Gaussian process explains the rows of each."""
    rng, groups = np.random.RandomState(0), np.repeat(np.arange(6), 15)
    t = np.tile(np.linspace(0.0, 3.0, 15), 6)
    own = (rng.randn(6) + np.sin(2.0 * t.reshape(6, 15).T + rng.uniform(0.0, 6.0, 6))).T.ravel()
    X, y = (20.0 * groups + t, own) if apart else (t, np.sin(2.0 * t))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fitted(groups, X[:, np.newaxis], y + 0.05 * rng.randn(90), feature_map=None, n_inducing=30)
    said = [str(one.message) for one in caught]
    assert any("does not improve predictions of left-out groups for 1 of 1 outputs" in one for one in said) == apart
