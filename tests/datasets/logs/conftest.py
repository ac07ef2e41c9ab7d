import pytest

from skevgp.datasets import load_log

from .cases import text_of

COLUMNS = {"time": 0, "position": 1, "velocity": 2, "effort": 3}


@pytest.fixture
def load(tmp_path):
    """Load a table of times, positions, velocities and efforts of a joint."""

    def load(rows, **arguments):
        (tmp_path / "log.csv").write_text(text_of(rows))
        return load_log(tmp_path / "log.csv", **{"columns": COLUMNS, **arguments})

    return load
