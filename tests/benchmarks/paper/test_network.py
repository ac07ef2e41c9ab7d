"""How long the network learns."""

import pytest

from ..conftest import read


@pytest.mark.slow
def test_it_runs_in_short_mode(run_script, tmp_path):
    said = run_script("paper/network.py", "--quick", "--jobs", 1, "--output", tmp_path / "network.csv")
    assert "[7/7] pendulum" in said
    assert "Error on the test set" in said
    rows = read(tmp_path / "network.csv")
    assert {row["variant"] for row in rows} == {
        *("", "prior of 1", "first step 0.003", "batches of 50", "twice as wide", "early stopping")
    }
    assert all(0 < float(row["error_learned"]) < 1 for row in rows)
    page = (tmp_path / "network.md").read_text()
    assert "| twice as wide | 10 |" in page
    assert "in the paper 0.017" in page


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


def test_what_is_tested_was_chosen_by_what_was_held_back():
    from paper.network import HELD, TEST, compared, paragraphs

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
