"""The architecture: who imports what."""

import ast
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

import skevgp

PACKAGE = Path(skevgp.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
REQUIRED = {"autograd", "joblib", "numpy", "scipy", "sklearn", "threadpoolctl"}
# Where the small sources below are taken to stand.
HERE = PACKAGE / "data" / "blocks.py"
each_module = pytest.mark.parametrize("module", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())


@cache
def parsed(module):
    return ast.parse(module.read_text(encoding="utf-8"))


def imports_at_load(tree):
    """Names of the packages that a module imports when it is loaded: not in functions, not under TYPE_CHECKING."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module.partition(".")[0]
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from imports_at_load(ast.Module(node.orelse, []))
        elif not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield from imports_at_load(node)


def test_the_contracts_of_the_imports_are_kept(monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", [*sys.path])
    status = lint_imports(config_filename=str(PACKAGE.parent / "setup.cfg"), no_cache=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_a_broken_contract_would_be_seen(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "path", [*sys.path])
    config = tmp_path / "setup.cfg"
    config.write_text(
        "[importlinter]\nroot_package = skevgp\n"
        "[importlinter:contract:wrong]\nname = Wrong\ntype = forbidden\n"
        "source_modules = skevgp.estimators.evgp\nforbidden_modules = skevgp.model\n"
    )
    assert lint_imports(config_filename=str(config), no_cache=True) != EXIT_STATUS_SUCCESS
    assert "Wrong BROKEN" in capsys.readouterr().out


def imports(tree, module):
    """What a module binds, and the whole name that is bound to it, wherever in the module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.asname or alias.name.partition(".")[0], alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            folder = module.relative_to(PACKAGE.parent).parts[: -node.level] if node.level else ()
            source = ".".join([*folder, *filter(None, [node.module])])
            yield from ((alias.asname or alias.name, f"{source}.{alias.name}") for alias in node.names)


def is_private(name):
    return name.startswith("_") and not name.endswith("__")


def private_attributes(tree, bound):
    """``a._b`` and ``a.b._c`` of names that an import has bound."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            whole = ast.unparse(node)
            if whole.partition(".")[0] in bound:
                yield whole


def private_names_of_scikit_learn(tree, module):
    found = [(bound, name) for bound, name in imports(tree, module) if name.partition(".")[0] == "sklearn"]
    yield from (name for _, name in found if any(map(is_private, name.split("."))))
    yield from private_attributes(tree, {bound for bound, _ in found})


def home(path):
    """The folder that holds a module, or a module's name."""
    return path.parent if path.parent.is_dir() else path.parent.parent


def private_names_of_other_folders(tree, module):
    """Functions, classes and constants of the package; its private modules serve their folder and those inside it."""

    def is_kept_from_here(path):
        is_module = path.is_dir() or path.with_suffix(".py").is_file()
        serves = module.is_relative_to(home(path)) if is_module else module.parent == home(path)
        return is_private(path.name) and not serves

    bound = set()
    for alias, name in imports(tree, module):
        path = PACKAGE.parent / name.replace(".", "/")
        inside = [part for part in (path, *path.parents) if part.is_relative_to(PACKAGE)]
        if inside and home(path) != module.parent:
            bound.add(alias)
        if any(map(is_kept_from_here, inside)):
            yield name
    yield from private_attributes(tree, bound)


@each_module
def test_a_module_loads_required_packages_only(module):
    assert set(imports_at_load(parsed(module))) <= REQUIRED | {"skevgp"} | sys.stdlib_module_names


@each_module
def test_one_module_imports_the_private_names_of_scikit_learn(module):
    found = set(private_names_of_scikit_learn(parsed(module), module))
    assert bool(found) == (module == PACKAGE / "utils" / "sklearn.py"), found


@each_module
def test_private_names_stay_in_their_folder(module):
    assert not set(private_names_of_other_folders(parsed(module), module))


def test_no_modules_import_each_other():
    graph = grimp.build_graph("skevgp", exclude_type_checking_imports=True, cache_dir=None)
    arrows = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(arrows).prepare()
    assert arrows["skevgp.estimators.evgp"]
    with pytest.raises(CycleError):
        TopologicalSorter({**arrows, "skevgp.utils.linalg": {"skevgp.estimators.evgp"}}).prepare()


@pytest.mark.parametrize(
    ("source", "imported"),
    [
        ("import pinocchio as pin", {"pinocchio"}),
        ("from matplotlib import pyplot", {"matplotlib"}),
        ("class A:\n    import dask.array", {"dask"}),
        ("try:\n    import a\nexcept ImportError:\n    import b", {"a", "b"}),
        ("if TYPE_CHECKING:\n    import a\nelse:\n    import b", {"b"}),
        ("def f():\n    import a", set()),
        ("from . import a\nfrom .b import c", set()),
    ],
)
def test_imports_are_found(source, imported):
    assert set(imports_at_load(ast.parse(source))) == imported


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("from sklearn.base import _fit_context, clone", {"sklearn.base._fit_context"}),
        ("from sklearn.utils._param_validation import Interval", {"sklearn.utils._param_validation.Interval"}),
        ("def f():\n    import sklearn.utils._indexing as i", {"sklearn.utils._indexing"}),
        ("from sklearn import utils\nutils._safe_indexing(x)", {"utils._safe_indexing"}),
        ("import sklearn\nsklearn.base._fit_context", {"sklearn.base._fit_context"}),
        ("from sklearn.base import clone, __version__\nself._a = clone.b", set()),
        ("from .._sklearn import fit_context\nfrom numpy import _core", set()),
    ],
)
def test_private_names_of_scikit_learn_are_found(source, found):
    assert set(private_names_of_scikit_learn(ast.parse(source), HERE)) == found


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("from ..fitting.start import _scale, Frame", {"skevgp.fitting.start._scale"}),
        ("from skevgp.fitting.start import _scale", {"skevgp.fitting.start._scale"}),
        ("from ..utils.linalg import _jitter", {"skevgp.utils.linalg._jitter"}),
        ("from ..utils import linalg\nlinalg._jitter", {"linalg._jitter"}),
        ("from ..fitting import start as u\nu._scale()", {"u._scale"}),
        ("def f():\n    from ..plotting import _style", {"skevgp.plotting._style"}),
        ("from ..plotting._style import axes", {"skevgp.plotting._style.axes"}),
        ("from .threads import _pool\nfrom . import threads\nthreads._pool", set()),
        ("from ..utils import linalg\nfrom ..utils.linalg import jitter\nfrom .. import __version__", set()),
        ("import numpy as np\nnp._core", set()),
    ],
)
def test_private_names_of_other_folders_are_found(source, found):
    assert set(private_names_of_other_folders(ast.parse(source), HERE)) == found


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


@each_module
def test_no_module_runs_what_a_file_says(module):
    assert list(what_runs_code(parsed(module))) == []


@pytest.mark.parametrize(
    "source",
    [
        "eval(x)", "import pickle", "from os import system", "os.system(x)", "import yaml; yaml.load(x)",
        "np.load(x)", "f(allow_pickle=True)", "from joblib.externals import cloudpickle", "archive.extractall()",
    ],
)  # fmt: skip
def test_what_would_run_code_is_seen(source):
    assert list(what_runs_code(ast.parse(source)))


def test_only_data_sets_open_connections_and_each_has_a_checksum():
    """What is downloaded is compared with SHA-256 before it is used."""
    opening = [module for module in MODULES if "urlopen" in module.read_text(encoding="utf-8")]
    assert [module.name for module in opening] == ["snelson.py"]
    assert "sha256" in opening[0].read_text(encoding="utf-8")
    known = {"urllib.request", "http.client", "socket", "ssl", "ftplib", "requests", "httpx", "aiohttp"}
    for module in MODULES:
        nodes = [node for node in ast.walk(parsed(module)) if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {alias.name for node in nodes for alias in node.names} | {getattr(node, "module", "") for node in nodes}
        assert module in opening or not names & known, module
