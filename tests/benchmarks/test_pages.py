"""Pages of results have the numbers of their CSVs, and REPRODUCTION.md has the numbers of the pages."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"


@pytest.fixture
def script(monkeypatch):
    """Import a benchmark, with the folder of benchmarks on the path."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(ROOT / "benchmarks")):
            del sys.modules[name]


# page -> (script, tables of the full runs' rows)
PAGES = {
    "complexity": ("paper.table3", lambda own, rows: {"complexity": own.table_of(list(own.CURVES), rows)}),
    "results_table": ("paper.table4", lambda own, rows: own.tables_of(rows)),
    "results_table_noise0.01": ("paper.table4", lambda own, rows: own.tables_of(rows)),
    "toy": ("paper.figure5", lambda own, rows: {"snelson, models": own.table_of(rows)}),
    "learning_curves": ("paper.figure6", lambda own, rows: own.tables_of(own.named(rows))),
    "beta": ("paper.figure7", lambda own, rows: {"acrobot": own.table_of(rows)}),
    "against_gpr": ("peers.against_gpr", lambda own, rows: own.tables_of(rows)),
    "latency": ("speed", lambda own, rows: own.PARTS["latency"][3](rows)),
    "casadi_latency": ("speed", lambda own, rows: own.casadi_tables(rows)),
    "evaluation_cost": ("speed", lambda own, rows: own.PARTS["evaluation"][3](rows)),
    "scaling": ("speed", lambda own, rows: own.PARTS["rows"][3](rows)),
    "many_rows": ("speed", lambda own, rows: own.PARTS["million"][3](rows)),
    "few_rows": ("few_rows", lambda own, rows: own.tables(rows)),
    "exact_fits": ("speed", lambda own, rows: own.PARTS["exact"][3](rows)),
    "tabular": ("tables", lambda own, rows: own.tables_of_models(rows)),
    "auto_inducing": ("tables", lambda own, rows: own.tables_of_inducing(rows)),
    "rollouts": ("control", lambda own, rows: own.rollout_tables(rows)),
    "swing_up": ("control", lambda own, rows: own.swing_up_tables(rows)),
    "realaigym": ("realaigym", lambda own, rows: own.tables(rows)),
    "tracking": ("control", lambda own, rows: own.tracking_tables(rows)),
    "identification": ("robots", lambda own, rows: own.identification_tables(rows)),
    "physics": ("physics", lambda own, rows: own.tables_of_errors(rows)),
    "physics_curves": ("physics", lambda own, rows: own.tables_of_curves(rows)),
    "machines": ("machines", lambda own, rows: own.inverse_tables(rows)),
    "machines_forward": ("machines", lambda own, rows: own.forward_tables(rows)),
    "machines_check": ("machines", lambda own, rows: own.check_tables(rows)),
    "machines_contact": ("machines", lambda own, rows: own.contact_tables(rows)),
    "physics_wrong": ("physics", lambda own, rows: own.tables_of_wrong(rows)),
    "parameters": ("parameters", lambda own, rows: own.pendulum_tables(rows)),
    "parameters_misfit": ("parameters", lambda own, rows: own.misfit_tables(rows)),
    "parameters_real": ("parameters", lambda own, rows: own.real_tables(rows)),
    "parameters_cost": ("parameters", lambda own, rows: own.cost_tables(rows)),
    "physics_rollouts": ("physics", lambda own, rows: own.tables_of_rollouts(rows)),
    "bounds": ("bounds", lambda own, rows: own.tables_of(rows, own.harness.frame(RESULTS / "bounds_cost.csv"))),
    "calibration": ("calibration", lambda own, rows: own.tables_of(rows)),
    "robustness": ("robustness", lambda own, rows: own.tables_of(rows)),
    "neighbors": ("peers.neighbors", lambda own, rows: own.tables_of(rows)),
    "neighbors_curves": ("peers.neighbors", lambda own, rows: own.tables_of_curves(rows)),
}


# One page is enough for the quick tests.
SAMPLE = "bounds"


@pytest.mark.parametrize(
    "page", [page if page == SAMPLE else pytest.param(page, marks=pytest.mark.long) for page in PAGES]
)
def test_page_has_the_numbers_of_its_csv(script, page):
    name, tables_of = PAGES[page]
    own, text = script(name), (RESULTS / f"{page}.md").read_text()
    rows = own.harness.frame(RESULTS / f"{page}.csv")
    rows = rows[rows["size"] == "full"] if "size" in rows else rows
    tables = tables_of(own, rows)
    assert all(f"<!-- table: {table} -->" in text for table in tables)
    assert own.harness.filled(text, tables) == text


