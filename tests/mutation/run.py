"""Mutation testing: show each mutant of a list to the quick tests that execute it. Appends to a CSV; may be stopped.

python tests/mutation/run.py --list tests/mutation/mutants.csv --out FILE

`results.csv` has the outcomes of `mutants.csv`, and `faults.csv` is a list of faults that were chosen by hand.
"""

import argparse
import ast
import csv
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from itertools import chain
from pathlib import Path

from coverage import CoverageData

ROOT = Path(__file__).parents[2]
DATA = ROOT / ".mutation_cache/coverage"
COVERAGE = ["--cov=skevgp", "--cov-context=test", "--cov-report=", "--cov-fail-under=0", "-n", "2"]
FIELDS = ["id", "outcome", "test", "file", "function", "original", "mutated", "occurrence"]


def pytest(root: Path, *options: str, tests: list[str] | None = None) -> str:
    """Run tests of a copy of the repository, or all quick ones; the test that failed, or ''."""
    chosen, paths = DATA.with_name("chosen.txt"), {"PYTHONPATH": str(root), "COVERAGE_FILE": str(DATA)}
    chosen.write_text("\n".join(tests or []))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=0", *options]
    with DATA.with_name("printed.txt").open("w+") as printed:
        try:
            done = subprocess.run([*command, f"@{chosen}"], cwd=root, env=os.environ | paths, stdout=printed,
                                  stderr=printed, timeout=600)  # fmt: skip
        except subprocess.TimeoutExpired:
            return "timeout"
        printed.seek(0)
        text = printed.read()
    failed = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", text, re.MULTILINE)
    return "" if done.returncode == 0 else next(iter(failed), text.strip()[-100:])


def places(tree: ast.AST, function: str, text: str, scope: str = "") -> list[tuple[int, int, int, int]]:
    """Where a statement or an expression stands in a function: first and last line and column."""
    found = []
    for node in ast.iter_child_nodes(tree):
        named = isinstance(node, (ast.FunctionDef, ast.ClassDef))
        name = f"{scope}.{node.name}".lstrip(".") if named else scope
        if isinstance(node, (ast.expr, ast.stmt)) and name == function and ast.unparse(node) == text:
            found.append((node.lineno, node.col_offset, node.end_lineno or 0, node.end_col_offset or 0))
        found += places(node, function, text, name)
    return list(dict.fromkeys(found))


def judge(row: dict[str, str], root: Path, covered: CoverageData, breadth: Counter[str]) -> tuple[str, str]:
    """Outcome of one mutant, and the test that failed."""
    path = root / row["file"]
    source = path.read_bytes()
    where = places(ast.parse(source), row["function"], row["original"])[int(row["occurrence"]) :]
    if not where:
        return "gone", ""
    lines, (first, start, last, end) = source.splitlines(keepends=True), where[0]
    head, tail = b"".join(lines[: first - 1]) + lines[first - 1][:start], lines[last - 1][end:] + b"".join(lines[last:])
    contexts = covered.contexts_by_lineno(str(path))
    tests = {test for line in range(first, last + 1) for test in contexts.get(line, []) if test}
    if not tests:  # it runs at import: all tests of the file
        tests = {test for line in contexts.values() for test in line if test}
    chosen = sorted({test.partition("|")[0] for test in tests}, key=lambda test: breadth[test])
    try:
        path.write_bytes(head + row["mutated"].encode() + tail)
        failed = pytest(root, "-x", "-n", "2", tests=chosen) if chosen else ""
    finally:
        path.write_bytes(source)
    return ("killed" if failed else "survived" if chosen else "no test"), failed


def main() -> None:
    """Read the command line, run, and print the numbers of outcomes and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--list", type=Path, default=ROOT / "tests/mutation/mutants.csv")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    root = DATA.with_name("copy")
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(ROOT, root, ignore=shutil.ignore_patterns(".git", ".venv", "*cache*"))
    if not DATA.exists():  # remove it when the tests change
        print("Which test executes which line? One run of the quick tests:", pytest(root, *COVERAGE) or "all passed")
    covered = CoverageData(str(DATA))
    covered.read()
    breadth = Counter(x for file in covered.measured_files() for x in chain(*covered.contexts_by_lineno(file).values()))
    done = {row["id"] for row in csv.DictReader(args.out.open())} if args.out.exists() else set[str]()
    with args.out.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS, extrasaction="ignore", lineterminator="\n")
        if not done:
            writer.writeheader()
        for row in csv.DictReader(args.list.open()):
            if row["id"] not in done:
                outcome, test = judge(row, root, covered, breadth)
                writer.writerow(row | {"outcome": outcome, "test": test})
                file.flush()
    rows = list(csv.DictReader(args.out.open()))
    print(Counter(row["outcome"] for row in rows), *(row for row in rows if row["outcome"] == "survived"), sep="\n")
    killers = sorted({row["test"] for row in rows if "::" in row["test"]})
    print("Fails without a mutant too:", pytest(root, tests=killers) or "none")


if __name__ == "__main__":
    main()
