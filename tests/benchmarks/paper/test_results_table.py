"""The benchmark of the paper's Table 4 in short mode."""

import csv
from contextlib import nullcontext

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from sklearn.utils import Bunch

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.estimators import bnn
from skevgp.features import InertiaForceGravity
from skevgp.fitting import messages
from skevgp.metrics import prediction_error, std_norm
from skevgp.noise import Gaussian
from skevgp.solvers import Adam
from skevgp.solvers.base import Minimum

from ..conftest import read

COLUMNS = "system,model,setting,seed,error_mean,error_median,error_p99,std_norm,cr1,cr2,cr3,nlpd,within_0.1,"
PAPER = {"solver": Adam(posterior="diagonal"), "sharing": "kernel", "noise_cv": None}


@pytest.fixture
def run(run_script, tmp_path):
    """Tiny fits of the pendulum's models."""

    def run(*arguments, max_iter=2):
        options = ("--quick", "--systems", "pendulum", "--max-iter", max_iter, "--jobs", 1)
        options += ("--output", tmp_path / "table.csv")
        return run_script("paper/results_table.py", *options, *arguments)

    return run


@pytest.mark.long
def test_it_runs_and_resumes_and_keeps_noises_apart(run, tmp_path):
    table, page, picture = (tmp_path / f"table.{suffix}" for suffix in ("csv", "md", "png"))
    both = ("--models", "RES-VGP", "EVGP-IFG", "--settings")
    said = run(*both, "paper")
    assert "[2/2] pendulum" in said
    assert table.read_text().startswith(COLUMNS)
    before = table.read_text()
    said = run(*both, "paper", "skevgp")
    assert "2 of 4 cells" in said
    assert "[2/2] pendulum" in said
    assert table.read_text().startswith(before)

    train, test = (make_dynamics("pendulum", 12, random_state=state) for state in (0, 1000))
    X, y = train.data, train.target
    models = {
        ("RES-VGP", "skevgp"): EVGPRegressor(n_inducing=40),
        ("EVGP-IFG", "skevgp"): EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10),
        ("EVGP-IFG", "paper"): EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, **PAPER),
    }
    rows = {(row["model"], row["setting"]): row for row in read(table)}
    for key, model in models.items():
        row, residual = rows[key], float(key[0] == "RES-VGP")
        with pytest.warns(ConvergenceWarning, match="max_iter") if key[1] == "skevgp" else nullcontext():
            model.set_params(max_iter=2, random_state=0).fit(X, y - residual * X[:, :2], groups=train.groups)
        mean, std = model.predict(test.data, return_std=True)
        mean += residual * test.data[:, :2]
        assert float(row["error_mean"]) == pytest.approx(prediction_error(test.target, mean), rel=1e-6)
        assert float(row["std_norm"]) == pytest.approx(std_norm(std), rel=1e-6)
        assert row["converged"] == str(key[1] == "paper")
    assert "| 123 / 123 |" in page.read_text()  # parameters, ours and the paper's
    assert "/ 0.005 |" in page.read_text()
    assert picture.stat().st_size > 5_000

    # Of another noise, the file has one row, by hand: nothing is left to do, and the page is of this noise alone.
    with table.open("a", newline="") as file:
        csv.DictWriter(file, rows["RES-VGP", "paper"]).writerow({**rows["RES-VGP", "paper"], "noise": "0.5"})
    assert "1 of 1 cells" in run("--models", "RES-VGP", "--settings", "paper", "--noise", "0.5")
    assert "Noise: 0.5 " in page.read_text()
    assert "## CR-2, mean over seeds" in page.read_text()
    assert "| VGP |" not in page.read_text()
    assert "RES-VGP | 1 |" in page.read_text()
    assert "EVGP-IFG | 1 |" not in page.read_text()


