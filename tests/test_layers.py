"""The architecture: who imports what."""

import ast
import re
import sys
from functools import cache
from pathlib import Path

import skevgp

PACKAGE = Path(skevgp.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
REQUIRED = {"autograd", "joblib", "numpy", "scipy", "sklearn", "threadpoolctl"}


@cache
def parsed(module):
    return ast.parse(module.read_text(encoding="utf-8"))


def mentions(module, *words):
    """Whether one of the words is in the text. If not, there is nothing to be found in the module's tree."""
    return re.search(rf"\b({'|'.join(words)})\b", module.read_text(encoding="utf-8")) is not None


def may_import(module):
    """The packages of all lines with the word "import", wherever they are; None if a line says more than that."""
    lines = [line.strip() for line in module.read_text(encoding="utf-8").splitlines() if re.search(r"\bimport\b", line)]
    found = [re.fullmatch(r"(?:from (\.*)([\w.]*) import|import ([\w.]+)(?: as \w+)?$).*", line) for line in lines]
    return {(one[2] or one[3]).partition(".")[0] for one in found if not one[1]} if all(found) else None


def imports_at_load(tree):
    """Names of the packages that a module imports when it is loaded: not in functions, not under TYPE_CHECKING."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module.partition(".")[0]
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from imports_at_load(ast.Module(node.orelse, []))
        elif isinstance(node, (ast.stmt, ast.ExceptHandler)) and not isinstance(node, ast.FunctionDef):
            yield from imports_at_load(node)


def test_modules_load_required_packages_only():
    known = REQUIRED | {"skevgp"} | sys.stdlib_module_names
    for module in MODULES:
        assert (may_import(module) or {""}) <= known or set(imports_at_load(parsed(module))) <= known, module


_RUNS_CODE = {
    *("eval", "exec", "compile", "__import__", "breakpoint"),
    *("pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "subprocess", "ctypes", "runpy", "code"),
    *("system", "popen", "spawn", "extractall", "unpickle"),
}


def what_runs_code(tree):
    """Calls and imports by which what a file says could be run; and arrays that may hold pickles."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + (
                [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            )
            yield from (name for name in names if set(name.split(".")) & _RUNS_CODE)
        elif isinstance(node, ast.Call):
            called = node.func
            if isinstance(called, ast.Name) and called.id in _RUNS_CODE:
                yield called.id
            # `re.compile` and a model's own `compile` make no code.
            elif isinstance(called, ast.Attribute) and called.attr in _RUNS_CODE - {"compile"}:
                yield called.attr
            if ast.unparse(called) in ("np.load", "numpy.load", "joblib.load", "yaml.load"):
                yield ast.unparse(called)
            yield from ("allow_pickle" for word in node.keywords if word.arg == "allow_pickle" and word.value.value)


def test_no_module_runs_code_of_files():
    assert set(what_runs_code(ast.parse("import pickle\neval(x)\nnp.load(f, allow_pickle=True)"))) == {
        *("pickle", "eval", "np.load", "allow_pickle")
    }
    words = *_RUNS_CODE, "load", "allow_pickle"
    modules = [module for module in MODULES if mentions(module, *words)]
    assert not {module: found for module in modules if (found := list(what_runs_code(parsed(module))))}


def test_only_data_sets_open_connections_and_each_has_a_checksum():
    """What is downloaded is compared with SHA-256 before it is used."""
    opening = [module for module in MODULES if "urlopen" in module.read_text(encoding="utf-8")]
    assert [module.name for module in opening] == ["snelson.py"]
    assert "sha256" in opening[0].read_text(encoding="utf-8")
    known = {"urllib.request", "http.client", "socket", "ssl", "ftplib", "requests", "httpx", "aiohttp"}
    words = {name.partition(".")[0] for name in known}
    for module in (module for module in MODULES if mentions(module, *words)):
        nodes = [node for node in ast.walk(parsed(module)) if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {alias.name for node in nodes for alias in node.names} | {getattr(node, "module", "") for node in nodes}
        assert module in opening or not names & known, module
