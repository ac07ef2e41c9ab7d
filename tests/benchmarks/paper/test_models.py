"""The paper's models have its sizes, and settings are what they say."""

from itertools import pairwise

import numpy as np

from skevgp import BayesianMLPRegressor, EVGPRegressor
from skevgp.features import AngleEncoder, InertiaForce
from skevgp.solvers import Adam

PAPER = {"solver": Adam(posterior="diagonal"), "sharing": "kernel", "noise_cv": None}


def test_sizes_are_those_that_give_the_papers_numbers_of_parameters():
    """Per output m inducing inputs, 2 m for their values, 2 p for weights, signal and noise; and D lengthscales."""
    from paper.models import MODELS, SYSTEMS
    from paper.results_table_report import PAPER

    widths = {
        "pendulum": (2, 3, 4),
        "cartpole": (4, 5, 6),
        "cartpole_damped": (4, 5, 6),
        "acrobot": (4, 5, 7),
        "iiwa14": (14, 21, 33),
    }
    for place, (system, (n_outputs, d, with_gravity)) in enumerate(widths.items()):
        assert SYSTEMS[place] == system
        for name, p in {"VGP": 0, "RES-VGP": 0, "EVGP-IF": d, "EVGP-IFG": with_gravity}.items():
            m = MODELS[name].sizes[place]
            assert PAPER[system][name].n_parameters == n_outputs * (m * d + 2 * m + 2 * p + 2) + d, (system, name)
        # Of the network two per weight, one per bias, one noise per output.
        layers = (d, *MODELS["RES-DBNN"].sizes[place], n_outputs)
        weights = sum(a * b for a, b in pairwise(layers))
        assert PAPER[system]["RES-DBNN"].n_parameters == 2 * weights + sum(layers[1:]) + n_outputs


def test_settings_are_what_they_say():
    from paper.models import UNTIL_FLAT, Fit, build

    def built(system, model, setting, seed=0, size="full", max_iter=None):
        return build(Fit(system, model, setting, seed, size, max_iter))

    paper = built("acrobot", "VGP", "paper")
    assert (paper.feature_map, paper.kernel_map, paper.max_iter) == (None, None, None)
    assert {name: paper.get_params()[name] for name in PAPER} == PAPER
    plain, defaults = built("acrobot", "EVGP-IF", "skevgp").get_params(deep=False), EVGPRegressor().get_params()
    assert {name for name, value in plain.items() if value != defaults[name]} == {
        *("feature_map", "n_inducing", "random_state")
    }
    author = built("acrobot", "EVGP-IF", "author")
    assert (author.solver.batch_size, author.solver.learning_rate, author.solver.schedule) == (50, 0.01, "constant")
    assert (author.noise_variance, author.coef_scale, author.inducing_init.shape) == (1.0, 1.0, (150, 5))
    np.testing.assert_allclose(author.kernel.k2.length_scale, 150 ** (-1 / 5))
    assert author.kernel.k1.constant_value == 0.5**2
    assert np.abs(author.inducing_init).max() <= 2.0
    assert {name: author.get_params()[name] for name in PAPER if name != "solver"} == {
        name: value for name, value in PAPER.items() if name != "solver"
    }
    angles = built("iiwa14", "EVGP-IFG", "skevgp-angles")
    assert isinstance(angles.kernel_map, AngleEncoder)
    assert angles.kernel_map.robot == "iiwa14"
    assert (
        built("iiwa14", "VGP", "paper", size="quick").max_iter < built("iiwa14", "VGP", "skevgp", size="quick").max_iter
    )
    assert built("iiwa14", "VGP", "paper", size="quick", max_iter=7).max_iter == 7

    standard, narrow = (built("iiwa14", "RES-DBNN", setting).regressor for setting in ("paper", "skevgp"))
    assert (standard.hidden_layer_sizes, standard.prior_scale) == ((250, 250), 1.0)
    assert narrow.get_params() == BayesianMLPRegressor((250, 250), random_state=0, **UNTIL_FLAT).get_params()
    encoder, network = built("pendulum", "RES-DBNN", "skevgp-angles", size="quick").regressor
    assert isinstance(encoder, AngleEncoder)
    assert network.max_iter == 400

    X = np.random.RandomState(0).uniform(-1, 1, (3, 21))
    physics, nominal = (step for _, step in built("iiwa14", "EVGP-IF", "skevgp-nominal").feature_map.transformer_list)
    assert isinstance(physics, InertiaForce)
    _, other = (step for _, step in built("iiwa14", "EVGP-IF", "skevgp-nominal", seed=1).feature_map.transformer_list)
    assert not np.allclose(nominal.fit_transform(X), other.fit_transform(X))
