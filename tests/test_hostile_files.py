"""A few of the files that `tests/long/hostile_files.py` reads by the thousand."""

import pytest

from .hostile import OF_RECORDINGS, OF_TABLES, OF_XML
from .long.hostile_files import run


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "damages"),
    [("tables", OF_TABLES), ("recordings", OF_RECORDINGS), ("urdfs", OF_XML)],
    ids=lambda each: each,
)
def test_hostile_files_are_refused_or_harmless(kind, damages):
    counts, defects, _, _ = run(kind, 60, seed=3)
    assert not defects
    assert sum(counts.values()) == 60
    assert sum(count for (_, found), count in counts.items() if found == "refused") > 20
    assert len({damage for damage, _ in counts}) == len(set(damages))
