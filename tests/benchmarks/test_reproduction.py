"""REPRODUCTION.md and the pages behind it say what the CSVs say."""

import importlib
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from sklearn.utils import Bunch

from .conftest import read

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
NOISY = "_noise0.01"
# Of scripts, a package that not everybody has.
NEEDED = {"identification": "pinocchio", "tracking": "pinocchio", "speed.casadi_latency": "casadi"}


@pytest.fixture(scope="module")
def page():
    return (ROOT / "REPRODUCTION.md").read_text()


@pytest.fixture
def results():
    from paper.reproduction import Results

    return Results(RESULTS)


def test_the_page_is_the_template_filled_in_from_the_csvs(page):
    from paper import reproduction

    assert page == reproduction.filled(reproduction.TEMPLATE.read_text(), reproduction.Results(RESULTS))


def rows_of(name, **wanted):
    """Rows of a CSV of full size that have these values (or one of a tuple of them), by seed."""
    choices = {column: {values} if isinstance(values, str) else set(values) for column, values in wanted.items()}
    rows = [row for row in full(name) if all(row[column] in values for column, values in choices.items())]
    assert rows
    return sorted(rows, key=lambda row: int(row["seed"]))


def table_rows(system, model, setting, noise="", **wanted):
    own = {"angles": "raw", **wanted}
    return rows_of(f"results_table{noise}", system=system, model=model, setting=setting, **own)


def numbers(rows, name):
    return np.array([float(row[name]) for row in rows])


def mean(rows, name="error_mean"):
    return numbers(rows, name).mean()


def three(value):
    """Digits."""
    return f"{value:#.3g}".rstrip(".")


def ends_of(shares):
    return f"{shares.min():.0%} to {shares.max():.0%}"


def by_variant(system):
    """Mean Error held back of each variant of the network and its epochs."""
    errors = {}
    for row in rows_of("network", system=system, tested_on="trajectories held back"):
        errors.setdefault((row["variant"], row["epochs"]), []).append(float(row["error_tested"]))
    return {key: np.mean(values) for key, values in errors.items()}


def best_network(system):
    """Variant and epochs of the lowest, with as many units as the paper."""
    return min((error, *key) for key, error in by_variant(system).items() if key[0] != "twice as wide")[1:]


def of_networks(system, variant, epochs, tested_on, name="error_tested"):
    return three(mean(rows_of("network", system=system, variant=variant, epochs=epochs, tested_on=tested_on), name))


def best_networks_name(system):
    variant, epochs = best_network(system)
    return ", ".join(filter(None, (variant, f"{epochs} epochs")))


def spread_over(system, *models):
    errors = [numbers(table_rows(system, model, "skevgp"), "error_mean") for model in models]
    ratios = [own.max() / own.min() for own in errors]
    return f"{three(min(ratios))} to {three(max(ratios))}"


def share_outside(system, *models):
    own = table_rows(system, models, "skevgp")
    inside, error_inside, error = (numbers(own, name) for name in ("inside", "error_inside", "error_mean"))
    return ends_of(1.0 - inside * error_inside / error)


def containing_with(system, n_trajectories, *models):
    own = rows_of("learning_curves", system=system, setting="skevgp", n_trajectories=n_trajectories, model=models)
    assert len(own) == 8
    return " and ".join(f"{min(numbers(own, name)):.2f} to {max(numbers(own, name)):.2f}" for name in ("cr1", "cr2"))


def times_below(settings):
    """Without the network, on both cartpoles with wrapped angles: the paper's Errors over ours."""
    paper = {"VGP": 0.188, "RES-VGP": 0.216, "EVGP-IF": 0.016, "EVGP-IFG": 0.011}
    times = [
        error / mean(table_rows(system, model, setting, angles="wrapped"))
        for model, error in paper.items()
        for system in ("cartpole", "cartpole_damped")
        for setting in settings
    ]
    return f"{min(times):,.0f} to {max(times):,.0f}"