@pytest.mark.long
def test_a_cell_that_fails_leaves_no_row(run, tmp_path):
    with pytest.raises(SystemExit, match="1 cells failed"):
        run("--models", "EVGP-IF", "--settings", "skevgp", max_iter=-1)
    assert not (tmp_path / "table.csv").exists()


@pytest.mark.long
def test_a_network_has_a_row_like_the_others():
    from paper import results_table

    row = results_table.run(results_table.Cell("pendulum", "RES-DBNN", "skevgp-angles", 0, "raw", 0.0, "quick", 3))
    assert (row["n_parameters"], row["max_iter"]) == (634 + 2 * 15, "")
    assert 1 <= row["n_iter"] <= 400
    assert np.isnan(row["bound_per_row"])
    assert 0 < row["error_mean"] < 1


def test_noise_is_on_the_targets():
    from paper import results_table

    cell = results_table.Cell("pendulum", "EVGP-IFG", "skevgp", 0, "raw", 0.01, "quick", 0)
    exact, noisy = (results_table.data("pendulum", 0, noise, "quick") for noise in (0.0, 0.01))
    scale = exact[0].target.std(axis=0)  # of the training set, for both
    for true, measured in zip(exact, noisy, strict=True):
        np.testing.assert_allclose((measured.target - true.target).std(axis=0) / scale, 0.01, rtol=0.1)
        np.testing.assert_array_equal(measured.data, true.data)
    row = results_table.run(cell)
    assert (row["noise"], row["seed"], row["size"]) == (0.01, 0, "quick")
    assert row["error_mean"] >= 0.9 * np.linalg.norm(noisy[1].target - exact[1].target, axis=1).mean()


def test_a_page_says_where_it_falls_short():
    from paper.results_table_report import group, shortfalls

    def rows(model, *errors, cr2=0.95):
        names = {"system": "pendulum", "model": model, "setting": "skevgp", "angles": "raw", "seed": "0"}
        return [{**names, "error_mean": str(error), "cr2": str(cr2)} for error in errors]

    good = rows("EVGP-IFG", 0.004, 0.006) + rows("EVGP-IF", 0.01) + rows("VGP", 0.02)
    assert shortfalls(group(good)).count(": nowhere.") == 3
    bad = rows("EVGP-IFG", 0.004, 0.02, cr2=0.99) + rows("EVGP-IF", 0.011, cr2=0.92) + rows("RES-VGP", 0.001, cr2=0.5)
    order, paper, calibration = shortfalls(group(bad)).splitlines()
    assert shortfalls(group(bad), with_noise=True) == calibration
    assert "skevgp: EVGP-IFG 0.0120, EVGP-IF 0.0110; pendulum skevgp: EVGP-IF 0.0110, RES-VGP 0.00100." in order
    assert paper.endswith(": pendulum EVGP-IFG skevgp (0.0120, there 0.005).")
    assert calibration.endswith(": pendulum EVGP-IF skevgp (0.920); pendulum EVGP-IFG skevgp (0.990).")


def test_rows_beyond_the_training_range_are_told_apart():
    from paper.models import in_range

    train = Bunch(data=np.array([[0.0, -1.0], [1.0, 2.0], [0.5, 0.0]]))
    test = Bunch(data=np.array([[0.5, 0.0], [0.2, -3.0], [1.5, 2.5], [1.0, 2.0]]))
    found = in_range(train, test, np.array([1.0, 10.0, 30.0, 3.0]))
    assert found.pop("outside") == "0:1:1:1.5 1:1:2:2.5 1:1:-1:-3"
    assert found == {"error_inside": 2.0, "error_outside": 20.0, "inside": 0.5}
    alone = in_range(train, Bunch(data=test.data[:1]), np.array([1.0]))
    assert alone["inside"] == 1.0
    assert np.isnan(alone["error_outside"])
    assert alone["outside"] == ""


