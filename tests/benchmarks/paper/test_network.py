"""How long the network learns."""

import pytest

from ..conftest import read


@pytest.mark.slow
def test_it_runs_in_short_mode(run_script, tmp_path):
    said = run_script("paper/network.py", "--quick", "--jobs", 1, "--output", tmp_path / "network.csv")
    assert "[7/7] pendulum" in said
    rows = read(tmp_path / "network.csv")
    assert {row["variant"] for row in rows} == {
        *("", "prior of 1", "first step 0.003", "batches of 50", "twice as wide", "early stopping")
    }
    assert all(0 < float(row["error_learned"]) < 1 for row in rows)
    assert "| twice as wide | 10 |" in (tmp_path / "network.md").read_text()


def test_epochs_are_enough_when_more_gain_next_to_nothing():
    from paper.network import enough

    assert enough({("", 100): 0.2, ("", 300): 0.1, ("", 1000): 0.099, ("prior of 1", 1000): 0.01}) == 300
    assert enough({("", 100): 0.2, ("", 300): 0.19, ("", 1000): 0.1}) == 1000
    assert enough({("", 100): 0.1, ("", 300): 0.12, ("", 1000): 0.096}) == 100


def test_what_is_held_back_are_whole_trajectories():
    from paper.network import data

    learned, held_back = data("pendulum", 0, "quick")
    assert (len(learned.data), len(held_back.data)) == (900, 300)
    assert not {tuple(row) for row in learned.data} & {tuple(row) for row in held_back.data}
