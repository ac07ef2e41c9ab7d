"""feature_report: what a model loses without each group of its features, and its display."""

import sys
from itertools import chain

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from sklearn.model_selection import GroupKFold, KFold
from sklearn.preprocessing import FunctionTransformer

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, FeatureReport, feature_report
from skevgp.estimators.report import FeatureGroup, _verdict
from skevgp.features import RigidBodyRegressor
from skevgp.plotting import FeatureReportDisplay

mpl.use("Agg")
EVIL = "<script>alert(1)</script>"
SHORT = RBF(0.1, "fixed")
# Also of fits that are short on purpose.
of_short_fits = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def line(seed=0, n=90):
    """Rows of (slope, noise, trajectory of ten rows), and y that is linear in the first."""
    rng = np.random.RandomState(seed)
    X = np.column_stack([rng.uniform(-3.0, 3.0, (n, 2)), np.arange(n) // 10])
    return X, 5.0 * X[:, 0] + 0.1 * rng.randn(n)


def columns(*indices):
    return FunctionTransformer(lambda X: np.asarray(X)[:, list(indices)])


def exact(features=(0, 1), mean=(0.5, 2.0), labels=("slope", "noise"), kernel=RBF(0.5, "fixed")):  # noqa: B008
    """Only the scales of groups are learned."""
    prior = CoefPrior([mean[i] for i in features], 2.0, groups=[labels[i] for i in features])
    fixed = {"kernel": ConstantKernel(0.01, "fixed") * kernel, "alpha": 0.01}
    return EGPRegressor(columns(*features), kernel_map=columns(0), coef_prior=prior, **fixed)


def sparse(labels=("slope", "noise"), kernel=SHORT, **parameters):
    options = {"n_inducing": 5, "max_iter": 50, "noise_cv": None, "random_state": 0} | parameters
    prior = CoefPrior(0.0, 1.0, groups=list(labels))
    return EVGPRegressor(columns(0, 1), kernel, kernel_map=columns(0), **({"coef_prior": prior} | options))


def by_name(report):
    return {one.group: one for one in report.groups}


# --- verdicts ------------------------------------------------------------------------------------------------------


@of_short_fits
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 5))])
def test_slope_helps_and_noise_does_nothing(seed):
    """A short kernel at five points does not interpolate the slope. A weight of 0 ± 0.003 changes nothing."""
    X, y = line(seed, 1000)
    model = sparse(random_state=seed, max_iter=20).fit(X, y)
    report = feature_report(model, X, y, n_splits=2, random_state=seed)
    assert [one.group for one in report.groups] == ["slope", "noise", "all features"]
    slope, noise, everything = report.groups
    assert (slope.verdict, noise.verdict, everything.verdict) == ("helps", "does nothing", "helps")
    # Without it, y has a standard deviation of 5 √3 in place of 0.1, of which the kernel explains a little.
    assert slope.held_out_loss == pytest.approx(np.log(5.0 * np.sqrt(3.0) / 0.1), abs=0.5)
    assert slope.bound_loss == pytest.approx(slope.held_out_loss, abs=0.2)
    assert "slope: helps. Without it, the log density of a held-out row falls by 4." in str(report)
    assert "noise: does nothing." in str(report)


@of_short_fits
@pytest.mark.parametrize(("label", "verdict"), [("", "hurts"), ("wrong", "does nothing")])
def test_wrong_prior_hurts_unless_its_scale_is_learned(label, verdict):
    """The kernel does not see the second column, so that it cannot undo a weight of 1 ± 0.001."""
    # With fewer rows, what the wrong group loses by chance would be near the least that counts.
    X, y = line(n=1000)
    prior = CoefPrior([0.0, 1.0], [10.0, 1e-3], groups=["slope", label])
    report = by_name(feature_report(sparse(coef_prior=prior, max_iter=30).fit(X, y), X, y, n_splits=2))
    assert report["slope"].verdict == "helps"
    wrong = report[label or "features"]
    assert wrong.verdict == verdict
    if label:
        assert wrong.scale_factor > 100.0
    else:
        assert wrong.scale_factor == 1.0
        # It adds a standard deviation of √3 to one of 0.1.
        assert wrong.held_out_loss == pytest.approx(-np.log(np.sqrt(3.0) / 0.1), abs=0.2)
        assert "Without it, the log density of a held-out row rises by 2." in str(wrong)


