"""Mutation testing: which small changes to the package do the quick tests notice? CONTRIBUTING.md has the commands.

A mutant is one changed node of a syntax tree. The file, the function, the kind and the statement before and after
identify it, so that the list stays valid when lines move. (mutmut 3.8 changes no properties and no constants.)
"""

import argparse
import ast
import contextlib
import copy
import csv
import itertools
import json
import os
import queue
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
IDENTITY = ["file", "function", "kind", "original", "mutated", "occurrence"]
RESULT = ["id", "outcome", "test", "seconds", *IDENTITY, "line"]
NOT_COUNTED = "tests/test_mutants.py"  # it reads the source of the package: any change fails it
SWAPS = {
    "Lt": "LtE GtE", "LtE": "Lt Gt", "Gt": "GtE LtE", "GtE": "Gt Lt", "Eq": "NotEq", "NotEq": "Eq", "Is": "IsNot",
    "IsNot": "Is", "In": "NotIn", "NotIn": "In", "And": "Or", "Or": "And", "Add": "Sub", "Sub": "Add", "Mult": "Div",
    "Div": "Mult", "FloorDiv": "Div", "Mod": "Mult", "Pow": "Mult", "MatMult": "Mult", "BitAnd": "BitOr",
    "BitOr": "BitAnd",
}  # fmt: skip