@pytest.mark.long
def test_pages_of_several_csvs_have_their_numbers(script):
    peers, robots, tables = (script(name) for name in ("peers.against_peers", "robots", "tables"))
    frame, filled = peers.harness.frame, peers.harness.filled
    rows, curves = (frame(RESULTS / f"against_peers{end}.csv") for end in ("", "_curves"))
    found = {"against_peers": peers.tables_of(rows, curves)}
    found["splits"] = peers.tables_of(frame(RESULTS / "splits.csv"), curves[:0])
    arms = (frame(RESULTS / f"real_arms{end}.csv", size="full") for end in ("", "_parameters"))
    found["real_arms"] = robots.real_tables(*arms)
    found["payload"] = robots.payload_tables(
        *(frame(RESULTS / f"payload{end}.csv", size="full") for end in ("_real", ""))
    )
    for page, own in found.items():
        text = (RESULTS / f"{page}.md").read_text()
        assert filled(text, own) == text, page
    guide = tables.PAGE.read_text()
    assert tables.guide(guide, frame(RESULTS / "tabular.csv")) == guide


def test_tables_of_reproduction_are_those_of_the_pages():
    known = {line.strip() for page in RESULTS.glob("*.md") for line in page.read_text().splitlines()}
    starts = tuple(
        f"| {name}"
        for name in ("pendulum", "cartpole", "acrobot |", "iiwa14", "VGP |", "RES-VGP |", "RES-DBNN |", "Adam")
    )
    lines = [line.strip() for line in (ROOT / "REPRODUCTION.md").read_text().splitlines() if line.startswith(starts)]
    assert len(lines) > 100
    assert not [line for line in lines if line not in known]


def rows(name, **where):
    """The rows of a CSV, of full runs, in which columns have these values."""
    found = pd.read_csv(RESULTS / f"{name}.csv")
    where = {"size": "full", **where} if "size" in found else where
    return found.loc[np.all([found[key] == value for key, value in where.items()], axis=0)] if where else found


def errors(system):
    found = rows("results_table", system=system, model="EVGP-IFG", angles="raw").groupby("setting")["error_mean"]
    spread = found.max()["skevgp"] / found.min()["skevgp"]
    return {"ours": [found.mean().get(setting) for setting in ("skevgp", "skevgp-angles")], "spread": spread}


def cell(system, model="EVGP-IFG", setting="skevgp"):
    """Mean Errors of Table 4, over all rows and over those inside the training range."""
    found = rows("results_table", system=system, model=model, setting=setting, angles="raw")
    return [found["error_mean"].mean(), found["error_inside"].mean()]


def gains(system, noise=0.01):
    """Errors of RES-VGP and EVGP-IFG from 4 trajectories, and from all."""
    found = rows("physics", system=system, noise=noise).groupby(["trajectories", "model"])["error"].mean()
    return [found[n, model] for n in (4, 0) for model in ("RES-VGP", "EVGP-IFG")]


def noise_free_wins():
    each = [gains(system, 0.0) for system in ("pendulum", "cartpole", "cartpole_damped", "acrobot")]
    return [sum(own[1] <= own[0] for own in each) + sum(own[3] <= own[2] for own in each)]


def peer(dataset, name, sharing="none"):
    own = rows("against_peers", dataset=dataset, peer=name, sharing=sharing)
    return [own["seconds"].mean(), (own["bound"] / own["n_train"]).mean(), own["rmse"].mean(), own["nlpd"].mean()]


def on_kin40k(model, sets=("kin40k-8000", "kin40k")):
    """RMSE and seconds of a fit to 8,000 and to 36,000 rows."""
    found = [rows("neighbors", set=name, model=model) for name in sets]
    return [value for own in found for value in (own["rmse"].mean(), own["cpu_seconds"].mean())]


def on_waves(n, *models):
    """Errors and processor seconds of fits to n rows."""
    found = rows("neighbors_curves", n_train=n).set_index("model").loc[list(models), ["rmse", "cpu_seconds"]]
    return found.to_numpy().ravel()