@of_short_fits
def test_groups_without_labels_and_weights_that_stay():
    X, y = line(n=60)
    prior = CoefPrior([0.0, 1.0], [10.0, 0.0])
    report = feature_report(sparse(coef_prior=prior).fit(X, y))
    # A weight that stays is left out with all of them only.
    assert [(one.group, one.n_weights) for one in report.groups] == [("features", 1), ("all features", 2)]


@pytest.mark.parametrize(
    ("losses", "verdict"),
    [
        ([0.5] * 6, "helps"),
        ([-0.5] * 6, "hurts"),
        ([0.5] * 5, "unclear"),  # five signs agree by chance once in 16 times
        ([1.0, -1.0] * 10, "unclear"),
        ([0.0] * 6, "does nothing"),
        ([0.005] * 100, "does nothing"),  # sure, and too small to matter
        ([0.005, -0.005] * 3, "does nothing"),
    ],
)
def test_verdict_on_losses(losses, verdict):
    losses = np.array(losses)
    assert _verdict(losses, losses.mean(), losses.std(ddof=1) / np.sqrt(len(losses))) == verdict


def test_verdict_agrees_with_its_sentence():
    """A feature that is a little good for most rows, and very bad for one."""
    losses = np.array([1.0] * 20 + [-30.0])
    assert losses.mean() < 0.0
    assert _verdict(losses, losses.mean(), losses.std(ddof=1) / np.sqrt(21)) != "helps"


# --- numbers -------------------------------------------------------------------------------------------------------


@of_short_fits
def test_numbers_without_data_are_those_of_the_weights():
    X, y = line()
    scale, groups = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([["a", "b"], ["a", ""]], dtype=object)
    prior = CoefPrior(np.ones((2, 2)), scale, groups=groups)
    model = sparse(coef_prior=prior, sharing="all").fit(X, np.column_stack([y, -3.0 * y + X[:, 1]]))
    report = feature_report(model)
    assert report.held_out == ""
    assert [one.group for one in report.groups] == ["a", "b", "features", "all features"]
    masks = [groups == "a", groups == "b", groups == "", np.ones((2, 2), dtype=bool)]
    for one, own in zip(report.groups, masks, strict=True):
        learned = model.coef_prior_scale_[own]
        z, std = (model.coef_ - 1.0)[own] / learned, model.coef_std_[own] / learned
        assert one.n_weights == own.sum()
        assert_allclose(
            [one.scale_factor, one.moved, one.std_ratio],
            [np.prod(learned / scale[own]) ** (1 / own.sum()), np.sqrt(np.mean(z**2)), np.sqrt(np.mean(std**2))],
        )
        assert np.isnan([one.bound_loss, one.held_out_loss, one.held_out_error]).all()
        assert one.verdict == "unknown"
    assert report.groups[0].scale_factor > 1.1
    assert str(report).endswith("all features: pass X and y to see whether the features help.")


@pytest.mark.parametrize("by_trajectory", [False, True])
def test_losses_are_those_of_models_without_the_feature(by_trajectory):
    """A weight of 0 is a feature that is not there."""
    X, y = line(n=40)
    model, groups = exact().fit(X, y), X[:, 2] if by_trajectory else None
    report = by_name(feature_report(model, X, y, groups=groups, n_splits=2, random_state=3))
    splits = GroupKFold(2).split(X, y, groups) if by_trajectory else KFold(2, shuffle=True, random_state=3).split(X)
    splits = list(splits)

    def held_out(own):
        bounds, densities = [], []
        for train, test in splits:
            own.fit(X[train], y[train])
            bounds.append(own.log_marginal_likelihood_value_ / len(train))
            density = norm.logpdf(y[test], *own.predict(X[test], return_std=True))
            if by_trajectory:
                density = [density[X[test, 2] == label].mean() for label in np.unique(X[test, 2])]
            densities += list(density)
        return np.array(bounds), np.array(densities)

    bounds, densities = held_out(exact())
    others = {
        "slope": exact(features=[1]),
        "noise": exact(features=[0]),
        "all features": exact().set_params(feature_map=None, coef_prior="auto"),
    }
    for name, own in others.items():
        without = held_out(own)
        losses = densities - without[1]
        found = report[name]
        assert found.bound_loss == pytest.approx(np.mean(bounds - without[0]), rel=1e-6, abs=1e-8)
        assert found.held_out_loss == pytest.approx(losses.mean(), rel=1e-6, abs=1e-8)
        assert found.held_out_error == pytest.approx(losses.std(ddof=1) / np.sqrt(len(losses)), rel=1e-5)


