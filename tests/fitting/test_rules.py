"""Numbers of the strategy: sizes of samples."""

from dataclasses import replace

import pytest

from skevgp.fitting.search import Rules

RULES = Rules(first_noise=1e-4)


@pytest.mark.parametrize(
    ("n_rows", "n_inducing", "width", "sizes"),
    [
        (1999, 10, 9, ()),
        (2000, 10, 9, (1000,)),
        (36_000, 256, 9, (5120,)),
        (36_000, 100, 9, (2000, 8000)),
        (10**7, 10, 9, (1000, 4000, 16_000, 64_000)),
        (10**7, 10, 100, (1000, 4000, 16_000)),
    ],
)
def test_samples_grow_until_they_are_half_of_the_rows_or_too_large_for_memory(n_rows, n_inducing, width, sizes):
    assert replace(RULES, sample=(1000, 20)).samples(n_rows, n_inducing, width) == sizes


def test_without_a_rule_there_are_no_samples():
    assert RULES.samples(10**6, 10, 9) == ()