def arm(model, robot="ur10e", split="three"):
    own = rows("real_arms", robot=robot, split=split, model=model)
    within = np.average(own["cr2"].fillna(0.0), weights=own["n_test"])
    return [
        np.exp(np.log(own["ratio"]).mean()),
        *own.groupby("joint")["ratio"].mean(),
        within,
        own["fit_seconds"].mean(),
    ]


def inducing():
    found = rows("auto_inducing").pivot_table(index="name", columns="model", values=["nlpd", "seconds"])
    good = [(found["nlpd", model] - found["nlpd", "exact"] < 0.02).sum() for model in ("auto", "100")]
    return [*good, (found["seconds", "auto"] / found["seconds", "100"]).max()]


def jitters():
    found = rows("robustness", part="jitter").pivot(index="case", columns="variant", values="error").clip(lower=1e-9)
    ratio = found["default"] / found.drop(columns="default").min(axis=1)
    return [(ratio <= 1.1).sum(), ratio.max()]


def total(name, column, **where):
    return rows(name, **where)[column].sum()


def swing_ups():
    """Successful runs with noise, with physics and without: after 1.5 s of data, and after more."""
    found = [rows("swing_up", model=model, noise=0.01) for model in ("evgp-ifg", "gp")]
    few = [own.loc[own["seconds"] == 1.5, "success"].sum() for own in found]
    return [*few, *(own["success"].sum() - n for own, n in zip(found, few, strict=True))]


def on_realaigym(kind, seconds):
    """Number of seeds of each robot, or one if it is the same, and mean scores."""
    found = rows("realaigym", kind=kind, seconds=seconds).groupby("robot")["score"]
    return [*dict.fromkeys(found.size()), *found.mean()]


def leaderboards_controller(*columns):
    """Means of the acrobot and of the pendubot."""
    found = rows("realaigym", kind="TVLQR").groupby("robot")[list(columns)].mean()
    return [found.loc[robot, column] for column in columns for robot in ("acrobot", "pendubot")]