def test_y_may_have_one_column():
    X, y = line(n=30)
    assert feature_report(exact().fit(X, y[:, np.newaxis]), X, y[:, np.newaxis], n_splits=2) == feature_report(
        exact().fit(X, y), X, y, n_splits=2
    )


def test_data_frames_are_split_like_arrays():
    X, y = line(n=30)
    frame = pd.DataFrame(X, columns=["a", "b", "trajectory"], index=range(100, 130))
    target = pd.Series(y, index=frame.index)
    of_frame = feature_report(exact().fit(frame, target), frame, target, groups=frame["trajectory"], n_splits=2)
    of_array = feature_report(exact().fit(X, y), X, y, groups=X[:, 2], n_splits=2)
    assert of_frame.held_out == of_array.held_out == "trajectories"
    pd.testing.assert_frame_equal(of_frame.to_frame(), of_array.to_frame(), rtol=1e-6)


@of_short_fits
def test_whole_trajectories_are_held_out_once(monkeypatch):
    X, y = line()
    model, trained, tested = sparse(max_iter=0).fit(X, y), [], []
    fit, predict = EVGPRegressor.fit, EVGPRegressor.predict

    def recorded_fit(self, X, y, *, groups):
        assert_array_equal(groups, X[:, 2])  # for noise_cv
        trained.append(set(X[:, 2]))
        return fit(self, X, y, groups=groups)

    def recorded_predict(self, X, **options):
        tested.append(X[:, 2].tolist())
        return predict(self, X, **options)

    monkeypatch.setattr(EVGPRegressor, "fit", recorded_fit)
    monkeypatch.setattr(EVGPRegressor, "predict", recorded_predict)
    feature_report(model, X, y, groups=X[:, 2], n_splits=3)
    assert len(trained) == len(tested) == 3 * 4  # with all features, and without three times
    for own, out in zip(trained, tested, strict=True):
        assert own | set(out) == set(X[:, 2])
        assert own.isdisjoint(out)
    for start in range(0, 12, 3):
        assert sorted(chain(*tested[start : start + 3])) == X[:, 2].tolist()


@of_short_fits
def test_torques_whose_weights_are_shared_and_correlated():
    X = np.random.RandomState(0).randn(60, 6)
    # Sharing is another subject.
    options = {"n_inducing": 5, "max_iter": 3, "sharing": "none", "noise_cv": None, "random_state": 0}
    body = RigidBodyRegressor("acrobot", friction=["viscous"]).fit(X)
    y = body.transform(X) @ (1.1 * body.coef_prior(2)[0]) + 0.1 * np.random.RandomState(1).randn(60, 2)
    model = EVGPRegressor(body, **options).fit(X, y)
    report = feature_report(model, X, y, groups=np.arange(60) // 6, n_splits=2)
    numbers = [(one.group, one.n_weights) for one in report.groups]
    assert numbers == [("inertia", 20), ("viscous", 2), ("all features", 22)]
    inertia, *_, everything = report.groups
    assert inertia.verdict == everything.verdict == "helps"
    learned = model.coef_prior_scale_[:20]
    moved = (model.coef_ - model.coef_prior_mean_)[:20][learned > 0.0] / learned[learned > 0.0]
    assert inertia.moved == pytest.approx(np.sqrt(np.mean(moved**2)))


# --- errors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"y": None}, ValueError, "feature_report needs y with X"),
        ({"n_splits": 1}, ValueError, "n_splits must be at least 2; got 1"),
        ({"n_splits": 2.5}, TypeError, r"n_splits must be an integer; got 2\.5"),
        ({"groups": [0] * 45 + [1] * 45}, ValueError, "n_splits=3 needs at least 3 groups; got 2"),
        ({"groups": [0] * 90}, ValueError, "needs at least 3 groups; got 1.* cut it into blocks of a few seconds"),
        ({"groups": [0, 1, 2]}, ValueError, r"groups must have the shape \(n_samples,\) = \(90,\)"),
    ],
)
def test_invalid_arguments_raise(options, error, message):
    X, y = line()
    with pytest.raises(error, match=message):
        feature_report(exact().fit(X, y), **({"X": X, "y": y} | options))


