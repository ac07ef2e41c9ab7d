"""What a fitted model says of itself: as text, as HTML, as a data frame."""

import sys
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.gaussian_process.kernels import RBF
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, InverseDynamics
from skevgp.features import AngleEncoder

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (40, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.05 * RNG.randn(40, 2)
TREND = PolynomialFeatures(1)
EVIL = "<script>alert(1)</script>"
SPARSE = EVGPRegressor(TREND, n_inducing=8, max_iter=0, random_state=0)
EXACT = EGPRegressor(TREND, max_iter=0)
both = pytest.mark.parametrize("model", [SPARSE, EXACT], ids=lambda model: type(model).__name__)


def fitted(model=SPARSE, inputs=X, targets=Y, **parameters):
    return clone(model).set_params(**parameters).fit(inputs, targets)


def numbers(frame, part, output=None):
    own = frame[frame.part == part]
    return (own if output is None else own[own.output == output]).set_index("name")


def test_certificate_of_a_sparse_model_is_an_interval():
    m = fitted()
    summary = m.summary()
    assert (summary.lower_bound, summary.upper_bound) == (m.lower_bound_, m.upper_bound_)
    assert f"log marginal likelihood: from {m.lower_bound_:.2f} to {m.upper_bound_:.2f} nats" in str(summary)
    assert "EVGPRegressor, 8 inducing points, for 2 outputs" in str(summary)


def test_weights_that_outputs_share_are_said_once():
    summary = fitted(coef_prior=CoefPrior(shared=True)).summary()
    weights = numbers(summary.to_frame(), "weight")
    assert weights.output.isna().all()
    assert len(weights) == 3
    assert "output 1" in str(summary)


@both
def test_summary_frame_equals_attributes(model):
    m = fitted(model)
    frame = m.summary().to_frame()
    for output in (0, 1):
        weights = numbers(frame, "weight", output)
        assert weights.index.tolist() == m.coef_names_.tolist() == ["1", "x0", "x1"]
        for column, attribute in {
            "value": m.coef_,
            "std": m.coef_std_,
            "prior_mean": m.coef_prior_mean_,
            "prior_std": m.coef_prior_scale_,
        }.items():
            np.testing.assert_array_equal(weights[column], attribute[output])
        kernel = m.kernel_[output]
        assert numbers(frame, "noise std", output).value.tolist() == [m.noise_variance_[output] ** 0.5]
        assert numbers(frame, "signal std", output).value.tolist() == [kernel.k1.constant_value**0.5]
        scales = numbers(frame, "length_scale", output)
        assert scales.index.tolist() == ["x0", "x1"]
        np.testing.assert_array_equal(scales.value, kernel.k2.length_scale)


def test_columns_are_called_as_the_kernel_sees_them():
    frame = pd.DataFrame(X, columns=["angle", "speed"])

    def scales(**parameters):
        return numbers(fitted(inputs=frame, targets=Y[:, 0], **parameters).summary().to_frame(), "length_scale")

    assert scales().index.tolist() == ["angle", "speed"]
    assert scales(kernel_map=StandardScaler()).index.tolist() == ["angle", "speed"]
    assert scales(kernel_map=AngleEncoder(angles=[0])).index.tolist() == ["sin(angle)", "cos(angle)", "speed"]
    assert scales(kernel_map=FunctionTransformer(lambda x: np.hstack([x, x]))).index.tolist() == [
        "k0",
        "k1",
        "k2",
        "k3",
    ]
    assert scales(kernel=RBF(1.0)).index.tolist() == [""]
    assert scales(kernel=RBF(1.0), kernel_map=FunctionTransformer(lambda x: x.to_numpy()[:, :1])).index.tolist() == [
        "k0"
    ]


def test_torques_say_what_all_joints_share_and_what_is_of_each():
    rows = np.random.RandomState(0).uniform(-2.0, 2.0, (200, 2))
    y = 1.2 * rows[:, 1] + np.abs(rows[:, 0]) + np.sin(rows[:, 1])
    m = InverseDynamics(n_inducing=8, max_iter=2, random_state=0).fit(np.column_stack([rows, rows.sum(axis=1)]), y)
    summary = m.summary()
    weights = numbers(summary.to_frame(), "weight")
    np.testing.assert_array_equal(weights.value, m.coef_)
    assert weights.index.tolist() == m.coef_names_.tolist()
    assert numbers(summary.to_frame(), "noise std").value.tolist() == [m.noise_variance_[0] ** 0.5]
    assert m.residual_std_ > 0.0  # left-out rows say that the Gaussian process is worth its place
    signal, share = (numbers(summary.to_frame(), part).value.to_numpy() for part in ("signal std", "share"))
    np.testing.assert_array_equal(share, m.residual_share_)
    np.testing.assert_allclose(share * signal, m.residual_std_)
    assert summary.certificate == ""
    assert "What was learned" in m._repr_html_()


# --- notebooks ----------------------------------------------------------------------------------------------------


class Balanced(HTMLParser):
    """Text and tags of a page; all that is opened is closed."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.text = [], [], []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag not in ("br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.text.append(text)


@both
def test_html_shows_diagram_and_summary(model):
    unfitted = clone(model)
    m = fitted(model)
    for page in (m._repr_html_(), m._repr_mimebundle_()["text/html"]):
        assert "sk-top-container" in page
        assert page.index("sk-top-container") < page.index("What was learned") < page.index("noise std")
        assert m.summary()._repr_html_() in page
    assert "sk-top-container" in unfitted._repr_html_()
    assert "What was learned" not in unfitted._repr_html_() + unfitted._repr_mimebundle_()["text/html"]


@both
def test_nothing_stays_unescaped(model):
    frame = pd.DataFrame(X, columns=[EVIL, 'b" & onload="'])
    page = fitted(model, inputs=frame).summary()._repr_html_()
    assert EVIL not in page
    assert "&lt;script&gt;" in page
    parsed = Balanced(page)
    assert set(parsed.tags) <= {"div", "p", "b", "br", "table", "thead", "tbody", "tr", "th", "td"}
    assert EVIL in parsed.text  # to be read
    assert "script" not in Balanced(page).tags
    assert EVIL not in fitted(model, inputs=frame)._repr_html_()


def test_without_pandas_there_is_text_and_the_pip_command(monkeypatch):
    summary = fitted().summary()
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert "posterior" in str(summary)
    with pytest.raises(ImportError, match="A data frame needs the optional package 'pandas'.*pip install pandas"):
        summary.to_frame()