def variants(node: Any) -> Iterator[tuple[str, ast.AST]]:
    """Kind and replacement of each mutant of one node."""

    def changed(**fields: object) -> ast.AST:
        new: ast.AST = copy.copy(node)
        vars(new).update(fields)
        return new

    def swaps(op: ast.AST) -> list[ast.AST]:
        return [getattr(ast, name)() for name in SWAPS.get(type(op).__name__, "").split()]

    match node:
        case ast.Compare(ops=ops):
            for i, op in enumerate(ops):
                yield from (("comparison", changed(ops=[*ops[:i], new, *ops[i + 1 :]])) for new in swaps(op))
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op):
            yield from (("boolean" if isinstance(node, ast.BoolOp) else "arithmetic", changed(op=x)) for x in swaps(op))
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield "not" if isinstance(node.op, ast.Not) else "arithmetic", node.operand
        case ast.Constant(value=bool(value)):
            yield "boolean", ast.Constant(not value)
        case ast.Constant(value=int(value) | float(value)):
            yield "number", ast.Constant(value * 2 if value and isinstance(value, float) else value + 1)
        case ast.Return(value=ast.expr()) if ast.unparse(node) != "return None":
            yield "return", ast.Return(ast.Constant(None))
        case ast.Slice():
            yield from (("slice", changed(**{x: None})) for x in ("lower", "upper", "step") if getattr(node, x))
    if isinstance(node, ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield "statement", ast.Pass()


def mutants(slot: Any, function: str = "", anchor: Any = None, default: bool = False) -> Iterator[dict[str, Any]]:
    """Mutants of the node in a slot (a container and a key) and of what is in it; as changes of the anchor.

    The anchor is the slot of the whole statement, or of the expression in a compound statement.
    """
    node = slot[0][slot[1]]
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.Assign(targets=[ast.Name("__all__")]):
            return
        case ast.BinOp(op=ast.BitOr()) if not function:  # a type
            return
        case ast.FunctionDef() | ast.ClassDef():
            function = f"{function}.{node.name}".lstrip(".")
    compound = isinstance(node, ast.stmt) and (hasattr(node, "body") or isinstance(node, ast.Match))
    if isinstance(node, (ast.expr, ast.stmt)) and not compound:
        anchor = anchor or slot
        whole = anchor[0][anchor[1]]
        before, place = ast.unparse(whole), (whole.lineno, whole.col_offset, whole.end_lineno, whole.end_col_offset)
        for kind, new in variants(node):
            slot[0][slot[1]] = new
            after = ast.unparse(anchor[0][anchor[1]])
            slot[0][slot[1]] = node
            yield {"function": function, "kind": "default" if default else kind, "original": before, "mutated": after,
                   "line": node.lineno, "col": node.col_offset, "place": place}  # fmt: skip
    for name, value in ast.iter_fields(node):
        typing = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING" and name == "body"
        if name not in ("annotation", "returns", "decorator_list") and not typing:
            slots: Any = [(value, i) for i in range(len(value))] if isinstance(value, list) else [(vars(node), name)]
            for child in [(container, key) for container, key in slots if isinstance(container[key], ast.AST)]:
                yield from mutants(child, function, anchor, default or isinstance(node, ast.arguments))


def all_mutants() -> dict[tuple[str, ...], dict[str, Any]]:
    """All mutants of the package, by identity."""
    found, seen = {}, Counter[tuple[str, ...]]()
    for path in sorted((ROOT / "skevgp").rglob("*.py")):
        for row in mutants(([ast.parse(path.read_text(encoding="utf-8"))], 0)):
            same = (path.relative_to(ROOT).as_posix(), *(str(row[name]) for name in IDENTITY[1:-1]))
            found[*same, str(seen[same])] = row | {"file": same[0], "occurrence": seen[same]}
            seen[same] += 1
    return found


def functions(tree: ast.AST, scope: str = "") -> Iterator[tuple[str, int, int]]:
    """Name, first and last line of the body of each function; inner functions come later."""
    for node in ast.iter_child_nodes(tree):
        name = f"{scope}.{node.name}".lstrip(".") if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else scope
        if isinstance(node, ast.FunctionDef):
            yield name, node.body[0].lineno, node.end_lineno or 0
        yield from functions(node, name)


def copied(folder: str) -> Path:
    """A copy of the repository to change."""
    left_out = shutil.ignore_patterns(".git", ".venv", "*cache*", ".hypothesis", ".coverage*", "_build", "output")
    return Path(shutil.copytree(ROOT, Path(tempfile.mkdtemp(dir=folder)) / "copy", ignore=left_out))


def pytest(root: Path, *options: str, tests: Sequence[str] = (), limit: float | None = None) -> tuple[int | None, str]:
    """Exit status of the quick tests (None if out of time), and what they print."""
    within = {name: root.parent / name for name in ("tests", "printed", "tmp", "coverage")}
    within["tests"].write_text("\n".join(tests))
    within["tmp"].mkdir(exist_ok=True)
    paths = {"PYTHONPATH": str(root), "TMPDIR": str(within["tmp"]), "COVERAGE_FILE": str(within["coverage"])}
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not long", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
    with within["printed"].open("w") as printed:
        process = subprocess.Popen([*command, *options, f"@{within['tests']}"], cwd=root, env=os.environ | paths,
                                   start_new_session=True, stdout=printed, stderr=printed)  # fmt: skip
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(limit)
        status = process.poll()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # and what the tests started
        process.wait()
    for left in (root / ".hypothesis", within["tmp"]):
        shutil.rmtree(left, ignore_errors=True)
    return status, within["printed"].read_text(errors="replace")


def failed(printed: str) -> list[str]:
    """The tests that failed."""
    return re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", printed, re.MULTILINE)


def map_tests(args: argparse.Namespace) -> None:
    """Run the quick tests once; store which of them execute which function, how long they take, and which fail."""
    from coverage import CoverageData

    touched, seconds = defaultdict[str, set[str]](set), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        root = copied(folder)
        options = ["--cov=skevgp", "--cov-context=test", "--cov-report=", "--cov-fail-under=0", "--durations=0"]
        _, printed = pytest(root, *options)
        bad = failed(printed) and failed(pytest(root, tests=failed(printed))[1])  # coverage is too slow for some
        data = CoverageData(str(root.parent / "coverage"))
        data.read()
        for file in data.measured_files():
            bodies = functions(ast.parse(Path(file).read_text(encoding="utf-8")))
            owner = {line: name for name, first, last in bodies for line in range(first, last + 1)}
            for line, contexts in data.contexts_by_lineno(file).items():
                name = f"{Path(file).relative_to(root).as_posix()}:{owner.get(line, '')}"
                touched[name].update(context.rpartition("|")[0] for context in contexts if context)
    for took, test in re.findall(r"^([\d.]+)s (?:call|setup|teardown) +(.+)$", printed, re.MULTILINE):
        seconds[test] += float(took)  # type: ignore[assignment]
    number = {test: i for i, test in enumerate(sorted(set().union(*touched.values())))}
    numbers = {name: sorted(number[test] for test in which) for name, which in touched.items()}
    args.map.parent.mkdir(parents=True, exist_ok=True)
    args.map.write_text(json.dumps({"tests": [*number], "functions": numbers, "seconds": seconds, "bad": bad}))
    print(printed.splitlines()[-1], "Not used, since they fail:", *(bad or ["none"]), f"Map: {args.map}", sep="\n")


def chooser(stored: dict[str, Any], quick: list[str], everything: bool) -> Any:
    """A function: which of the quick tests, in which order, to show a mutant to."""
    quick = [test for test in quick if test not in set(stored["bad"]) and not test.startswith(NOT_COUNTED)]
    touched = {name: {stored["tests"][i] for i in which} & {*quick} for name, which in stored["functions"].items()}
    breadth, texts = Counter(itertools.chain.from_iterable(touched.values())), {}
    for path in (ROOT / "skevgp").rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        for name, first, last in functions(ast.parse(source)):
            texts[f"{path.relative_to(ROOT).as_posix()}:{name}"] = "\n".join(source.splitlines()[first - 1 : last])

    def choose(row: dict[str, Any]) -> list[str]:
        name = f"{row['file']}:{row['function']}"
        names = {name}
        if not touched.get(name):  # it runs at import, or in another process
            names = {key for key in touched if key.startswith(f"{row['file']}:")}
        if name not in texts:  # of a module or a class: what mentions it
            word = row["function"].rpartition(".")[2] or re.findall(r"\w+|$", row["original"])[0]
            names |= {key for key, text in texts.items() if re.search(rf"\b{word}\b", text)}
        touching = set[str]().union(*(touched.get(name, set()) for name in names))
        files = {test.partition("::")[0] for test in touching}  # fixtures may run in another test of the file
        path = Path(row["file"]).relative_to("skevgp")
        mirror = (f"tests/{path.parent}/test_{path.name}", f"tests/test_{path.name}", f"tests/{path.parent}/")
        shown = [test for test in quick if everything or test.partition("::")[0] in files]
        return sorted(shown, key=lambda test: (test not in touching, not test.startswith(mirror[:2]),
                                               not test.startswith(mirror), breadth[test]))  # fmt: skip

    return choose


def judge(row: dict[str, Any], root: Path, tests: list[str], seconds: dict[str, float]) -> tuple[str, str]:
    """Outcome of one mutant, and the test that failed."""
    path, place = root / row["file"], row["place"]
    source = path.read_bytes()
    starts = [0, *itertools.accumulate(map(len, source.splitlines(keepends=True)))]
    first, last = starts[place[0] - 1] + place[1], starts[place[2] - 1] + place[3]
    try:
        path.write_bytes(source[:first] + row["mutated"].encode() + source[last:])
        for start in [0, *range(50, len(tests), 400)]:
            # A compiled file counts as that of the mutant if sizes and seconds agree.
            shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)
            batch = sorted(tests[start : start + 400 if start else 50], key=lambda test: test.partition("::")[0])
            limit = 60 + 5 * sum(seconds.get(test, 0) for test in batch)
            status, printed = pytest(root, "-x", tests=batch, limit=limit) if batch else (0, "")
            if status == 4:  # the names of the cases differ
                batch = sorted({test.partition("[")[0] for test in batch})
                status, printed = pytest(root, "-x", tests=batch, limit=3 * limit)
            if status not in (0, 5):
                killer = next(iter(failed(printed)), printed.strip()[-100:])
                return ("timeout", "") if status is None else ("killed", killer)
    finally:
        path.write_bytes(source)
        shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)
    return "survived" if tests else "no test", ""