def test_x_and_y_of_different_lengths_raise():
    X, y = line()
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        feature_report(exact().fit(X, y), X, y[:60])


def test_there_must_be_a_fit_with_features():
    X, y = line()
    with pytest.raises(NotFittedError):
        feature_report(exact())
    with pytest.raises(ValueError, match="The model has no features: it was fitted with feature_map=None"):
        feature_report(exact().set_params(feature_map=None, coef_prior="auto").fit(X, y))


# --- as a frame, as text and as a page -----------------------------------------------------------------------------

REPORT = FeatureReport(
    (
        FeatureGroup("slope", 3, 2.0, 1.5, 0.25, 4.5, 4.25, 0.5, "helps"),
        FeatureGroup(EVIL, 1, 1.0, 0.5, 0.75, -0.5, -0.25, 0.125, "unclear"),
    ),
    "rows",
)
UNKNOWN = FeatureReport((FeatureGroup("slope", 3, 2.0, 1.5, 0.25),), "")


def test_frame_has_the_fields_of_each_group(monkeypatch):
    frame = REPORT.to_frame()
    assert list(frame.columns) == list(FeatureGroup._fields)
    assert list(frame.itertuples(index=False, name=None)) == [tuple(one) for one in REPORT.groups]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"A data frame needs the optional package 'pandas'.*pip install pandas"):
        REPORT.to_frame()


def test_text_has_a_table_and_a_sentence_for_each_group():
    header, first, second, empty, *sentences = str(REPORT).splitlines()
    assert header.split()[:3] == ["group", "weights", "prior"]
    assert first.split() == ["slope", "3", "×", "2", "1.5", "0.25", "4.5", "4.25", "±", "0.5"]
    assert second.split()[0] == EVIL
    assert empty == ""
    assert sentences == [
        "slope: helps. Without it, the log density of a held-out row falls by 4.25 ± 0.5 nats.",
        f"{EVIL}: effect unclear. Without it, the log density of a held-out row rises by 0.25 ± 0.12 nats.",
    ]
    assert "nan" not in str(UNKNOWN)


def test_page_escapes_names():
    page = REPORT._repr_html_()
    assert EVIL not in page
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;") == 2  # in the table, and in its sentence
    assert "slope: helps." in page


# --- the display ---------------------------------------------------------------------------------------------------


@pytest.fixture
def figure():
    yield pyplot.figure()
    pyplot.close("all")


def test_display_shows_the_loss_of_each_group_from_the_top(figure):
    ax = figure.add_subplot()
    display = FeatureReportDisplay.from_report(REPORT, ax=ax)
    assert display.ax_ is ax
    assert display.figure_ is figure
    (container,) = ax.containers
    points, _, (bars,) = container
    assert_array_equal(points.get_xydata(), [[4.25, 1.0], [-0.25, 0.0]])
    # Of two standard errors.
    assert_allclose([bar[:, 0] for bar in bars.get_segments()], [[3.25, 5.25], [-0.5, 0.0]])
    figure.draw_without_rendering()
    names = {place: label.get_text() for place, label in zip(ax.get_yticks(), ax.get_yticklabels(), strict=True)}
    assert names == {1.0: "slope", 0.0: EVIL}
    assert [(text.get_text(), text.get_position()[1]) for text in ax.texts] == [("helps", 1), ("unclear", 0)]
    assert ax.get_xlabel() == "loss without the group, nats per held-out row"


def test_display_needs_held_out_rows():
    with pytest.raises(ValueError, match="no held-out rows: pass X and y to feature_report"):
        FeatureReportDisplay.from_report(UNKNOWN)