def test_intervals_of_normal_errors_hold_what_they_promise():
    from paper.models import PROMISED, reliability

    errors = np.random.default_rng(0).standard_normal((20_000, 2))
    held = reliability(errors, np.zeros_like(errors), np.ones_like(errors))
    np.testing.assert_allclose(list(held.values()), PROMISED, atol=0.01)
    assert list(held) == [f"within_{share}" for share in PROMISED]
    narrow = reliability(errors, np.zeros_like(errors), np.full_like(errors, 0.5))
    assert narrow["within_0.95"] < 0.7


@pytest.mark.long
def test_wrapped_angles_move_a_row_and_its_target():
    from paper import results_table

    raw, wrapped = (results_table.data("cartpole", 0, 0.0, "quick", angles) for angles in results_table.ANGLES)
    for before, after in zip(raw, wrapped, strict=True):
        turns = (before.data[:, 1] - after.data[:, 1]) / (2 * np.pi)
        assert np.abs(after.data[:, 1]).max() <= np.pi
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
        np.testing.assert_allclose(before.target[:, 1] - after.target[:, 1], 2 * np.pi * turns, atol=1e-9)
    assert turns.any()


def cartpole_rows(system, angles, *errors_by_model):
    """Of each model two data sets."""
    from paper.results_table_report import MODELS

    return [
        {
            **{"system": system, "angles": angles, "model": model, "setting": "paper", "seed": str(seed)},
            **{"error_mean": str(error * (1.1 if seed else 0.9)), "error_inside": str(error / 2)},
            **{"converged": "True", "max_iter": "", "n_iter": "9", "unlearned": "0", "noise": "0.0"},
            **{"inside": "0.9", "outside": "1:5:3.0:8.3"},
        }
        for model, error in zip(MODELS, errors_by_model, strict=True)
        for seed in (0, 1)
    ]


def test_the_likelier_cartpole_is_the_one_with_the_papers_errors():
    from paper.results_table_report import PAPER, closeness, group, outside, which_cartpole

    paper = [result.error for result in PAPER["cartpole"].values()]
    like = cartpole_rows("cartpole_damped", "raw", *paper)
    unlike = cartpole_rows("cartpole", "raw", *(5 * error for error in paper))
    groups = group(like + unlike)
    cases = ["cartpole_damped", "cartpole"]
    close, far = (closeness(groups, cases, "paper")[case] for case in cases)
    assert all(close[model] > far[model] for model in close)
    assert sum(close.values()) - sum(far.values()) > 5
    few = group(like + unlike + cartpole_rows("cartpole", "wrapped", *paper)[:4])
    assert set(closeness(few, [*cases, "cartpole, wrapped"], "paper")) == set(cases)
    *_, said = which_cartpole(groups)
    first, second = ([cell.strip() for cell in line.strip("|").split("|")] for line in said.splitlines()[2:])
    assert (first[0], second[0]) == ("cartpole_damped", "cartpole")
    assert first[1:] == [*(f"{value:.1f}" for value in close.values()), f"{sum(close.values()):.1f}", "0.0"]
    assert float(second[-1]) == pytest.approx(sum(close.values()) - sum(far.values()), abs=0.06)
    *_, lines = outside(groups)
    # A tenth of the rows, of 1.1 times the Error, and nine tenths of half the Error.
    assert f"| cartpole | 1 | 10.0% | {1 - 0.9 * 0.5 / 1.1:.0%} | theta 5 (3.0 → 8.3) |" in lines
    # What a model did not learn tells nothing of the plant.
    for row in groups["cartpole", "VGP", "paper"]:
        row["unlearned"] = "4"
    assert [set(own) for own in closeness(groups, cases, "paper").values()] == [set(close) - {"VGP"}] * 2