def run(args: argparse.Namespace) -> None:
    """Show the mutants to the tests, and append each outcome to a file at once."""
    resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))  # of each process
    rows = list(csv.DictReader(args.list.open()))[slice(*(int(x) if x else None for x in args.only.split(":")))]
    before = list(csv.DictReader(args.out.open())) if args.out.exists() else []
    done = {row["id"] for row in before if not (args.all and row["outcome"] in ("survived", "no test"))}
    found, stored, copies = all_mutants(), json.loads(args.map.read_text()), queue.Queue[Path]()
    with tempfile.TemporaryDirectory() as folder, args.out.open("a", newline="") as file:
        for _ in range(args.jobs):
            copies.put(copied(folder))
        collected = pytest(copies.queue[0], "--collect-only")[1].splitlines()
        choose = chooser(stored, [line for line in collected if re.match(r"(tests|skevgp)/[^ ]+::", line)], args.all)
        writer = csv.DictWriter(file, RESULT, extrasaction="ignore", lineterminator="\n")
        if not before:
            writer.writeheader()

        def one(listed: dict[str, Any]) -> None:
            began, row, root = time.monotonic(), found.get(tuple(listed[name] for name in IDENTITY)), copies.get()
            outcome, test = judge(row, root, choose(row), stored["seconds"]) if row else ("gone", "")
            copies.put(root)
            result = {"outcome": outcome, "test": test, "seconds": round(time.monotonic() - began, 1)}
            writer.writerow(listed | (row or {}) | result)
            file.flush()
            print(listed["id"], listed["file"], listed["function"], *result.values(), file=sys.stderr)

        with ThreadPoolExecutor(args.jobs) as pool:
            list(pool.map(one, [row for row in rows if row["id"] not in done]))
        killers = {row["test"] for row in csv.DictReader(args.out.open())}
        killers = {test for test in killers if test in collected or test.endswith(".py")}
        wrong = failed(pytest(copies.get(), tests=sorted(killers))[1]) if killers else []
        print("Tests that killed mutants and fail without one too:", *(wrong or ["none"]), sep="\n", file=sys.stderr)


