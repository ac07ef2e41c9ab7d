import ast
import sys
from pathlib import Path

import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

import skevgp

PACKAGE = Path(skevgp.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
REQUIRED = {"autograd", "joblib", "numpy", "scipy", "sklearn", "threadpoolctl"}


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
        "source_modules = skevgp.regressor\nforbidden_modules = skevgp.inference\n"
    )
    assert lint_imports(config_filename=str(config), no_cache=True) != EXIT_STATUS_SUCCESS
    assert "Wrong BROKEN" in capsys.readouterr().out


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_loads_required_packages_only(module):
    imported = set(imports_at_load(ast.parse(module.read_text(encoding="utf-8"))))
    assert imported <= REQUIRED | sys.stdlib_module_names


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