def test_two_data_sets_tell_little_of_their_scatter(monkeypatch):
    from paper import results_table_report
    from paper.results_table_report import UNSAID, likelihood

    def of_errors(*logarithms):
        return [{"error_mean": str(np.exp(value))} for value in logarithms]

    for error in (0.1, 1.0, 30.0):
        # Without scatter it is what the paper does not say.
        density = np.exp(-0.5 * (np.log(error) / UNSAID) ** 2) / (np.sqrt(2 * np.pi) * UNSAID)
        assert likelihood(error, of_errors(-1e-9, 1e-9)) == pytest.approx(np.log(density), rel=1e-3)
    # Without that Student's t, which of one degree is Cauchy's distribution.
    monkeypatch.setattr(results_table_report, "UNSAID", 0.0)
    for error in (0.1, 1.0, 30.0):
        scale = np.sqrt(2.0 * 1.5)
        density = 1.0 / (np.pi * scale * (1.0 + (np.log(error) / scale) ** 2))
        assert likelihood(error, of_errors(-1.0, 1.0)) == pytest.approx(np.log(density), abs=1e-3)


def test_a_limited_cell_and_one_of_fewer_seeds_are_marked():
    from paper.results_table_report import both

    row = {"error_mean": "0.2", "error_inside": "0.1", "converged": "True", "max_iter": "", "n_iter": "60"}
    row["unlearned"] = "0"
    assert both([row] * 4) == "0.200 / 0.100"
    assert both([row]) == "0.200 / 0.100 (1)"
    assert both([row] * 3 + [{**row, "converged": "False"}]) == "0.200 / 0.100\\*"
    assert both([{**row, "max_iter": "60"}] * 4) == "0.200 / 0.100\\*"
    assert both([row] * 3 + [{**row, "unlearned": "1"}]) == "0.200 / 0.100†"
    assert both([{**row, "unlearned": "nan"}] * 4) == "0.200 / 0.100"
    assert both([{**row, "max_iter": "5000"}] * 4) == "0.200 / 0.100"


def test_the_picture_tells_limited_unlearned_and_few_fits(drawn, tmp_path):
    from paper.results_table_plots import plot

    errors = {"VGP": ("0.3", 3), "RES-VGP": ("0.2", 4), "EVGP-IF": ("0.01", 4)}
    rows = [
        {
            **{"system": "pendulum", "model": model, "setting": "paper", "seed": str(seed), "angles": "raw"},
            **{"noise": "0.0", "size": "full", "error_mean": error, "error_inside": "0.001", "max_iter": ""},
            **{"n_iter": "9", "converged": str(model != "RES-VGP"), "unlearned": str(int(model == "EVGP-IF"))},
        }
        for model, (error, n_seeds) in errors.items()
        for seed in range(n_seeds)
    ]
    (figure,) = drawn(plot, rows, tmp_path / "table.png")
    (axes,) = (axes for axes in figure.axes if axes.get_title())
    squares = [line for line in axes.lines if line.get_marker() == "s" and len(line.get_ydata())]
    hollow = {round(float(line.get_ydata()[0]), 9): line.get_markerfacecolor() == "white" for line in squares}
    assert hollow == {0.3: False, 0.2: True, 0.01: True}
    crossed = [line.get_ydata()[0] for line in axes.lines if line.get_marker() == "x"]
    assert crossed == [pytest.approx(0.01)]
    (number,) = axes.texts
    assert number.get_text() == "3"
    # Below all that is drawn.
    drawn_above = axes.transData.inverted().transform(number.get_window_extent())[1, 1]
    assert drawn_above < min(min(line.get_ydata()) for line in axes.lines if len(line.get_ydata()))


def test_the_legend_is_in_a_panel_that_is_free(drawn, tmp_path):
    from paper.results_table_plots import plot

    rows = [
        {
            **{"system": system, "model": "VGP", "setting": "paper", "seed": str(seed), "angles": "raw"},
            **{"noise": "0.0", "size": "full", "error_mean": "0.1", "error_inside": "0.01", "max_iter": ""},
            **{"n_iter": "9", "converged": "True", "unlearned": "0"},
        }
        for system in ("pendulum", "cartpole", "acrobot")
        for seed in range(4)
    ]
    (figure,) = drawn(plot, rows, tmp_path / "table.png")
    free = figure.axes[-1].get_window_extent()
    box = figure.legends[0].get_window_extent()
    assert not figure.axes[-1].axison
    assert free.x0 < box.x0 < box.x1 < free.x1 + 1.0
    assert free.y0 < box.y0 < box.y1 < free.y1


