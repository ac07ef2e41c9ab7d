"""How long the network learns."""

import numpy as np
import pytest

from skevgp.datasets import make_dynamics

from ..conftest import BENCHMARKS, read

HELD, TEST, EARLY = "trajectories held back", "test set", "early stopping"


@pytest.mark.long
def test_it_runs_in_short_mode(run_script, tmp_path):
    said = run_script("paper/network.py", "--quick", "--jobs", 1, "--output", tmp_path / "network.csv")
    assert "[7/7] pendulum" in said
    assert "Error on the test set" in said
    rows = read(tmp_path / "network.csv")
    assert {row["variant"] for row in rows} == {
        *("", "prior of 1", "first step 0.003", "batches of 50", "twice as wide", EARLY)
    }
    assert all(0 < float(row["error_learned"]) < 1 for row in rows)
    # Early stopping has its own, larger limit, and waits for 30 epochs; all others learn for as long as they are told.
    for row in rows:
        if row["variant"] == EARLY:
            assert 30 < int(row["n_iter"]) <= 1000
        else:
            assert row["n_iter"] == row["epochs"]
    held, tested = ([row for row in rows if row["tested_on"] == which] for which in (HELD, TEST))
    assert len(held) == 7
    # What is fitted to all trajectories: the lowest Error on those held back, and early stopping.
    best = min((row for row in held if row["variant"] != "twice as wide"), key=lambda row: float(row["error_tested"]))
    chosen = {(row["variant"], row["epochs"]) for row in held if row is best or row["variant"] == EARLY}
    assert {(row["variant"], row["epochs"]) for row in tested} == chosen
    page = (tmp_path / "network.md").read_text()
    assert "| twice as wide | 10 |" in page
    assert "in the paper 0.017" in page
    first = page.split("| of each data set |\n")[1].splitlines()[1]
    assert first.startswith(f"| {best['variant'] or 'standard'} | ")


def test_in_the_results_fixed_epochs_and_early_stopping_are_told_apart():
    rows = read(BENCHMARKS / "results" / "network.csv")
    early = [row for row in rows if row["variant"] == EARLY]
    assert all(row["n_iter"] == row["epochs"] for row in rows if row["variant"] != EARLY)
    assert {row["tested_on"] for row in early} == {HELD, TEST}
    assert all(30 < int(row["n_iter"]) <= 1000 for row in early)
    assert len({row["n_iter"] for row in early}) > 4
    # What is tested for a system is one choice beside early stopping, by what was held back: of all seeds, not of each.
    for system in {row["system"] for row in rows}:
        errors, tested = {}, set()
        for row in (row for row in rows if row["system"] == system):
            key = row["variant"], row["epochs"]
            if row["tested_on"] == TEST:
                tested.add(key)
            elif row["variant"] != "twice as wide":  # than the paper's
                errors.setdefault(key, []).append(float(row["error_tested"]))
        means = {key: np.mean(values) for key, values in errors.items()}
        assert tested == {min(means, key=means.get), (EARLY, "1000")}


def test_epochs_are_enough_when_more_gain_next_to_nothing():
    from paper.network import enough

    assert enough({("", 100): 0.2, ("", 300): 0.1, ("", 1000): 0.099, ("prior of 1", 1000): 0.01}) == 300
    assert enough({("", 100): 0.2, ("", 300): 0.19, ("", 1000): 0.1}) is None
    assert enough({("", 100): 0.1, ("", 300): 0.12, ("", 1000): 0.096}) == 100


def test_what_is_held_back_are_whole_trajectories():
    from paper.network import data

    learned, held_back = data("pendulum", 0, "quick")
    assert (len(learned.data), len(held_back.data)) == (900, 300)
    assert not {tuple(row) for row in learned.data} & {tuple(row) for row in held_back.data}
    # Each trajectory is in one of them from its first row to its last, with its targets; three of twelve are held back.
    whole = make_dynamics("pendulum", 12, random_state=0)
    place = {tuple(row): number for number, row in enumerate(whole.data)}
    assert len(place) == len(whole.data) == 1200
    groups = []
    for part in (learned, held_back):
        rows = [place[tuple(row)] for row in part.data]
        np.testing.assert_array_equal(part.target, whole.target[rows])
        groups.append(set(whole.groups[rows]))
        assert set(rows) == set(np.flatnonzero(np.isin(whole.groups, list(groups[-1]))))
    assert [len(own) for own in groups] == [9, 3]
    # Of another data set others are.
    other = make_dynamics("pendulum", 12, random_state=1)
    _, others = data("pendulum", 1, "quick")
    place = {tuple(row): number for number, row in enumerate(other.data)}
    assert set(other.groups[[place[tuple(row)] for row in others.data]]) != groups[1]