def density(x, log_error, logs):
    """Of an Error and the variance, x / its own scale, that ours leave possible: inverse χ² with three degrees."""
    assert len(logs) == 4
    if x == 0.0:
        return 0.0
    variance = 3.0 * logs.var(ddof=1) / x * 1.25 + np.log(1.5) ** 2
    normal = np.exp(-0.5 * (log_error - logs.mean()) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
    return normal * np.sqrt(x / (2.0 * np.pi)) * np.exp(-0.5 * x)


def times_likelier(setting, paper):
    """The damped cartpole than the other, of some models' Errors in the paper."""
    value = 0.0
    for system, sign in (("cartpole_damped", 1.0), ("cartpole", -1.0)):
        for model, error in paper.items():
            logs = np.log(numbers(table_rows(system, model, setting), "error_mean"))
            value += sign * np.log(quad(density, 0.0, np.inf, (np.log(error), logs), limit=200)[0])
    return three(np.exp(value))


def hours(rows):
    """Of fits, each with one row."""
    return f"{sum(numbers(rows, 'fit_seconds')) / 3600:.1f} h"


def minutes(rows):
    """The same of fits that take less than an hour."""
    return f"{sum(numbers(rows, 'fit_seconds')) / 60:.0f} min"


def seconds(rows):
    """The same of fits that take less than a minute."""
    return f"{sum(numbers(rows, 'fit_seconds')):.0f} s"


def fits_of_beta():
    """A fit has many rows, one per weight."""
    seconds = {(row["model"], row["setting"], row["seed"]): row["fit_seconds"] for row in rows_of("beta")}
    return f"{sum(map(float, seconds.values())) / 3600:.1f} h"


def most_parameters(*cell):
    return f"{max(int(row['n_parameters']) for row in table_rows(*cell)):,}"


def rows_that_make(kind):
    return rows_of("error_rows", system="cartpole", kind=kind, noise="0.0")


HELD, TEST = "trajectories held back", "test set"
EARLY = ("early stopping", "1000")
BEYOND, WORST = "beyond a training column's range", "the worst hundredth"
ALL = {"VGP": 0.188, "RES-VGP": 0.216, "RES-DBNN": 0.044, "EVGP-IF": 0.016, "EVGP-IFG": 0.011}
# What a place says, again, from nothing but the CSV's rows.
PLACES = {
    "error acrobot EVGP-IF skevgp": lambda: three(mean(table_rows("acrobot", "EVGP-IF", "skevgp"))),
    "error pendulum EVGP-IFG skevgp largest": lambda: three(
        max(numbers(table_rows("pendulum", "EVGP-IFG", "skevgp"), "error_mean"))
    ),
    "error cartpole_damped RES-DBNN skevgp smallest": lambda: three(
        min(numbers(table_rows("cartpole_damped", "RES-DBNN", "skevgp"), "error_mean"))
    ),
    "error cartpole_damped EVGP-IF paper median": lambda: three(
        np.median(numbers(table_rows("cartpole_damped", "EVGP-IF", "paper"), "error_mean"))
    ),
    "error acrobot EVGP-IFG skevgp inside": lambda: three(
        mean(table_rows("acrobot", "EVGP-IFG", "skevgp"), "error_inside")
    ),
    "error acrobot EVGP-IFG skevgp row": lambda: three(
        mean(table_rows("acrobot", "EVGP-IFG", "skevgp"), "error_median")
    ),
    "spread skevgp cartpole EVGP-IF EVGP-IFG": lambda: spread_over("cartpole", "EVGP-IF", "EVGP-IFG"),
    "n_parameters acrobot RES-DBNN paper": lambda: most_parameters("acrobot", "RES-DBNN", "paper"),
    "n_parameters cartpole EVGP-IFG skevgp": lambda: most_parameters("cartpole", "EVGP-IFG", "skevgp"),
    "outside_share acrobot skevgp EVGP-IF EVGP-IFG": lambda: share_outside("acrobot", "EVGP-IF", "EVGP-IFG"),
    "containing acrobot EVGP-IF skevgp": lambda: " / ".join(
        f"{mean(table_rows('acrobot', 'EVGP-IF', 'skevgp'), name):.3f}" for name in ("cr1", "cr2", "cr3")
    ),
    "containing_with iiwa14 skevgp 60 EVGP-IF EVGP-IFG": lambda: containing_with("iiwa14", "60", "EVGP-IF", "EVGP-IFG"),
    "held acrobot EVGP-IF skevgp cr1": lambda: f"{mean(table_rows('acrobot', 'EVGP-IF', 'skevgp', NOISY), 'cr1'):.3f}",
    "held acrobot EVGP-IFG skevgp-angles error_mean": lambda: three(
        mean(table_rows("acrobot", "EVGP-IFG", "skevgp-angles", NOISY))
    ),
    "variant cartpole Adam EVGP-IF": lambda: three(
        mean(rows_of("cartpole", system="cartpole", variant="Adam", model="EVGP-IF"))
    ),
    "variant cartpole L-BFGS EVGP-IFG bound_per_row": lambda: three(
        mean(rows_of("cartpole", system="cartpole", variant="L-BFGS", model="EVGP-IFG"), "bound_per_row")
    ),
    "network cartpole best name": lambda: best_networks_name("cartpole"),
    "network cartpole_damped best name": lambda: best_networks_name("cartpole_damped"),
    "network cartpole_damped best": lambda: three(by_variant("cartpole_damped")[best_network("cartpole_damped")]),
    "network cartpole early": lambda: three(by_variant("cartpole")[EARLY]),
    "network cartpole early error_tested test": lambda: of_networks("cartpole", *EARLY, TEST),
    "network cartpole best error_tested test": lambda: of_networks("cartpole", *best_network("cartpole"), TEST),
    "network cartpole best error_learned": lambda: of_networks(
        "cartpole", *best_network("cartpole"), HELD, "error_learned"
    ),
    "takes results_table_noise0.01 system=acrobot,cartpole": lambda: minutes(
        rows_of("results_table_noise0.01", system=("acrobot", "cartpole"))
    ),
    "takes learning_curves setting=paper": lambda: hours(rows_of("learning_curves", setting="paper")),
    "takes beta": fits_of_beta,
    "takes network": lambda: minutes(rows_of("network")),
    "wrapped_below paper skevgp": lambda: times_below(("paper", "skevgp")),
    "odds skevgp": lambda: times_likelier("skevgp", ALL),
    "odds paper RES-VGP": lambda: times_likelier("paper", {name: ALL[name] for name in ALL if name != "RES-VGP"}),
    f'error_rows 0.0 cartpole "{BEYOND}" of_rows': lambda: f"{mean(rows_that_make(BEYOND), 'of_rows'):.1%}",
    "error_rows 0.0 cartpole 'the worst hundredth' cr2": lambda: three(mean(rows_that_make(WORST), "cr2")),
    "error_rows 0.0 cartpole 'the worst hundredth' of_error": lambda: ", ".join(
        f"{share:.0%}" for share in numbers(rows_that_make(WORST), "of_error")
    ),
    "paper iiwa14 EVGP-IFG error cr2": lambda: "0.027 / 0.480",
}


@pytest.mark.parametrize("place", PLACES)
def test_a_place_says_what_the_rows_say(results, place):
    from paper.reproduction import filled

    assert filled(f"# A\n\n{{{{{place}}}}}", results).split("\n")[-1] == PLACES[place]()


def test_a_line_of_what_was_tried_says_what_the_rows_say(results):
    from paper.reproduction import filled

    of_model = {"system": "cartpole", "model": "EVGP-IFG"}
    own, adam = (rows_of("cartpole", variant=variant, **of_model) for variant in ("L-BFGS, full posterior", "Adam"))
    errors = {row["seed"]: float(row["error_mean"]) for row in adam}
    against = mean(own) / np.mean([errors[row["seed"]] for row in own])
    (line,) = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in filled("# A\n\n{{tried cartpole EVGP-IFG}}", results).splitlines()
        if re.match(r"\| L-BFGS, full posterior(\\\*)? \|", line)
    ]
    assert line[0].endswith("*") == any(row["converged"] == "False" for row in own)
    assert line[1:] == [
        f"{three(mean(own))} ({', '.join(map(three, numbers(own, 'error_mean')))})",
        three(mean(own, "error_inside")),
        f"{against:.2f}",
        *(three(mean(own, name)) for name in ("error_median", "error_p99")),
        f"{mean(own, 'cr2'):.3f}",
        f"{mean(own, 'bound_per_row'):.2f}",
        f"{mean(own, 'fit_seconds'):.0f}",
    ]


