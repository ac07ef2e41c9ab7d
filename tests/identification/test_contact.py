from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter
from sklearn.exceptions import ConvergenceWarning, NotFittedError

from skevgp import ContactMonitor, InverseDynamics

DT, RATE, FACTOR, WINDOW = 0.05, 60.0, 0.9, 16


def log(seconds, seed):
    """Free motion of a pendulum with autoregressive errors of its torque."""
    rng = np.random.default_rng(seed)
    t = rng.uniform(0.0, 1000.0) + np.arange(0.0, seconds, DT)
    q, v = np.sin(t) + 0.5 * np.sin(2.7 * t), np.cos(t) + 1.35 * np.cos(2.7 * t)
    X = np.column_stack([q, v, -np.sin(t) - 3.645 * np.sin(2.7 * t)])
    errors = lfilter([np.sqrt(1.0 - FACTOR**2)], [1.0, -FACTOR], rng.normal(size=len(t) + 200))[200:]
    return X, X[:, 2] / 4.0 + 9.81 / 2.0 * np.sin(q) + 0.1 * errors


@pytest.fixture(scope="module")
def model():
    return InverseDynamics("pendulum", n_inducing=0).fit(*log(120.0, 0))


@pytest.fixture(scope="module")
def monitor(model):
    return ContactMonitor(model, dt=DT, false_alarms_per_hour=RATE).fit(*log(600.0, 1))


def test_steps_of_a_stream_are_predictions_of_its_log(monitor):
    X, y = log(11.0, 2)
    y[200:208] += 2.0 * monitor.detectable_
    alarms = monitor.predict(X, y)
    assert 0 < alarms.sum() < 50
    for start in (0, 195):  # the second stream begins shortly before the push
        monitor.reset()
        found = [monitor.step(row, torque) for row, torque in zip(X[start:], y[start:], strict=True)]
        assert_array_equal(found, monitor.predict(X[start:], y[start:]))
    score = monitor.score_samples(X, y)
    assert_array_equal(score[: WINDOW - 1], 0.0)
    assert (score[WINDOW - 1 :] > 0.0).all()
    assert_array_equal(alarms, score > monitor.threshold_)


def test_false_alarms_are_about_as_frequent_as_stated(model, monitor):
    clean = log(3600.0, 3)

    def count(fitted):
        rows = np.flatnonzero(fitted.predict(*clean))
        return np.sum(np.diff(rows, prepend=-np.inf) * DT > 1.0)  # alarms within a second are one

    assert monitor.hours_ == pytest.approx(1.0 / 6.0, rel=0.01)
    # The threshold is on the safe side, so that there are fewer than stated, but not by an order of magnitude.
    assert 0.1 * RATE < count(monitor) < RATE + 3.0 * np.sqrt(RATE)
    assert count(ContactMonitor(model, dt=DT, false_alarms_per_hour=1.0).fit(*log(600.0, 1))) < 1.0 + 3.0


@pytest.mark.parametrize(("size", "least", "most"), [(2.0, 0.8, 1.0), (0.5, 0.0, 0.3)])
def test_pushes_are_found_from_about_the_detectable_torque_on(monitor, size, least, most):
    X, y = log(3600.0, 4)
    starts = np.random.default_rng(0).integers(100, len(y) - 100, 50)
    push = size * monitor.detectable_ * (np.abs(np.arange(-30, 30) - 3.5) < 4.0)  # 0.4 s
    around = [slice(start - 30, start + 30) for start in starts]
    found = [monitor.predict(X[rows], y[rows] + push)[30:38].any() for rows in around]
    assert least <= np.mean(found) <= most


def test_pieces_are_judged_alone(monitor):
    (X, y), middle = log(20.0, 5), 200
    y[:middle] -= monitor.detectable_  # before the gap the torque is lower: a step, if there were no gap
    y[middle:] += monitor.detectable_
    pieces = np.repeat(["b", "a"], [middle, len(y) - middle])
    score = monitor.score_samples(X, y, pieces=pieces)
    for piece in (slice(None, middle), slice(middle, None)):
        assert_allclose(score[piece], monitor.score_samples(X[piece], y[piece]))
    near = slice(middle, middle + 40)
    assert not monitor.predict(X, y, pieces=pieces)[near].any()
    assert monitor.predict(X, y)[near].any()
    assert_array_equal(monitor.score_samples(X[:10], y[:10]), 0.0)


def test_fit_takes_no_errors_across_gaps(model, monitor):
    X, y = log(600.0, 1)
    order = np.arange(len(y)).reshape(20, -1)
    pieces = np.repeat(np.arange(20), order.shape[1])
    found = ContactMonitor(model, dt=DT, false_alarms_per_hour=RATE).fit(X, y, pieces=pieces)
    mixed = np.random.default_rng(0).permutation(20)
    rows = order[mixed].ravel()
    again = ContactMonitor(model, dt=DT, false_alarms_per_hour=RATE).fit(X[rows], y[rows], pieces=pieces[rows])
    for name in ("threshold_", "scale_", "detectable_", "hours_"):
        assert_allclose(getattr(again, name), getattr(found, name), rtol=1e-6)


def test_free_motion_that_is_too_short_raises_a_warning(model):
    with pytest.warns(ConvergenceWarning, match=r"60 s of free motion are too short for false_alarms_per_hour=1e-06"):
        ContactMonitor(model, dt=DT, false_alarms_per_hour=1e-6).fit(*log(60.8, 1))


def test_invalid_use_raises(model):
    X, y = log(60.0, 0)
    fresh = partial(ContactMonitor, model, dt=DT)
    for method in ("predict", "score_samples", "step"):
        with pytest.raises(NotFittedError):
            getattr(fresh(), method)(X, y)
    with pytest.raises(NotFittedError):
        ContactMonitor(InverseDynamics("pendulum"), dt=DT).fit(X, y)
    with pytest.raises(ValueError, match=r"needs at least 16 s .* the first 0.8 s .*got 14.2 s \(285 rows\)"):
        fresh().fit(X[:300], y[:300])
    with pytest.raises(ValueError, match="got 0"):
        fresh().fit(X, y, pieces=np.arange(len(y)) // 10)
    for wrong in (0.0, -1.0):
        with pytest.raises(ValueError, match="dt"):
            ContactMonitor(model, dt=wrong).fit(X, y)
        with pytest.raises(ValueError, match="false_alarms_per_hour"):
            fresh(false_alarms_per_hour=wrong).fit(X, y)
    with pytest.raises(TypeError, match="must be a fitted InverseDynamics; got str"):
        ContactMonitor("pendulum").fit(X, y)
    with pytest.raises(NotFittedError):
        fresh().reset()
    monitor = fresh().fit(X, y)
    before = monitor.score_samples(X, y)
    with pytest.raises(ValueError, match="needs at least"):
        monitor.fit(X[:300], y[:300])
    assert_array_equal(monitor.score_samples(X, y), before)  # a fit that fails changes nothing
    with pytest.raises(ValueError, match="pieces"):
        monitor.predict(X, y, pieces=[0, 1])
    with pytest.raises(ValueError, match="features"):
        monitor.step(X[0, :2], y[0])
