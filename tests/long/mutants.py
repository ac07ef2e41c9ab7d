"""Mutation testing of the mathematics: small changes to the source, each of which some test must see.

    python -m tests.long.mutants                 # the modules of `TESTS`; about half an hour
    python -m tests.long.mutants model/bounds.py --again

A mutant is one edit (`_Edits`). It is made in a process of its own, a fork of one that has imported the other packages,
in which the module's fastest tests run first. Outcomes are kept in a file, so that a run that was stopped goes on where
it was; ``--again`` asks once more about those that survived. ``mutants_equivalent.txt`` holds those that no test can
tell from the original, with the reasons: they do not count.

(mutmut 3.8 leaves out properties, class attributes and modules' constants, a part of what is asked for here, and
neither it nor cosmic-ray 8 changes ``@``, ``.T`` or the bounds of slices, which linear algebra is made of.)
"""

import argparse
import ast
import gc
import json
import os
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FunctionType, ModuleType

import pytest

PACKAGE = Path(__file__).parents[2] / "skevgp"
EQUIVALENT = Path(__file__).with_name("mutants_equivalent.txt")
_INFERENCE = [f"tests/model/test_{name}.py" for name in ("model", "row_weights", "objectives", "families", "exact")]
_WEIGHTS = ["tests/test_shared_weights.py", "tests/test_coef_prior.py"]
# In the order in which they run.
TESTS = {
    "model/bounds.py": ["tests/model/test_bounds.py", *_WEIGHTS, *_INFERENCE],
    "model/statistics.py": [
        "tests/model/test_statistics.py",
        "tests/model/test_bounds.py",
        *_INFERENCE,
        "tests/kernels/test_models.py::test_gradient_of_the_bound_agrees_with_finite_differences",
    ],
    "model/predictor.py": [
        "tests/model/test_predictor.py",
        "tests/model/test_bounds.py",
        *_INFERENCE,
        "tests/test_shared_weights.py",
    ],
    "metrics.py": ["tests/test_metrics.py"],
}
_SECONDS = 300  # of a mutant's tests; they take 20
_OPTIONS = ["-s", "-m", "not long", "-p", "no:cacheprovider", "-p", "no:terminal", "-o", "addopts="]
_OPERATORS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.FloorDiv: ("//", "/"),
    ast.Pow: ("**", "*"), ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"), ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip
_PAIRS = [
    ("maximum", "minimum"),
    ("max", "min"),
    ("all", "any"),
    ("zeros", "ones"),
    ("tril", "triu"),
    ("subtract", "add"),
]
_NAMES = dict(_PAIRS) | {b: a for a, b in _PAIRS}
# Arguments that no result depends on; neither does it on whether a NumPy scalar is made a float or int.
_NO_RESULT = {"strict", "optimize"}
_MODULES = {"np", "lapack", "self", "cls"}


@dataclass(frozen=True)
class Mutant:
    """What identifies a mutant, wherever its line moves to; and the module's source with it."""

    module: str
    function: str
    before: str
    after: str
    source: bytes = field(repr=False)

    @property
    def key(self):
        return f"{self.module} {self.function}\n- {self.before}\n+ {self.after}"


