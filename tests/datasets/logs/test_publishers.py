"""Positions of two publishers on one topic are an error."""

import numpy as np
import pytest

from .cases import PENDULUM, identified, pendulum


def mixed(first, second):
    """Messages of two nodes in the order of their times; of one time, those of the first node come first."""
    rows = np.vstack([first, second])
    return rows[np.argsort(rows[:, 0], kind="stable")]


def zeros(rows, late):
    return rows * [1.0, 0.0, 0.0, 0.0] + [late, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("every", [1, 2, 5, 15])
@pytest.mark.parametrize("derive", [False, True])
def test_zeros_of_a_second_publisher_raise(load, every, derive):
    table = pendulum()
    with pytest.raises(ValueError, match=r"log.csv: positions of joint 'q1' leap back and forth .* in row \d+ to"):
        load(mixed(table, zeros(table[::every], 0.005)), velocity="derive" if derive else "recorded")


@pytest.mark.parametrize("first", [False, True])
def test_rows_of_one_time_that_contradict_each_other_raise(load, first):
    table = pendulum()
    pair = (zeros(table, 0.0), table) if first else (table, zeros(table, 0.0))
    with pytest.raises(ValueError, match="leap back and forth .*, of the same time. Several nodes may publish"):
        load(mixed(*pair))


def test_keep_chooses_one_of_two_publishers_that_alternate(load):
    table = pendulum()
    log = load(mixed(table, zeros(table, 0.005)), keep=slice(None, None, 2))
    assert identified(log) == pytest.approx(PENDULUM, abs=0.02)


@pytest.mark.parametrize(
    "position",
    [
        np.pi + 0.001 * np.random.default_rng(0).standard_normal(2000),
        0.001 * np.random.default_rng(0).integers(0, 2, 2000),
        pendulum()[:, 1] + 0.05 * np.random.default_rng(0).standard_normal(2000),
    ],
    ids=["rest where the angle wraps", "rest between two counts", "noise"],
)
def test_noise_is_no_second_publisher(load, position):
    table = pendulum()
    table[:, 1] = (position + np.pi) % (2.0 * np.pi) - np.pi
    load(table[:, [0, 1, 1, 3]], velocity="derive", rest_velocity=0.0)