def report(args: argparse.Namespace) -> None:
    """Print the share of mutants killed, and the others. The last outcome of a mutant counts."""
    rows = {int(row["id"]): row for row in csv.DictReader(args.out.open())}
    counts = Counter(row["outcome"] for row in rows.values())
    judged = len(rows) - counts["gone"]
    print(f"{(counts['killed'] + counts['timeout']) / judged:.1%} of {judged} mutants killed: {dict(counts)}")
    for i, row in sorted(rows.items()):
        if row["outcome"] not in ("killed", "timeout"):
            print(f"\n{i} {row['outcome']}: {row['file']}:{row['line']} {row['function']} ({row['kind']})")
            print(f"  - {row['original']}\n  + {row['mutated']}")


def draw(args: argparse.Namespace) -> None:
    """Draw mutants at random, and print them as CSV."""
    drawn = random.Random(args.seed).sample([row for _, row in sorted(all_mutants().items())], args.n)
    writer = csv.DictWriter(sys.stdout, ["id", *IDENTITY, "line", "col"], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(row | {"id": i} for i, row in enumerate(drawn))


def main() -> None:
    """Read the command line."""
    commands = {"list": draw, "map": map_tests, "run": run, "report": report}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=[*commands])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--list", type=Path, default=ROOT / "tests/mutation/mutants.csv")
    parser.add_argument("--map", type=Path, default=ROOT / ".mutation_cache/map.json")
    parser.add_argument("--out", type=Path, default=ROOT / "tests/mutation/results.csv")
    parser.add_argument("--only", default=":", help="I:J, a slice of the list")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--all", action="store_true", help="show survivors to all quick tests")
    args = parser.parse_args()
    commands[args.command](args)


if __name__ == "__main__":
    main()
