"""Measure how far a reader has to walk through the package: the meters of its layout.

    python benchmarks/house.py            # print the meters and write them to benchmarks/results/house.csv
    python benchmarks/house.py --list     # also print each function that a fit enters, in order

The script traces a fit of 400 rows by `EVGPRegressor`. It counts the functions of the package that the fit enters,
their files, and the pairs of files that call each other both ways. It counts returns: the first call of a function in a
file that the fit had left. In the source it counts private names that cross between the classes of one estimator, and
lines of code and of docstrings per folder. A comprehension does not count as a function.
"""

from __future__ import annotations

import argparse
import ast
import csv
import inspect
import sys
import threading
import tokenize
import warnings
from collections import Counter
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

import skevgp
from skevgp import EVGPRegressor

PACKAGE = Path(skevgp.__file__).parent
RESULTS = Path(__file__).parent / "results" / "house.csv"


def functions_of_a_fit() -> tuple[list[CodeType], set[tuple[str, str]]]:
    """The functions that a fit enters, in order of their first call, and the pairs (caller's file, file)."""
    X = np.random.RandomState(0).uniform(-3.0, 3.0, (400, 2))
    y = np.sin(X[:, 0]) * X[:, 1] + 0.1 * np.random.RandomState(1).randn(400)
    entered: dict[CodeType, None] = {}
    calls: set[tuple[str, str]] = set()
    root = str(PACKAGE)

    def trace(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(root) or code.co_name.startswith("<"):
            return
        entered.setdefault(code)
        caller = frame.f_back
        while caller is not None and not caller.f_code.co_filename.startswith(root):
            caller = caller.f_back
        if caller is not None and caller.f_code.co_filename != code.co_filename:
            calls.add((caller.f_code.co_filename, code.co_filename))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Some modules are imported late.
        EVGPRegressor(n_inducing=10, max_iter=3).fit(X[:60], y[:60])
        sys.setprofile(trace)
        threading.setprofile(trace)
        try:
            EVGPRegressor(random_state=0).fit(X, y)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return list(entered), calls


def crossing_names() -> set[str]:
    """Private attributes of self that one class of `EVGPRegressor` uses and another one defines."""
    defined: dict[str, set[str]] = {}
    used: dict[str, set[str]] = {}
    for kind in EVGPRegressor.__mro__:
        if not kind.__module__.startswith("skevgp"):
            continue
        tree = ast.parse(inspect.getsource(kind)).body[0]
        own = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and _is_private_of_self(node)]
        used[kind.__name__] = {node.attr for node in own}
        defined[kind.__name__] = {node.attr for node in own if isinstance(node.ctx, ast.Store)}
        defined[kind.__name__] |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return {
        name
        for kind, names in used.items()
        for name in names - defined[kind]
        if any(name in others for other, others in defined.items() if other != kind)
    }


def _is_private_of_self(node: ast.Attribute) -> bool:
    is_self = isinstance(node.value, ast.Name) and node.value.id == "self"
    return is_self and node.attr.startswith("_") and not node.attr.startswith("__")


def lines_of_folders() -> dict[str, tuple[int, int, int]]:
    """Lines of code and of docstrings, and files, of each folder."""
    counts: Counter[tuple[str, str]] = Counter()
    for path in sorted(PACKAGE.rglob("*.py")):
        folder = path.relative_to(PACKAGE).parts[0] if path.parent != PACKAGE else "(root)"
        of_docstrings: set[int] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
                of_docstrings.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
        of_code: set[int] = set()
        with path.open("rb") as file:
            for token in tokenize.tokenize(file.readline):
                if token.type not in (tokenize.COMMENT, tokenize.ENCODING) and token.string.strip():
                    of_code.update(range(token.start[0], token.end[0] + 1))
        counts[folder, "code"] += len(of_code - of_docstrings)
        counts[folder, "docstring"] += len(of_docstrings)
        counts[folder, "files"] += 1
    folders = sorted({folder for folder, _ in counts})
    return {name: (counts[name, "code"], counts[name, "docstring"], counts[name, "files"]) for name in folders}


def main() -> None:
    """Measure and write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true")
    arguments = parser.parse_args()
    functions, calls = functions_of_a_fit()
    seen: set[str] = set()
    returns, last = 0, ""
    for code in functions:
        returns += code.co_filename != last and code.co_filename in seen
        seen.add(code.co_filename)
        last = code.co_filename
        if arguments.list:
            print(Path(code.co_filename).relative_to(PACKAGE), code.co_qualname)
    pairs = {frozenset(call) for call in calls if (call[1], call[0]) in calls}
    rows = [
        ("functions entered by a fit", len(functions)),
        ("files entered by a fit", len(seen)),
        ("pairs of files that call both ways", len(pairs)),
        ("returns to a file that was left", returns),
        ("private names crossing between classes of an estimator", len(crossing_names())),
    ]
    folders, kinds = lines_of_folders(), ("lines of code", "lines of docstring", "files")
    totals = tuple(sum(each) for each in zip(*folders.values(), strict=True))
    for name, numbers in {**folders, "all": totals}.items():
        rows += [(f"{kind} of {name}", n) for kind, n in zip(kinds, numbers, strict=True)]
    RESULTS.parent.mkdir(exist_ok=True)
    with RESULTS.open("w", newline="") as file:
        csv.writer(file).writerows([("meter", "value"), *rows])
    for name, value in rows:
        print(f"{value:7,d}  {name}")


if __name__ == "__main__":
    main()