def test_evgps_intervals_hold_what_they_promise_with_noise():
    normal = np.array([0.683, 0.954, 0.997])
    cells = {}
    for row in full("results_table_noise0.01"):
        if row["model"].startswith("EVGP"):
            key = (row["system"], row["model"], row["setting"])
            cells.setdefault(key, []).append([float(row[f"cr{k}"]) for k in (1, 2, 3)])
    away = {key: np.abs(np.mean(ratios, axis=0) - normal).max() for key, ratios in cells.items()}
    assert {key for key, distance in away.items() if distance > 0.02} == {
        ("acrobot", model, "skevgp") for model in ("EVGP-IF", "EVGP-IFG")
    }


def test_every_place_of_the_template_is_filled(results):
    from paper.reproduction import FILLERS, MISSING, TEMPLATE

    places = re.findall(r"\{\{(.+?)\}\}", TEMPLATE.read_text())
    assert len(places) > 50
    said = {place: FILLERS[name](results, *rest) for place in places for name, *rest in [shlex.split(place)]}
    empty = [place for place, text in said.items() if MISSING in text or re.search(r"\bnan\b|^\s*$", text)]
    assert empty == []


def test_a_place_without_a_function_or_a_number_is_seen(results):
    from paper.reproduction import MISSING, filled

    with pytest.raises(KeyError, match="figure"):
        filled("{{figure 7}}", results)
    for place in (
        "error pendulum EVGP-IF nowhere",
        "spread skevgp moon EVGP-IF",
        "n_parameters moon EVGP-IF skevgp",
        "outside_share moon skevgp EVGP-IF",
        "containing moon EVGP-IF skevgp",
        "containing_with iiwa14 skevgp 1 EVGP-IF",
        "held moon EVGP-IF skevgp cr1",
        "variant cartpole Eve EVGP-IF",
        "network moon best",
        "network moon best name",
    ):
        assert filled(f"# A\n\n{{{{{place}}}}}", results).endswith(f"-->\n\n{MISSING}"), place


