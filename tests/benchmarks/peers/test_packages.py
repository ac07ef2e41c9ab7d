"""What is counted of a package."""

import pytest

from ..conftest import BENCHMARKS, read


def test_lines_of_code_hold_code():
    from peers.packages import lines_of_code

    assert lines_of_code('"""Of a module."""\n\n# A comment.\nx = (\n    1\n)\n') == 3
    assert lines_of_code('def f():\n    """Of a\n    function."""\n    return "text"  # and a comment\n') == 2
    assert lines_of_code("") == 0


def test_code_and_sizes_are_those_of_a_folder_without_tests(tmp_path):
    from peers.packages import code_in, megabytes

    (tmp_path / "tests").mkdir()
    for name in ("a.py", "tests/test_a.py"):
        (tmp_path / name).write_text("x = 1\n")
    (tmp_path / "data.bin").write_bytes(bytes(1_000_000))
    assert code_in(tmp_path) == 1
    assert megabytes(tmp_path) == pytest.approx(1.0, rel=1e-3)


def test_all_packages_have_been_measured():
    from peers.packages import PACKAGES

    rows = read(BENCHMARKS / "peers" / "packages.csv")
    assert [row["package"] for row in rows] == list(PACKAGES)
    assert all(float(row["megabytes"]) > 1.0 and int(row["lines_of_code"]) > 1000 for row in rows)
