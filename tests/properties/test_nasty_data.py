"""Finite data of any kind are fitted, or refused by an error that names the size or the kernel; damaged files too."""

import re
import warnings

import numpy as np
import pandas as pd
import polars as pl
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import load_log
from skevgp.exceptions import DependentRowsWarning
from skevgp.robots import inertial_parameters, load_robot
from skevgp.solvers import LBFGS, Adam

from ..datasets.logs.cases import BY_NUMBER, irregular_times, table_of, write_table
from ..datasets.logs.test_bags import UR10, write_states
from ..robots.test_urdf import ARM
from .cases import data, fewer, learned_models

REFUSED = "must not exceed|must be 0 or exceed|must be positive semi-definite"

# --- What makes rows and targets nasty: functions of an array and a generator.

OF_ROWS = {
    "scales": lambda X, rng: X * 10.0 ** rng.uniform(-12, 12, X.shape[1]),
    "constant": lambda X, rng: np.column_stack([np.full(len(X), rng.choice([0.0, 0.1, 1e8 + 0.1])), X[:, 1:]]),
    "copied column": lambda X, rng: np.column_stack([X[:, :-1], X[:, 0]]),
    "nearly copied column": lambda X, rng: np.column_stack([X[:, :-1], X[:, 0] + 1e-9 * rng.randn(len(X))]),
    "equal rows": lambda X, rng: X[rng.randint(0, max(1, len(X) // 3), len(X))],
    "equal up to rounding": lambda X, rng: X[np.arange(len(X)) // 2] * (1.0 + 4e-16 * rng.choice([-1, 0, 1], X.shape)),
    "outlier": lambda X, rng: X * np.where(np.arange(len(X)) == 0, 1e6, 1.0)[:, np.newaxis],
    "offset": lambda X, rng: X + 1e8,
    "lattice": lambda X, rng: np.round(X),
    "tiny": lambda X, rng: 1e-100 * X,
    "vast": lambda X, rng: 1e70 * X,
    "denormal": lambda X, rng: np.where(rng.rand(*X.shape) < 0.3, 5e-324, X),
    "signed zeros": lambda X, rng: np.where(rng.rand(*X.shape) < 0.3, -0.0, X),
}
OF_TARGETS = {
    "scales": lambda Y, rng: Y * 10.0 ** rng.uniform(-12, 12, Y.shape[1]),
    "zeros": lambda Y, rng: 0.0 * Y,
    "constant": lambda Y, rng: np.full(Y.shape, 5.1),
    "one row differs": lambda Y, rng: (np.arange(len(Y)) == 0)[:, np.newaxis] * np.ones(Y.shape),
    "heavy tails": lambda Y, rng: Y + rng.standard_cauchy(Y.shape),
    "outlier": lambda Y, rng: Y + (np.arange(len(Y)) == 0)[:, np.newaxis] * 10.0 ** rng.uniform(1, 8),
    "offset": lambda Y, rng: Y + 1e8,
    "tiny": lambda Y, rng: 1e-120 * Y,
    "vast": lambda Y, rng: 1e80 * Y,
}
CONTAINERS = {
    "array": lambda X: X,
    "Fortran order": np.asfortranarray,
    "strided": lambda X: np.repeat(np.repeat(X, 2, axis=0), 3, axis=1)[::2, ::3],
    "object": lambda X: X.astype(object),
    "list": lambda X: X.tolist(),
    "pandas": lambda X: pd.DataFrame(X, columns=[f"x{j}" for j in range(X.shape[1])]),
    "polars": lambda X: pl.DataFrame({f"x{j}": X[:, j] for j in range(X.shape[1])}),
}
NASTY = st.fixed_dictionaries(
    {
        "of_rows": st.lists(st.sampled_from(sorted(OF_ROWS)), max_size=3),
        "of_targets": st.lists(st.sampled_from(sorted(OF_TARGETS)), max_size=2),
        "container": st.sampled_from(sorted(CONTAINERS)),
        "seed": st.integers(0, 10_000),
    }
)


def made_nasty(X, Y, of_rows=(), of_targets=(), container="array", seed=0):
    rng = np.random.RandomState(seed)
    for name in of_rows:
        X = OF_ROWS[name](X, rng)
    for name in of_targets:
        Y = OF_TARGETS[name](Y, rng)
    return X, Y, CONTAINERS[container]


def assert_finite(model, rows):
    mean, std = model.predict(rows, return_std=True)
    assert np.isfinite(mean).all()
    assert np.isfinite(std).all()
    assert (std > 0.0).all()
    assert np.isfinite(model.sample_y(rows[:3])).all()


def assert_fitted_or_refused(model, X, Y, contain):
    step = X.std(axis=0)
    near = X + np.where(np.isfinite(step), step, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", DependentRowsWarning)
        try:
            model.fit(contain(X), Y)
            for rows in (X, near):
                assert_finite(model, contain(rows))
        except ValueError as error:
            if not re.search(REFUSED, str(error)):
                raise
            return
    if isinstance(model, EGPRegressor):
        assert np.isfinite(model.log_marginal_likelihood_value_)
        return
    assert np.isfinite(model.lower_bound_)
    if isinstance(model.solver, LBFGS) and model.upper_bound_ is not None:
        # Adam sums the lower bound in another order.
        assert model.lower_bound_ <= model.upper_bound_ + 1e-5 * abs(model.lower_bound_) + 1e-3


MANY = np.random.RandomState(0).randn(30, 3)
WAVES = np.sin(2.0 * MANY[:, :2]) + 0.1 * MANY[:, 1:]


@given(data(most_outputs=2), NASTY, st.data())
def test_nasty_data_are_fitted_or_refused(rows, nasty, draws):
    X, Y, contain = made_nasty(*rows[:2], **nasty)
    assert_fitted_or_refused(draws.draw(learned_models(X, Y.shape[1])), X, Y, contain)


@fewer(4)
@given(
    NASTY,
    st.sampled_from([1, 2, 3, 20, 30]),
    st.sampled_from([{"n_inducing": "auto", "solver": LBFGS(max_inducing=30)}, {"n_inducing": 200, "sharing": "auto"},
                     {"solver": Adam(batch_size=64, natural_gradient=True), "sharing": "none"}]),
    st.sampled_from([None, PolynomialFeatures(2)]),
)  # fmt: skip
@example(
    {"of_rows": ["scales", "copied column", "equal rows"], "of_targets": ["offset"]}, 30, {"n_inducing": "auto"}, None
)
@example({"of_rows": ["offset", "equal up to rounding"], "of_targets": ["scales"]}, 30, {"n_inducing": 200}, None)
@example({"of_rows": ["outlier", "constant"], "of_targets": ["heavy tails"]}, 20, {}, PolynomialFeatures(2))
@example({"of_rows": ["denormal"], "of_targets": ["one row differs"]}, 30, {"solver": Adam()}, PolynomialFeatures(2))
@example({"of_rows": ["tiny"], "of_targets": ["tiny"]}, 30, {}, PolynomialFeatures(2))
@example({"of_rows": ["vast"], "of_targets": ["vast"]}, 30, {"sharing": "auto"}, None)
def test_many_nasty_rows_are_fitted_or_refused(nasty, n, options, feature_map):
    X, Y, contain = made_nasty(MANY[:n], WAVES[:n], **nasty)
    few = {"n_inducing": 10, "max_iter": 8, "sharing": "all", "random_state": 0}
    model = EVGPRegressor(feature_map, **few | options)
    assert_fitted_or_refused(model, X, Y, contain)


# --- Files.


def damaged(content, kind, where, byte):
    """Bytes of a file with one kind of damage."""
    at = where % len(content)
    return {
        "cut": content[:at],
        "flipped": content[:at] + bytes([content[at] ^ (byte or 1)]) + content[at + 1 :],
        "overwritten": content[:at] + 8 * bytes([byte]) + content[at + 8 :],
        "cut out": content[:at] + content[at + 1 + byte :],
        "repeated": content[: at + byte] + content[at:],
        "number": re.sub(rb"\d+\.?\d*", rb"1e400", content[:at], count=1) + content[at:],
        "UTF-16": content.decode("latin-1").encode("utf-16"),
    }[kind]


def read_log(path):
    log = load_log(path, columns=BY_NUMBER)
    return log.data, log.target


def read_robot(path):
    return (inertial_parameters(load_robot(path)),)


def read_recording(path):
    log = load_log(path)
    return log.data, log.target


# What reads each, and what writes a good one in a folder.
FILES = {
    "table.csv": (read_log, lambda folder: write_table(folder / "good.csv", table_of(irregular_times(3.0)))),
    "robot.urdf": (read_robot, lambda folder: (folder / "good.urdf").write_text(ARM) and folder / "good.urdf"),
    "recording.mcap": (read_recording, lambda folder: write_states(folder / "good")),
    "recording.db3": (read_recording, lambda folder: UR10),
}


@pytest.mark.parametrize("name", FILES)
@given(
    st.sampled_from(["cut", "flipped", "overwritten", "cut out", "repeated", "number", "UTF-16"]),
    st.integers(0, 10**5),
    st.integers(0, 255),
)
@example("cut", 0, 0)
@example("number", 10**5 - 1, 0)
@example("overwritten", ARM.index("revolute"), ord("A"))
def test_damaged_files_are_read_or_refused(tmp_path_factory, name, kind, where, byte):
    read, write = FILES[name]
    folder = tmp_path_factory.mktemp("damaged")
    path = folder / name
    path.write_bytes(damaged(write(folder).read_bytes(), kind, where, byte))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = read(path)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017
        else:
            assert all(np.isfinite(values).all() for values in found)