def test_a_test_set_is_that_of_the_results_and_all_trajectories_are_learned_from():
    from paper import results_table
    from paper.network import data

    parts = data("pendulum", 1, "quick", TEST)
    for part, seed in zip(parts, (1, 1001), strict=True):
        expected = make_dynamics("pendulum", 12, random_state=seed)
        np.testing.assert_array_equal(part.data, expected.data)
        np.testing.assert_array_equal(part.target, expected.target)
    for part, same in zip(parts, results_table.data("pendulum", 1, 0.0, "quick"), strict=True):
        np.testing.assert_array_equal(part.data, same.data)


class Recorder:
    """In a network's place: knows what it was given, and is wrong by 3 where it learned, else by 5."""

    n_iter_, loss_curve_ = 7, np.array([2.0, -1.5])

    def fit(self, X, y):
        self.X, self.y, self.regressor_ = X, y, self
        return self

    def predict(self, X, return_std=False):
        learned = np.array_equal(X, self.X)
        mean = self.truth[learned] + ([3.0, 0.0] if learned else [3.0, 4.0])
        return (mean, np.ones_like(mean)) if return_std else mean


@pytest.mark.parametrize("tested_on", [HELD, TEST])
def test_nothing_is_learned_from_what_it_is_tested_on(monkeypatch, tested_on):
    from paper import network

    learned, others = network.data("pendulum", 0, "quick", tested_on)
    recorder = Recorder()
    recorder.truth = {True: learned.target, False: others.target}
    monkeypatch.setattr(network, "regressor_of", lambda cell: recorder)
    row = network.run(network.Cell("pendulum", "", 7, 0, tested_on, "quick"))
    np.testing.assert_array_equal(recorder.X, learned.data)
    np.testing.assert_array_equal(recorder.y, learned.target)
    assert not {tuple(one) for one in recorder.X} & {tuple(one) for one in others.data}
    assert row["error_learned"] == pytest.approx(3.0)
    assert row["error_tested"] == pytest.approx(5.0)
    assert row["nlpd_tested"] == pytest.approx(np.log(2.0 * np.pi) + 12.5)  # of two normal distributions
    assert (row["loss"], row["n_iter"], row["converged"], row["tested_on"]) == (-1.5, 7, True, tested_on)


def test_a_variant_differs_from_the_standard_by_what_its_name_says():
    from paper.network import VARIANTS, Cell, regressor_of

    def parameters(variant, system="cartpole"):
        return regressor_of(Cell(system, variant, 300, 0, TEST, "full")).regressor.get_params()

    standard = parameters("")
    assert (standard["early_stopping"], standard["max_iter"]) == (False, 300)
    assert standard["hidden_layer_sizes"] == (50, 50)
    assert {
        variant: {name: value for name, value in parameters(variant).items() if value != standard[name]}
        for variant in VARIANTS
    } == {
        "": {},
        "prior of 1": {"prior_scale": 1.0},
        "first step 0.003": {"learning_rate_init": 0.003},
        "batches of 50": {"batch_size": 50},
        "twice as wide": {"hidden_layer_sizes": (100, 100)},
        "early stopping": {"early_stopping": True, "max_iter": 1000},
    }
    assert parameters("early stopping")["n_iter_no_change"] == 30


def test_what_is_tested_was_chosen_by_what_was_held_back():
    from paper.network import compared, paragraphs

    def row(variant, epochs, tested_on, error, seed=0):
        names = {"system": "cartpole", "variant": variant, "epochs": str(epochs), "seed": str(seed)}
        numbers = {"error_tested": str(error), "error_learned": "0.01", "nlpd_tested": "-1", "loss": "-2"}
        made = {
            "n_iter": str(epochs),
            "fit_seconds": "3",
            "converged": "True",
            "date": "",
            "versions": "",
            "machine": "",
        }
        return {**names, "tested_on": tested_on, "size": "full", **numbers, **made}

    rows = [row("", 100, HELD, 0.3), row("", 300, HELD, 0.1), row("", 300, HELD, 0.4, 1), row("", 100, HELD, 0.1, 1)]
    rows += [row("twice as wide", 300, HELD, 0.05)]
    assert compared(rows) == []
    rows += [row("early stopping", 300, HELD, 0.25)]
    assert compared(rows) == [("", 100), ("early stopping", 300)]
    assert "the test sets" not in "\n".join(paragraphs(rows))
    rows += [row("", 100, TEST, 0.02), row("", 100, TEST, 0.06, 1), row("early stopping", 300, TEST, 0.001)]
    assert compared(rows)[0] == ("", 100)
    page = "\n".join(paragraphs(rows))
    assert "| standard | 100 | 0.0400 | 0.0400 | 0.0200, 0.0600 |" in page
    assert "| standard | 100 | 0.200 |" in page