class _Edits(ast.NodeVisitor):
    """(function, first byte, last byte, what takes their place) of each mutant."""

    def __init__(self, source):
        self.source, self.found, self.scope = source, [], []
        self.starts = [0]
        for line in source.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))
        self.visit(ast.parse(source))

    def span(self, node):
        return (
            self.starts[node.lineno - 1] + node.col_offset,
            self.starts[node.end_lineno - 1] + node.end_col_offset,
        )

    def text(self, node):
        first, last = self.span(node)
        return self.source[first:last].decode()

    def put(self, node, text):
        self.replace(*self.span(node), text)

    def replace(self, first, last, text):
        self.found.append((".".join(self.scope) or "module", first, last, text))

    def between(self, left, operator, right):
        """Another operator between two expressions."""
        old, new = _OPERATORS.get(type(operator), (None, None))
        if old:
            first, last = self.span(left)[1], self.span(right)[0]
            text = self.source[first:last].decode().replace(old, new, 1)
            self.replace(first, last, text)

    def visit_FunctionDef(self, node):
        self.scope.append(node.name)
        for each in [*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body]:
            self.visit(each)
        self.scope.pop()

    def visit_ClassDef(self, node):
        self.scope.append(node.name)
        for each in node.body:
            self.visit(each)
        self.scope.pop()

    def visit_Assign(self, node):
        names = {getattr(target, "id", None) for target in node.targets}
        if "__all__" in names or ast.unparse(node.value).startswith("Literal["):
            return
        if all(isinstance(target, (ast.Subscript, ast.Attribute)) for target in node.targets):
            self.put(node, "pass")
        self.generic_visit(node)

    def visit_AnnAssign(self, node):
        if node.value:
            self.visit(node.value)

    def visit_Expr(self, node):
        if not isinstance(node.value, ast.Constant):
            if not isinstance(node.value, ast.Yield):
                self.put(node, "pass")
            self.generic_visit(node)

    def visit_Raise(self, node):
        self.put(node, "pass")
        self.generic_visit(node)

    def visit_AugAssign(self, node):
        self.put(node, "pass")
        self.between(node.target, node.op, node.value)
        self.generic_visit(node)

    def visit_BinOp(self, node):
        if isinstance(node.op, ast.MatMult):
            self.put(node, f"({self.text(node.right)}) @ ({self.text(node.left)})")
        self.between(node.left, node.op, node.right)
        self.generic_visit(node)

    def visit_BoolOp(self, node):
        for left, right in zip(node.values, node.values[1:], strict=False):
            self.between(left, node.op, right)
        self.generic_visit(node)

    def visit_Compare(self, node):
        for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            self.between(left, operator, right)
        self.generic_visit(node)

    def visit_UnaryOp(self, node):
        self.put(node, f"({self.text(node.operand)})")
        self.generic_visit(node)

    def visit_If(self, node):
        self.put(node.test, f"not ({self.text(node.test)})")
        self.generic_visit(node)

    def visit_IfExp(self, node):
        self.put(node, f"({self.text(node.body)})")
        self.put(node, f"({self.text(node.orelse)})")
        self.generic_visit(node)

    def visit_Constant(self, node):
        value = node.value
        if isinstance(value, bool):
            self.put(node, repr(not value))
        elif isinstance(value, (int, float)):
            self.put(node, repr(value + 1))
        elif isinstance(value, str):
            self.put(node, repr(f"XX{value}XX"))

    def visit_JoinedStr(self, node):
        self.put(node, "'XX'")

    def visit_Name(self, node):
        if node.id in _NAMES:
            self.put(node, _NAMES[node.id])

    def visit_Attribute(self, node):
        if node.attr in _NAMES:
            self.put(node, f"({self.text(node.value)}).{_NAMES[node.attr]}")
        if node.attr == "T":
            self.put(node, f"({self.text(node.value)})")
        self.generic_visit(node)

    def visit_Call(self, node):
        arguments = [*node.args, *node.keywords]
        for own in filter(lambda each: each.arg not in _NO_RESULT, node.keywords):
            kept = ", ".join(self.text(each) for each in arguments if each is not own)
            self.put(node, f"{self.text(node.func)}({kept})")
        base = node.func.value if isinstance(node.func, ast.Attribute) else None
        if base is not None and not isinstance(base, ast.Constant) and ast.unparse(base).split(".")[0] not in _MODULES:
            self.put(node, f"({self.text(base)})")
        elif (
            node.args
            and self.text(node.func) not in ("float", "int")
            and not isinstance(node.args[0], (ast.Starred, ast.GeneratorExp))
        ):
            self.put(node, f"({self.text(node.args[0])})")
        self.generic_visit(node)

    def visit_keyword(self, node):
        if node.arg not in _NO_RESULT:
            self.visit(node.value)

    def visit_Slice(self, node):
        for bound in filter(None, (node.lower, node.upper)):
            self.put(bound, "")
        self.generic_visit(node)


def mutants_of(module):
    """All mutants of a module of the package."""
    source = (PACKAGE / module).read_bytes()
    found, seen = [], Counter()
    for function, first, last, text in _Edits(source).found:
        # Whole lines, before and after, each as one.
        begin, end = source.rfind(b"\n", 0, first) + 1, source.find(b"\n", last)
        before, after = source[begin:end], source[begin:first] + text.encode() + source[last:end]
        if before == after:
            continue
        words = [" ".join(each.decode().split()) for each in (before, after)]
        seen[function, *words] += 1
        again = f"  # {seen[function, *words]}" if seen[function, *words] > 1 else ""
        whole = source[:begin] + after + source[end:]
        found.append(Mutant(module, function, words[0], words[1] + again, whole))
    return found


def equivalent():
    """Keys of the mutants that no test can tell from the original -> reason."""
    found, reason = {}, None
    for paragraph in EQUIVALENT.read_text(encoding="utf-8").split("\n\n"):
        if paragraph.startswith("#"):
            reason = paragraph
        elif paragraph.strip():
            found[paragraph.strip()] = reason
    return found


def put_in_place(module, source):
    """Give a module another source, in all that has been imported: functions keep their identity."""
    name, path = "skevgp." + module.removesuffix(".py").replace("/", "."), str(PACKAGE / module)
    new = ModuleType(name)
    new.__package__, new.__file__ = name.rpartition(".")[0], path
    try:
        exec(compile(source, path, "exec"), vars(new))
    except Exception as error:
        return f"import: {error!r}"
    _exchange(sys.modules[name], new, name, path)
    return ""


