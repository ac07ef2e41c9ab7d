"""Measure how many functions and files a reader of the package meets.

    python benchmarks/house.py            # print the meters and write them to benchmarks/results/house.csv
    python benchmarks/house.py --list     # also print each function that a fit enters, in order
    python benchmarks/house.py --before DIR   # next to the meters of another checkout of the project

The script traces a fit of 400 rows by `EVGPRegressor`. It counts the functions of the package that the fit enters,
their files, and the pairs of files that call each other both ways. It counts returns: the first call of a function in a
file that the fit had left. In the source it counts private names that cross between the classes of one estimator, and
lines of code and of docstrings, named constants, and files that import one another in a circle, per folder. A
comprehension does not count as a function.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import os
import subprocess
import sys
import threading
import tokenize
import warnings
from io import StringIO
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import pandas as pd

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
    for kind in (kind for kind in EVGPRegressor.__mro__ if kind.__module__.startswith("skevgp")):
        nodes = list(ast.walk(ast.parse(inspect.getsource(kind))))
        own = [node for node in nodes if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "self"]
        own = [node for node in own if node.attr.startswith("_") and not node.attr.startswith("__")]
        used[kind.__name__] = {node.attr for node in own}
        defined[kind.__name__] = {node.attr for node in own if isinstance(node.ctx, ast.Store)}
        defined[kind.__name__] |= {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
    everywhere = set().union(*defined.values())
    return {name for kind, names in used.items() for name in (names - defined[kind]) & everywhere}


def lines_of_folders() -> pd.DataFrame:
    """Lines of code and of docstrings, and files, of each folder."""
    counts = []
    for path in sorted(PACKAGE.rglob("*.py")):
        of_docstrings: set[int] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
                of_docstrings.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
        of_code: set[int] = set()
        with path.open("rb") as file:
            for token in tokenize.tokenize(file.readline):
                if token.type not in (tokenize.COMMENT, tokenize.ENCODING) and token.string.strip():
                    of_code.update(range(token.start[0], token.end[0] + 1))
        folder = path.relative_to(PACKAGE).parts[0] if path.parent != PACKAGE else "(root)"
        counts.append((folder, len(of_code - of_docstrings), len(of_docstrings), 1))
    kinds = ["lines of code", "lines of docstring", "files"]
    return pd.DataFrame(counts, columns=["folder", *kinds]).groupby("folder").sum()


def named_constants(folder: str) -> int:
    """Names in capitals that are assigned a number, or several, at the top of a file of a folder."""
    count = 0
    for path in (PACKAGE / folder).glob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, ast.Assign) or not any(isinstance(n, ast.Constant) for n in ast.walk(node.value)):
                continue
            constants = [n.value for n in ast.walk(node.value) if isinstance(n, ast.Constant)]
            if any(isinstance(value, str) for value in constants):
                continue
            names = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            count += sum(name.isupper() for name in names)
    return count


def files_in_a_circle(folder: str) -> int:
    """Files of a folder that import one another in a circle, also if an import is for type hints only."""
    paths = list((PACKAGE / folder).glob("*.py"))
    imports = {}
    for path in paths:
        nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        imports[path.stem] = {node.module.split(".")[0] for node in nodes if node.level == 1 and node.module}
    reached = {name: set(others) for name, others in imports.items()}
    for _ in paths:
        reached = {
            name: others.union(*(reached.get(other, set()) for other in others)) for name, others in reached.items()
        }
    return sum(name in others for name, others in reached.items())


def meters_of(checkout: str) -> pd.Series:
    """The meters of another checkout."""
    command = [sys.executable, __file__, "--print"]
    output = subprocess.run(command, env=os.environ | {"PYTHONPATH": checkout}, check=True, capture_output=True)
    return pd.read_csv(StringIO(output.stdout.decode()), index_col="meter")["value"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--before", metavar="DIR", help="another checkout")
    parser.add_argument("--print", action="store_true", help="print a CSV and write no file")
    options = parser.parse_args()
    functions, calls = functions_of_a_fit()
    files = [code.co_filename for code in functions]
    changes = [file for last, file in zip(["", *files], files, strict=False) if file != last]
    if options.list:
        for code in functions:
            print(Path(code.co_filename).relative_to(PACKAGE), code.co_qualname)
    meters = {
        "functions entered by a fit": len(functions),
        "files entered by a fit": len(set(files)),
        "pairs of files that call both ways": len({frozenset(call) for call in calls if call[::-1] in calls}),
        "returns to a file that was left": len(changes) - len(set(files)),
        "private names crossing between classes of an estimator": len(crossing_names()),
    }
    for folder in ("fitting", "model"):
        meters[f"files of {folder} in a circle of imports"] = files_in_a_circle(folder)
        meters[f"named constants of {folder}"] = named_constants(folder)
    lines = lines_of_folders()
    lines.loc["all"] = lines.sum()
    for folder, numbers in lines.iterrows():
        meters |= {f"{kind} of {folder}": number for kind, number in numbers.items()}
    table = pd.DataFrame(meters.items(), columns=["meter", "value"])
    if options.print:
        print(table.to_csv(index=False))
        return
    if options.before:
        table.insert(1, "before", table["meter"].map(meters_of(options.before)))
    table.to_csv(RESULTS, index=False)
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