def full(name):
    """Rows of a CSV, without those of a short run. (Some have no column that tells, for short runs are not in them.)"""
    return [row for row in read(RESULTS / f"{name}.csv") if row.get("size", "full") == "full"]


@pytest.mark.parametrize("name", ["results_table", "results_table_noise0.01"])
def test_the_page_of_the_results_is_what_its_script_writes(name):
    from paper import results_table_report

    assert (RESULTS / f"{name}.md").read_text() == text_of(results_table_report.paragraphs(full(name)))


@pytest.mark.parametrize(
    "path",
    [
        *("paper.cartpole", "paper.data_sets", "paper.error_rows", "paper.learning_curves_report", "paper.network"),
        *("auto_inducing", "calibration", "identification", "outliers", "rollouts", "sharing", "swing_up", "tracking"),
        *("peers.against_gpr_report", "speed.casadi_latency", "speed.latency", "speed.many_rows"),
        "speed.shared_weights",
    ],
)
def test_a_page_is_what_its_script_writes(path):
    for needed in (name for script, name in NEEDED.items() if script == path):
        pytest.importorskip(needed)
    module, stem = importlib.import_module(path), path.split(".")[-1].removesuffix("_report")
    written = module.report(full(stem)) if path == "auto_inducing" else module.paragraphs(full(stem))
    assert (RESULTS / f"{stem}.md").read_text() == text_of(written)


def test_the_page_of_the_other_libraries_is_what_its_script_writes():
    from peers import against_peers_report

    rows, curves = (read(RESULTS / f"against_peers{which}.csv") for which in ("", "_curves"))
    assert (RESULTS / "against_peers.md").read_text() == text_of(against_peers_report.paragraphs(rows, curves))


def test_the_page_of_the_complexity_is_what_its_script_writes():
    from paper import complexity_report

    rows = read(RESULTS / "complexity.csv")
    assert all(curve.is_in(rows) for curve in complexity_report.CURVES)
    written = complexity_report.paragraphs(complexity_report.CURVES, rows)
    assert (RESULTS / "complexity.md").read_text() == text_of(written)