def _exchange(old, new, module, path):
    for name in vars(new).keys() & vars(old).keys():
        ours, theirs = (_function_of(vars(owner)[name]) for owner in (old, new))
        if isinstance(ours, FunctionType):
            if ours.__code__.co_filename == path:
                ours.__code__ = theirs.__code__
            ours.__defaults__, ours.__kwdefaults__ = theirs.__defaults__, theirs.__kwdefaults__
        elif isinstance(ours, type) and ours.__module__ == module:
            _exchange(ours, theirs, module, path)
        elif not name.startswith("__") and ours is not theirs and not isinstance(ours, (type, ModuleType)):
            for owner in [old, *(each for key, each in sys.modules.items() if key.startswith(("skevgp", "tests")))]:
                if vars(owner).get(name) is ours:
                    setattr(owner, name, theirs)


def _function_of(member):
    """That of a method, property or cached property."""
    for attribute in ("__func__", "fget", "func"):
        if isinstance(own := getattr(member, attribute, None), FunctionType):
            return own
    return member


class Session:
    """A plugin of pytest: in place of the tests it runs those of each mutant, in a fork."""

    def __init__(self, modules, path, again):
        self.modules, self.path, self.again, self.failed = modules, path, again, ""

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.failed = self.failed or report.nodeid

    def pytest_runtestloop(self, session):
        gc.collect()
        gc.freeze()
        run(self.modules, self.path, self.again, partial(self.outcome, session.items))
        return True

    def outcome(self, items, module, mutant=None, first=()):
        """What sees a module's mutant: a test, or a signal (SIGALRM: of the time limit); "" for nothing."""
        reading, writing = os.pipe()
        if not (child := os.fork()):
            try:
                silence = os.open(os.devnull, os.O_WRONLY)
                os.dup2(silence, 1)
                os.dup2(silence, 2)
                signal.alarm(_SECONDS)
                os.write(writing, (self._seen_by(items, module, mutant, first)).encode())
            except BaseException as error:
                os.write(writing, f"driver: {error!r}".encode())
            finally:
                os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            said = pipe.read()
        killed_by = os.WTERMSIG(os.waitpid(child, 0)[1])
        if killed_by in (signal.SIGTERM, signal.SIGKILL):
            pytest.exit("somebody stopped it", returncode=2)
        return signal.Signals(killed_by).name if killed_by else said

    def _seen_by(self, items, module, mutant, first):
        if mutant and (error := put_in_place(module, mutant.source)):
            return error
        order = [*first, *TESTS[module]]
        places = {item: [place for place, test in enumerate(order) if item.nodeid.startswith(test)] for item in items}
        for item in sorted((item for item in items if places[item]), key=lambda item: places[item][0]):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
            if self.failed:
                return self.failed
        return ""


def known_outcomes(path):
    """Those of earlier runs, by key."""
    return dict(json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()) if path.exists() else {}


def run(modules, path, again, outcome_of):
    """Find the outcomes of all mutants of the modules that are not in the file, and put them there."""
    known, harmless = known_outcomes(path), equivalent()
    path.parent.mkdir(parents=True, exist_ok=True)
    for module in modules:
        if seen := outcome_of(module):
            print(f"{module}: a test fails without a mutant, {seen}")
            pytest.exit("", returncode=2)
        mutants = mutants_of(module)
        for number, mutant in enumerate(mutants):
            done = mutant.key in known and not (again and not known[mutant.key])
            if done or mutant.key in harmless:
                continue
            start = time.perf_counter()
            # What saw other mutants of the function sees most.
            of_function = (known.get(other.key) for other in mutants if other.function == mutant.function)
            first = [test for test, _ in Counter(filter(None, of_function)).most_common(5) if "::" in test]
            known[mutant.key] = seen = outcome_of(module, mutant, first)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps([mutant.key, seen]) + "\n")
            took = time.perf_counter() - start
            print(f"{number + 1}/{len(mutants)} {took:.1f} s {seen or 'SURVIVED ' + mutant.key}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(TESTS), help=f"of {', '.join(TESTS)}")
    parser.add_argument("--results", type=Path, default=Path("build/mutants.jsonl"))
    parser.add_argument("--again", action="store_true", help="run those that survived once more")
    options = parser.parse_args()
    tests = sorted({test for module in options.modules for test in TESTS[module]})
    session = Session(options.modules, options.results, options.again)
    if status := pytest.main([*_OPTIONS, *tests], plugins=[session]):
        sys.exit(status)
    known, harmless, lowest = known_outcomes(options.results), equivalent(), 1.0
    print(f"{'':26}{'mutants':>9}{'killed':>9}{'equivalent':>12}{'survived':>10}{'score':>9}")
    survivors = []
    for module in options.modules:
        keys = [mutant.key for mutant in mutants_of(module)]
        same = sum(key in harmless for key in keys)
        left = [key for key in keys if key not in harmless and not known[key]]
        killed = len(keys) - same - len(left)
        score = killed / (killed + len(left))
        print(f"{module:26}{len(keys):9}{killed:9}{same:12}{len(left):10}{score:9.1%}")
        survivors, lowest = survivors + left, min(lowest, score)
    print("\n\n".join(["", *survivors]))
    sys.exit(lowest < 0.9)


if __name__ == "__main__":
    main()
