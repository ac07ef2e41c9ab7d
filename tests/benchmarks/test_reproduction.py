"""REPRODUCTION.md and the pages behind it say what the CSVs say."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from .conftest import read

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"


@pytest.fixture(scope="module")
def page():
    return (ROOT / "REPRODUCTION.md").read_text()


def test_the_page_is_the_template_filled_in_from_the_csvs(page):
    from paper import reproduction

    assert page == reproduction.filled(reproduction.TEMPLATE.read_text(), reproduction.Results(RESULTS))


def test_a_place_without_a_function_or_a_number_is_seen():
    from paper.reproduction import MISSING, Results, filled

    results = Results(RESULTS)
    with pytest.raises(KeyError, match="figure"):
        filled("{{figure 7}}", results)
    assert filled("# A\n\n{{error pendulum EVGP-IF nowhere}}", results).endswith(f"-->\n\n{MISSING}")
    rows = [row for row in read(RESULTS / "results_table.csv") if row["angles"] == "raw" and row["size"] == "full"]
    wanted = ("pendulum", "EVGP-IFG", "skevgp")
    errors = [float(row["error_mean"]) for row in rows if (row["system"], row["model"], row["setting"]) == wanted]
    shown = float(filled("# A\n\n{{error pendulum EVGP-IFG skevgp largest}}", results).split()[-1])
    assert shown == pytest.approx(max(errors), rel=5e-3)
    own = [row for row in rows if (row["system"], row["model"], row["setting"]) == ("acrobot", "EVGP-IF", "skevgp")]
    numbers = np.array([[float(row[name]) for name in ("inside", "error_inside", "error_mean", "cr2")] for row in own])
    of_rows_outside = 1.0 - numbers[:, 0] * numbers[:, 1] / numbers[:, 2]
    said = filled("# A\n\n{{outside_share acrobot skevgp EVGP-IF}}", results).split("\n")[-1]
    assert said == f"{of_rows_outside.min():.0%} to {of_rows_outside.max():.0%}"
    said = filled("# A\n\n{{containing acrobot EVGP-IF skevgp}}", results).split(" / ")[1]
    assert said == f"{numbers[:, 3].mean():.3f}"
    cell = {"system": "iiwa14", "setting": "skevgp", "n_trajectories": "60", "size": "full"}
    own = [
        [float(row["cr1"]), float(row["cr2"])]
        for row in read(RESULTS / "learning_curves.csv")
        if cell.items() <= row.items() and row["model"].startswith("EVGP")
    ]
    (low1, low2), (high1, high2) = np.min(own, axis=0), np.max(own, axis=0)
    said = filled("# A\n\n{{containing_with iiwa14 skevgp 60 EVGP-IF EVGP-IFG}}", results).split("\n")[-1]
    assert said == f"{low1:.2f} to {high1:.2f} and {low2:.2f} to {high2:.2f}"
    assert len(own) == 8
    assert filled("# A\n\n{{containing_with iiwa14 skevgp 1 EVGP-IF}}", results).endswith(MISSING)
    assert filled("# A\n\n{{paper iiwa14 EVGP-IFG error cr2}}", results).endswith("\n0.027 / 0.480")


@pytest.mark.parametrize("name", ["results_table", "results_table_noise0.01"])
def test_the_page_of_the_results_is_what_its_script_writes(name):
    from paper import results_table_report

    rows = [row for row in read(RESULTS / f"{name}.csv") if row["size"] == "full"]
    assert (RESULTS / f"{name}.md").read_text() == text_of(results_table_report.paragraphs(rows))


@pytest.mark.parametrize("name", ["cartpole", "network", "data_sets", "learning_curves_report"])
def test_a_page_is_what_its_script_writes(name):
    module, stem = importlib.import_module(f"paper.{name}"), name.removesuffix("_report")
    rows = [row for row in read(RESULTS / f"{stem}.csv") if row["size"] == "full"]
    assert (RESULTS / f"{stem}.md").read_text() == text_of(module.paragraphs(rows))


def test_the_page_of_the_weights_is_what_its_script_writes():
    from paper import beta_report

    output = RESULTS / "beta.csv"
    rows = [row for row in read(output) if row["size"] == "full"]
    assert output.with_suffix(".md").read_text() == text_of(beta_report.paragraphs(rows, output))


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
    assert len(shown) == 4
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
    assert compared == 8


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
    lines = said(table, noisy=without(table, {"system": "iiwa14", "seed": "1"}))
    assert [line[:2] for line in lines[:-1]] == [
        ["Table 4 with noise: iiwa14, skevgp", "EVGP-IF 1, EVGP-IFG 1"],
        ["Table 4 with noise: iiwa14, skevgp-nominal", "EVGP-IF 1, EVGP-IFG 1"],
    ]
    assert said(without(table, cell, {"inside": "nan"}))[-1][1] == "4"
    more = [fit(**{name: cell[name] for name in ("system", "model", "setting")}, seed=seed) for seed in (0, 4, 5, 6, 7)]
    assert said(table + more)[-1][1] == "0"
    assert said(missing + more)[-1][1] == "1"