def test_the_page_of_the_real_arms_is_what_its_script_writes():
    pytest.importorskip("pinocchio")
    import real_arms

    rows, found = map(full, ("real_arms", "real_arms_parameters"))
    written = real_arms.paragraphs(rows, found, "real_arms.png")
    assert (RESULTS / "real_arms.md").read_text() == text_of(written)


def test_the_page_of_the_toy_data_is_what_its_script_writes():
    from paper import toy

    rows = [row for row in full("toy") if row["data"] == "snelson"]
    # Snelson's points are not here, nor are the fitted models: what the page has of the points stands in for them, and
    # the table of the models' differences is left out.
    x = np.array([[0.0], [6.0]])
    curve = Bunch(mean=np.zeros(len(toy.GRID)), std=np.zeros(len(toy.GRID)))
    written = toy.paragraphs(rows, dict.fromkeys(toy.MODELS, curve), Bunch(data=x, target=4.19 * x[:, 0]))
    page = (RESULTS / "toy.md").read_text().rstrip("\n").split("\n\n")
    assert len(page) == len(written)
    differences = [own for own, part in zip(page, written, strict=True) if own != part.strip("\n")]
    assert [text.split("\n")[0] for text in differences] == [
        "|  | mean, inside | mean, outside | std, inside | std, outside |"
    ]


def test_the_page_of_the_weights_is_what_its_script_writes():
    from paper import beta_report

    written = beta_report.paragraphs(full("beta"), RESULTS / "beta.csv")
    assert (RESULTS / "beta.md").read_text() == text_of(written)


def test_the_page_of_the_claims_is_what_its_script_writes():
    from paper import claims

    assert (RESULTS / "claims.md").read_text() == text_of(claims.paragraphs(claims.verdicts(RESULTS)))


def text_of(parts):
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def test_what_it_names_is_there(page):
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", page)
    scripts = re.findall(r"python (benchmarks/[\w/]+\.py)", page)
    assert len(links) > 20
    assert len(scripts) > 5
    assert [path for path in (*links, *scripts) if not (ROOT / path).exists()] == []


def test_the_readme_has_the_same_errors():
    readme = (ROOT / "README.md").read_text()
    columns = {"skevgp": 3, "skevgp-angles": 4, "skevgp-nominal": 5}
    shown = {
        cells[0].split()[0]: cells
        for line in readme.splitlines()
        if re.match(r"\| (pendulum|cartpole|acrobot|iiwa14).* \| \d+ \| 0\.\d+ \|", line)
        for cells in [[cell.strip() for cell in line.strip("|").split("|")]]
    }
    assert len(shown) == 5
    errors = {}
    for row in read(RESULTS / "results_table.csv"):
        if row["model"] == "EVGP-IFG" and row["setting"] in columns and row["angles"] == "raw":
            errors.setdefault((row["system"], row["setting"]), []).append(float(row["error_mean"]))
    compared = 0
    for (system, setting), values in errors.items():
        text = shown.get(system, [""] * 6)[columns[setting]]
        if text:
            assert len(values) == 4
            assert text == f"{np.mean(values):.{len(text) - 2}f}"
            compared += 1
    assert compared == 10