def test_the_picture_of_noise_has_a_panel_for_each_setting_of_one_scale(drawn, tmp_path):
    from paper.models import PROMISED
    from paper.results_table_plots import COLOURS, plot

    settings = {"pendulum": ("skevgp", "skevgp-angles"), "acrobot": ("skevgp",)}
    rows = [
        {
            **{"system": system, "model": model, "setting": setting, "seed": "0", "angles": "raw", "noise": "0.01"},
            **{"size": "full", "max_iter": "", "n_iter": "9", "converged": str(model != "VGP")},
            **{f"within_{share}": str(share + 0.2 * (model == "VGP")) for share in PROMISED},
        }
        for system, own in settings.items()
        for setting in own
        for model in ("VGP", "EVGP-IFG")
    ]
    (figure,) = drawn(plot, rows, tmp_path / "noise.png")
    panels = {axes.get_title(): axes for axes in figure.axes if axes.axison}
    assert list(panels) == ["pendulum, skevgp", "pendulum, skevgp-angles", "acrobot, skevgp"]
    assert len({axes.get_ylim() for axes in panels.values()}) == 1
    for axes in panels.values():
        lines = {line.get_color(): line for line in axes.lines if len(line.get_xdata()) == len(PROMISED)}
        np.testing.assert_allclose(lines[COLOURS["VGP"]].get_ydata(), 0.2)
        np.testing.assert_allclose(lines[COLOURS["EVGP-IFG"]].get_ydata(), 0.0)
        assert [line.get_markerfacecolor() == "white" for line in lines.values()] == [True, False]


def messages_of_early_ends():
    """In the library's own words."""
    ended, going = (Minimum(np.zeros(1), 0.0, [0.0], converged) for converged in (True, False))
    yield messages.ended_early("LBFGS", going, n_iter=9, max_iter=9, tol=0.01)
    yield messages.ended_early("LBFGS", going, n_iter=9, max_iter=100, tol=None)
    yield messages.interrupted(9)
    yield messages.interrupted(9, max_time=1.0)
    yield messages.mini_batches_ended("Adam", going, False, 0.1, 512)
    yield messages.mini_batches_ended("Adam", ended, True, 0.1, 512)
    yield from (bnn._INTERRUPTED, bnn._NOT_FINITE, bnn._STILL_FELL)


@pytest.mark.parametrize("message", [*messages_of_early_ends()])
def test_searches_that_did_not_end_by_themselves_say_so(message):
    from paper.models import ENDED_EARLY

    assert ENDED_EARLY.search(message)


def test_warnings_tell_how_a_fit_ended():
    from paper.models import how_it_ended

    X = np.linspace(0.0, 6.0, 60)[:, np.newaxis]
    y = np.column_stack([np.sin(X), np.cos(X)])
    with pytest.warns(ConvergenceWarning) as short:
        EVGPRegressor(n_inducing=8, max_iter=1).fit(X, y)
    assert how_it_ended([str(short[0].message)], 2) == {"converged": False, "unlearned": 0}
    with pytest.warns(ConvergenceWarning) as blind:
        EVGPRegressor(
            kernel=ConstantKernel(1e-6, "fixed") * RBF(1e3, "fixed"),
            noise=Gaussian(variance=1.0),
            n_inducing=3,
            noise_cv=None,
        ).fit(X, y)
    found = how_it_ended([str(warning.message) for warning in blind], 2)
    assert found["unlearned"] == 2
    assert how_it_ended([], 2) == {"converged": True, "unlearned": 0}
    assert how_it_ended(["The kernel became white noise: to it"], 2) == {"converged": True, "unlearned": 2}
