import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_rgb
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.utils import Bunch

from skevgp.plotting import RolloutDisplay

mpl.use("Agg")
N_BATCH, N_SAMPLES, N_STEPS, N_STATES = 3, 5, 4, 2


@pytest.fixture(autouse=True)
def close_figures():
    yield
    pyplot.close("all")


def numbers(*shape):
    return np.random.RandomState(len(shape)).uniform(1.0, 2.0, shape)


@pytest.fixture
def batch():
    shape = N_STEPS, N_STATES
    return Bunch(
        mean=numbers(N_BATCH, *shape),
        std=0.1 + np.arange(N_BATCH * N_STEPS * N_STATES).reshape(N_BATCH, *shape),
        covariance=numbers(N_BATCH, *shape, N_STATES),
        samples=numbers(N_BATCH, N_SAMPLES, *shape),
        inputs=numbers(N_BATCH, N_STEPS, 1),
    )


@pytest.fixture
def ahead(batch):
    return Bunch(**{name: values[0] for name, values in batch.items()})


TRUTH = numbers(N_STEPS, N_STATES) + 5.0


def drawn(ax):
    """Curves by their labels; those without one are samples."""
    lines = [(line.get_label(), line) for line in ax.lines]
    named = {label: line for label, line in lines if not label.startswith("_")}
    return named, [line for label, line in lines if label == "samples" or label.startswith("_")]


def band(ax, times):
    (area,) = ax.collections
    corners = area.get_paths()[0].vertices
    edges = [(corners[corners[:, 0] == x, 1].min(), corners[corners[:, 0] == x, 1].max()) for x in times]
    return np.array(edges).T, area.get_label()


def test_each_state_has_a_panel_with_mean_band_samples_and_truth(ahead):
    display = RolloutDisplay.from_rollout(ahead, TRUTH, n_samples=3)
    assert len(display.axes_) == N_STATES
    for state, ax in enumerate(display.axes_):
        named, samples = drawn(ax)
        assert named.keys() == {"mean", "truth", "samples"}
        assert_array_equal(named["mean"].get_xydata(), np.column_stack([[1, 2, 3, 4], ahead.mean[:, state]]))
        assert_array_equal(named["truth"].get_ydata(), TRUTH[:, state])
        assert_array_equal([line.get_ydata() for line in samples], ahead.samples[:3, :, state])
        mean, std = ahead.mean[:, state], ahead.std[:, state]
        edges, label = band(ax, [1, 2, 3, 4])
        assert_allclose(edges, [mean - 2.0 * std, mean + 2.0 * std])
        assert label == "±2 std"
        assert len({to_rgb(line.get_color()) for line in named.values()}) == 3
        assert ax.get_ylabel() == f"state {state}"
    assert [ax.get_xlabel() for ax in display.axes_] == ["", "step"]
    assert pyplot.get_fignums() == [display.figure_.number]


def test_states_times_and_names_are_chosen(ahead):
    display = RolloutDisplay.from_rollout(
        ahead, TRUTH, states=[1], state_names=["q", "dq/dt"], dt=0.5, n_std=3.0, label="EVGP"
    )
    (ax,) = display.axes_
    named, _ = drawn(ax)
    assert_array_equal(named["EVGP"].get_xydata(), np.column_stack([[0.5, 1.0, 1.5, 2.0], ahead.mean[:, 1]]))
    assert_array_equal(named["truth"].get_ydata(), TRUTH[:, 1])
    edges, label = band(ax, display.times)
    assert_allclose(edges[1], ahead.mean[:, 1] + 3.0 * ahead.std[:, 1])
    assert (ax.get_xlabel(), ax.get_ylabel(), label) == ("time (s)", "dq/dt", "±3 std")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"states": [2]}, r"states=\[2\] must be indices of some of 2 states"),
        ({"states": [-3]}, r"states=\[-3\] must be indices of some of 2 states"),
        ({"states": []}, r"states=\[\] must be indices of some of 2 states"),
        ({"state_names": ["q"]}, r"state_names must name the 2 states of the rollout; got \['q'\]"),
        ({"truth": TRUTH[:3]}, r"truth must be of shape \(n_steps, n_states\) = \(4, 2\); got \(3, 2\)"),
        ({"index": 1}, "index=1, but the rollout is from one initial state"),
        ({"dt": 0.0}, "dt must be finite and above 0"),
        ({"n_samples": -1}, "n_samples must be at least 0"),
    ],
)
def test_mismatched_arguments_raise(ahead, arguments, message):
    with pytest.raises(ValueError, match=message):
        RolloutDisplay.from_rollout(ahead, **arguments)


def test_missing_initial_state_raises(batch):
    with pytest.raises(ValueError, match="index=3 must be that of one of 3 initial states"):
        RolloutDisplay.from_rollout(batch, index=3)


def test_another_number_of_axes_raises(ahead):
    with pytest.raises(ValueError, match="axes must be one for each of the 2 states drawn; got 1"):
        RolloutDisplay.from_rollout(ahead, axes=pyplot.subplots()[1])