def test_what_is_still_to_be_run_is_counted_and_timed():
    from paper import unfinished
    from paper.models import MODELS, SETTINGS, SYSTEMS, has

    def fit(system, model, setting, seed, angles="raw", **changes):
        return {
            **{"system": system, "model": model, "setting": setting, "seed": str(seed), "angles": angles},
            **{"converged": "True", "max_iter": "", "n_iter": "500", "fit_seconds": "36", "inside": "1", **changes},
        }

    table = [
        fit(system, model, setting, seed, angles)
        for system in SYSTEMS
        for model in MODELS
        for setting in SETTINGS
        for angles in ("raw", "wrapped")
        for seed in range(4)
        if has(system, model, setting, angles)
    ]
    curves = [
        fit(system, model, setting, seed, n_trajectories=str(n))
        for setting, systems in unfinished.CURVES.items()
        for system in systems
        for model in MODELS
        for n in unfinished.N_TRAJECTORIES[system]
        for seed in range(4)
    ]

    def said(rows, more=curves, noisy=table):
        lines = unfinished.paragraph(rows, noisy, more).splitlines()[2:]
        return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]

    assert said(table)[-1][1] == "0"

    def without(rows, keys, changes=None):
        """What has these, missing or with changes."""
        kept = [row for row in rows if not keys.items() <= row.items()]
        return kept + [{**row, **changes} for row in rows if changes and keys.items() <= row.items()]

    cell = {"system": "acrobot", "model": "VGP", "setting": "paper", "angles": "raw"}
    missing = without(table, {**cell, "seed": "3"})
    assert said(missing) == [["Table 4: acrobot, paper", "VGP 1", "0.1"], ["all", "1", "0.1"]]
    # Adam's with a twentieth of its steps would take twenty times as long; those of RES-VGP tell it, too.
    cut = without(table, cell, {"max_iter": "800", "n_iter": "800", "fit_seconds": "360"})
    assert said(cut)[0] == ["Table 4: acrobot, paper", "VGP 4", "8.0"]
    assert said(without(table, cell))[0] == ["Table 4: acrobot, paper", "VGP 4", "0.1"]
    # Nobody knows of a fit by L-BFGS that a limit ended, if there is no other.
    own = {"system": "iiwa14", "setting": "skevgp-nominal"}
    limited = [{**row, "converged": "False"} if row["setting"] == "skevgp-nominal" else row for row in table]
    assert said(limited)[0] == ["Table 4: iiwa14, skevgp-nominal", "EVGP-IF 4, EVGP-IFG 4", "0.1"]
    alone = [row for row in limited if row["system"] != "iiwa14" or own.items() <= row.items()]
    assert "and more" in said(alone)[-1][2]
    # A network's fit, and one by L-BFGS, to half of the rows takes half of the time.
    fewer = without(curves, {"system": "cartpole", "model": "VGP", "setting": "skevgp", "n_trajectories": "24"})
    slow = without(table, {"system": "cartpole", "model": "VGP", "setting": "skevgp"}, {"fit_seconds": "3600"})
    assert said(slow, fewer) == [["Figure 6: cartpole, skevgp", "VGP 4", "2.0"], ["all", "4", "2.0"]]
    # One of so many rows tells more than one of all of them.
    one = fit("cartpole", "VGP", "skevgp", 0, n_trajectories="24", fit_seconds="7200")
    assert said(slow, [*fewer, one]) == [["Figure 6: cartpole, skevgp", "VGP 3", "6.0"], ["all", "3", "6.0"]]
    # A network is at rest after its last epoch, and not before.
    network = {"system": "cartpole", "model": "RES-DBNN", "setting": "skevgp", "seed": "0", "angles": "raw"}
    for n_iter, n_fits in (("1000", "0"), ("100", "1")):
        assert said(without(table, network, {"converged": "False", "n_iter": n_iter}))[-1][1] == n_fits
    # From the author's starts a fit stops where it does; by --max-iter it is cut short.
    authors = {"system": "pendulum", "model": "VGP", "setting": "author"}
    assert said(without(table, authors, {"converged": "False"}))[-1][1] == "0"
    assert said(without(table, authors, {"max_iter": "500"}))[-1][1] == "4"
    # With noise, too; a row from before there were all columns is no row, and more seeds do not make up for others.
    lines = said(table, noisy=without(table, {"system": "iiwa14", "model": "EVGP-IF", "seed": "1"}))
    assert [line[:2] for line in lines[:-1]] == [
        ["Table 4 with noise: iiwa14, skevgp", "EVGP-IF 1"],
        ["Table 4 with noise: iiwa14, skevgp-nominal", "EVGP-IF 1"],
    ]
    assert said(without(table, cell, {"inside": "nan"}))[-1][1] == "4"
    more = [fit(**{name: cell[name] for name in ("system", "model", "setting")}, seed=seed) for seed in (0, 4, 5, 6, 7)]
    assert said(table + more)[-1][1] == "0"
    assert said(missing + more)[-1][1] == "1"
