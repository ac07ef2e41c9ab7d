"""The ablation of a fit's rules on a handful of small sets: runs, resumes, and tells what changed from what did not."""

import pytest

from .conftest import read


@pytest.fixture
def ablation(benchmarks):
    import ablation

    return ablation


def test_it_runs_resumes_and_writes_its_page(ablation, tmp_path):
    output = tmp_path / "ablation.csv"
    arguments = ["--quick", "--rules", "patience", "stage", "--jobs", "1", "--output", str(output)]
    ablation.main(arguments)
    rows = read(output)
    # Of these sets, stages concern only those whose inducing points may be placed anew.
    rules = {case: {row["rule"] for row in rows if row["case"].startswith(case)} for case in ("nasty", "waves")}
    assert rules == {"nasty": {"default", "patience"}, "waves": {"default", "patience", "stage"}}
    assert all(row["outcome"] == "ok" and int(row["n_evaluations"]) >= int(row["n_iter"]) for row in rows)
    assert "| patience | 1 |" in output.with_suffix(".md").read_text()
    ablation.main(arguments)
    assert read(output) == rows


def test_each_change_makes_another_fit(ablation):
    from internals import ablated
    from skevgp.fitting import model, search
    from skevgp.solvers import LBFGS

    def key_of(solver, seed):
        return repr((search.RULES, solver.descent, model.ENOUGH, seed))

    default, keys, changes = key_of(LBFGS(), 0), [], ablation.changes()
    for change in changes:
        with ablated(change.rules, change.descent, change.enough) as solver:
            keys.append(key_of(solver, change.other_seed))
    assert default not in keys
    assert len(set(keys)) == len(keys) == len({(change.rule, change.variant) for change in changes})
    assert key_of(LBFGS(), 0) == default


def test_the_page_counts_what_is_better_and_what_is_worse(ablation):
    def row(rule, variant, seed, bound, error, evaluations, outcome="ok"):
        row = {"rule": rule, "variant": variant, "case": "a", "seed": seed, "outcome": outcome}
        return row | {"bound_per_row": bound, "error": error, "n_evaluations": evaluations}

    default = {("a", seed): row("default", "", seed, "1.0", "0.1", "100") for seed in "0123"}
    rows = [
        row("patience", "1", "0", "1.5", "0.05", "50"),
        row("patience", "1", "1", "1.001", "0.1", "50"),
        row("patience", "1", "2", "0.8", "0.2", "100"),
        row("patience", "1", "3", "", "", "1", "ValueError"),
    ]
    change = next(change for change in ablation.changes() if (change.rule, change.variant) == ("patience", "1"))
    line = ablation.line_of(change, rows, default)
    assert line[2:] == ["1 / 1 / 1, 1 failed", "+0.150", "-0.200, a (2)", "1 / 1", "1.00", "0.67"]
    assert ablation.line_of(change, [], default) == []