# Words with {} for numbers, and where these are from.
SAID = [
    ("README", "with | |---|---|---|---|---| | pendulum | {} | {} | {} | {} |", lambda: gains("pendulum")),
    ("README", "| cartpole with friction | {} | {} | {} | {} |", lambda: gains("cartpole_damped")),
    ("README", "| acrobot | {} | {} | {} | {} |", lambda: gains("acrobot")),
    ("README", "lower error in {} of these 8 cases", noise_free_wins),
    (
        "README",
        "an error of {} after {} s, and the model with neighbours {} after {} s",
        lambda: on_waves(4000, "GPR", "neighbors"),
    ),
    (
        "README",
        "boosting (up to 2,000 trees) has {} after {} s, and the model with neighbours {} after {} s",
        lambda: on_waves(100_000, "boosting", "neighbors"),
    ),
    ("docs/guide/neighbors", "`HistGradientBoostingRegressor` | {} | {} | {} | {} |", lambda: on_kin40k("boosting")),
    ("docs/guide/neighbors", "`EVGPRegressor(n_inducing=200)` | {} | {} | {} | {} |", lambda: on_kin40k("sparse")),
    ("docs/guide/neighbors", "`n_neighbors=60` | {} | {} | {} | {} |", lambda: on_kin40k("neighbors")),
    (
        "docs/guide/neighbors",
        "GPBoost, the same approximation | {} | {} |",
        lambda: on_kin40k("GPBoost-VIF", ["kin40k-8000"]),
    ),
    ("docs/reproduction", "| cartpole | 60 | 0.011 | {} | {} |", lambda: errors("cartpole")["ours"]),
    ("docs/reproduction", "| cartpole_damped | 60 | 0.011 | {} | {} |", lambda: errors("cartpole_damped")["ours"]),
    ("docs/reproduction", "| acrobot | 150 | 0.131 | {} | {} |", lambda: errors("acrobot")["ours"]),
    ("docs/reproduction", "range, the error of cartpole_damped is {}.", lambda: cell("cartpole_damped")[1:]),
    ("docs/reproduction", "on the acrobot ({})", lambda: cell("acrobot", "RES-VGP")[:1]),
    ("docs/which_model", "physics alone |" + 9 * " {} |", lambda: arm("least squares, prior")),
    ("docs/which_model", "| `InverseDynamics` | **{}** |" + 8 * " {} |", lambda: arm("EVGP")),
    (
        "docs/which_model",
        "least squares, then a Gaussian process |" + 9 * " {} |",
        lambda: arm("least squares, then GP"),
    ),
    ("docs/which_model", "the error of `InverseDynamics` is {} times", lambda: arm("EVGP", "ur10", "whole")[:1]),
    ("docs/benchmarks", "took GPflow {} s", lambda: peer("elevators", "GPflow SGPR")[:1]),
    ("docs/benchmarks", "fixed jitters in {}, and at most {} times that", jitters),
    ("docs/benchmarks", 'on {} of 20 sets, 100 points on {}. "auto" took up to {} times', inducing),
    (
        "docs/benchmarks",
        "{} of 28 runs end upright with physics after 1.5 s of data, and {} without. "
        "From 3 s on, {} of 112 do with it, and {} without",
        swing_ups,
    ),
    (
        "docs/benchmarks",
        "break a limit: {} of 322 do",
        lambda: [total("tracking", "value", measure="broken", case="Boole")],
    ),
    (
        "docs/guide/realaigym",
        "| `InertiaForceGravity`, masses unknown | 20 s | {} | {} | {} |",
        lambda: on_realaigym("IFG", 20),
    ),
    (
        "docs/guide/realaigym",
        "| `InertiaForceGravity`, masses unknown | 60 s | {} | {} | {} |",
        lambda: on_realaigym("IFG", 60),
    ),
    (
        "docs/guide/realaigym",
        "| `InertiaForceGravity`, masses unknown | 180 s | {} | {} | {} |",
        lambda: on_realaigym("IFG", 180),
    ),
    (
        "docs/guide/realaigym",
        "| URDF 20 % off, parameters learned | 20 s | {} | {} | {} |",
        lambda: on_realaigym("parameters", 20),
    ),
    (
        "docs/guide/realaigym",
        "| URDF 20 % off, parameters learned | 60 s | {} | {} | |",
        lambda: on_realaigym("parameters", 60),
    ),
    ("docs/guide/realaigym", "| URDF 20 % off | 20 s | {} | {} | {} |", lambda: on_realaigym("URDF", 20)),
    ("docs/guide/realaigym", "| URDF 20 % off | 60 s | {} | {} | |", lambda: on_realaigym("URDF", 60)),
    ("docs/guide/realaigym", "| without physics | 20 s | {} | {} | {} |", lambda: on_realaigym("GP", 20)),
    ("docs/guide/realaigym", "| without physics | 60 s | {} | {} | |", lambda: on_realaigym("GP", 60)),
    ("docs/guide/realaigym", "| the true model | | {} | {} | {} |", lambda: on_realaigym("truth", 0)),
    (
        "docs/benchmarks",
        "the scores of acrobot and pendubot are {} and {}.",
        lambda: on_realaigym("IFG", 180)[1:],
    ),
    (
        "docs/guide/realaigym",
        "scores {} on the acrobot and {} on the pendubot",
        lambda: leaderboards_controller("score"),
    ),
    (
        "docs/guide/realaigym",
        "velocities are {} and {}, and",
        lambda: leaderboards_controller("velocity noise"),
    ),
    ("REPRODUCTION", "{} times the smallest for EVGP-IFG", lambda: [errors("pendulum")["spread"]]),
    ("REPRODUCTION", "{} times on the damped one", lambda: [errors("cartpole_damped")["spread"]]),
    ("REPRODUCTION", "the prior of 0.2, and an Error of {}.", lambda: cell("cartpole")[:1]),
    ("REPRODUCTION", "the defaults have {} over all rows and {} inside", lambda: cell("cartpole_damped")),
    ("REPRODUCTION", "took {} h for Table 4,", lambda: [total("results_table", "fit_seconds") / 3600]),
]


@pytest.mark.parametrize(("page", "words", "measured"), SAID)
def test_sentences_have_the_numbers_of_the_csvs(page, words, measured):
    """Up to the digits that they show."""
    pattern = re.escape(words).replace(r"\{\}", r"(-?[\d.,]*\d)").replace(r"sets\]", r"sets\].*?")
    (found,) = re.finditer(pattern, " ".join((ROOT / f"{page}.md").read_text().split()))
    for text, value in zip(found.groups(), measured(), strict=True):
        assert abs(float(text.replace(",", "")) - value) <= 0.501 * 10.0 ** -len(text.partition(".")[2]), text
