"""The benchmark of what was tried on the cartpole, in short mode."""

import pytest
from sklearn.exceptions import ConvergenceWarning

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.metrics import prediction_error

from ..conftest import read


@pytest.mark.long
def test_a_variant_is_the_papers_setting_but_for_its_name(run_script, tmp_path):
    output = tmp_path / "cart.csv"
    options = ("--quick", "--models", "EVGP-IFG", "--jobs", 1, "--output", output, "--variants")
    assert "[2/2]" in run_script("paper/cartpole.py", *options, "Adam", "L-BFGS, full posterior")
    assert "1 of 1 cells" in run_script("paper/cartpole.py", *options, "Adam")

    train, test = (make_dynamics("cartpole", 12, random_state=state) for state in (0, 1000))
    model = EVGPRegressor(InertiaForceGravity("cartpole"), n_inducing=60, sharing="kernel", max_iter=50, random_state=0)
    with pytest.warns(ConvergenceWarning):
        model.set_params(noise_cv=None).fit(train.data, train.target)
    adam, full = read(output)
    assert (adam["variant"], adam["n_parameters"], adam["n_iter"]) == ("Adam", "1741", "50")
    assert "setting" not in adam
    assert adam["max_iter"] == full["max_iter"] == "50"
    assert (full["variant"], full["n_parameters"]) == ("L-BFGS, full posterior", str(model.n_parameters_))
    error = prediction_error(test.target, model.predict(test.data))
    assert float(full["error_mean"]) == pytest.approx(error, rel=1e-6)

    page = output.with_suffix(".md").read_text()
    assert f"| L-BFGS, full posterior\\* | {error:#.3g} ({error:#.3g}) |" in page
    assert "In the paper: 0.011." in page
    assert "cartpole: EVGP-IF\n" not in page
    assert output.with_suffix(".png").stat().st_size > 5_000


def test_variants_change_parameters_that_exist():
    from paper.cartpole import VARIANTS

    for changes in VARIANTS.values():
        EVGPRegressor().set_params(**changes)


def test_skevgps_defaults_are_the_regressors(monkeypatch):
    from paper import cartpole, models

    built = {}

    def keep(fit, train, test, changes):
        built[fit.model] = models.build(fit).set_params(**changes)
        return {"setting": fit.setting, "system": fit.system}

    monkeypatch.setattr(cartpole, "fitted_row", keep)
    monkeypatch.setattr(cartpole.results_table, "data", lambda *_: (None, None))
    for variant, same in ((cartpole.DEFAULTS, True), (cartpole.SHARED, False)):
        row = cartpole.run(cartpole.Cell("cartpole_damped", variant, "EVGP-IFG", 0, "full"))
        assert row == {"variant": variant, "system": "cartpole_damped"}
        own = built["EVGP-IFG"].get_params(deep=False)
        defaults = EVGPRegressor(own["feature_map"], n_inducing=60, random_state=0).get_params(deep=False)
        assert (own == defaults) is same
        assert own["feature_map"].robot == "cartpole_damped"


def test_a_page_has_the_mean_of_data_sets_and_each():
    from paper.cartpole import paragraphs

    numbers = dict.fromkeys(("error_inside", "error_median", "error_p99", "cr2", "bound_per_row", "fit_seconds"), "1")
    names = {
        "converged": "True",
        "variant": "Adam",
        "system": "cartpole",
        "model": "EVGP-IF",
        "size": "full",
        "date": "today",
        "versions": "",
        "machine": "",
    }
    rows = [{**names, **numbers, "seed": seed, "error_mean": error} for seed, error in (("1", "0.03"), ("0", "0.01"))]
    assert "| Adam | 0.0200 (0.0100, 0.0300) | 1.00 | 1.00 |" in "\n".join(paragraphs(rows))
    rows[0]["converged"] = "False"
    assert "| Adam\\* | 0.0200 (0.0100, 0.0300) |" in "\n".join(paragraphs(rows))


def test_the_picture_has_each_data_set_their_median_and_the_paper(drawn, tmp_path):
    from paper.cartpole import MODELS, plot

    rows = [
        {
            **{"system": "cartpole", "variant": variant, "model": model, "seed": str(seed), "error_mean": error},
            **{"converged": str(seed < 2), "max_iter": "", "n_iter": "9"},
        }
        for variant in ("Adam", "L-BFGS")
        for model in MODELS
        for seed, error in enumerate(("0.01", "0.03", "0.08"))
    ]
    (figure,) = drawn(plot, rows, tmp_path / "cart.png")
    assert [axes.get_title() for axes in figure.axes] == [f"cartpole\n{model}" for model in MODELS]
    for axes, paper in zip(figure.axes, (0.011, 0.016), strict=True):
        assert axes.get_xlabel() == "test Error\n(SI units)"
        assert [tick.get_text() for tick in axes.get_yticklabels()] in (["Adam", "L-BFGS"], [])
        medians = [line.get_xdata() for line in axes.lines if line.get_marker() == "|" and len(line.get_xdata())]
        assert medians == [pytest.approx([0.03])] * 2
        assert paper in [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--"]
        hollow = [line for line in axes.lines if line.get_markerfacecolor() == "white" and len(line.get_xdata())]
        assert [line.get_xdata()[0] for line in hollow] == [0.08, 0.08]
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"data set 0", "data set 2", "median", "in the paper", "ended by its limit of iterations"} <= labels
