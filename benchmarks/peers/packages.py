"""The size of Gaussian process packages: MB that pip installs with each, and lines of code.

Each package is installed by pip, alone, in an empty environment. The CSV has one row per package. Lines of code are
those of the package's own Python files without tests, comments, docstrings and blank lines. On Linux, pip takes the
torch of the default index, which brings CUDA.

    python benchmarks/peers/packages.py
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import os
import platform
import subprocess
import sys
import tempfile
import tokenize
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).resolve().parents[2]
# The distribution to install, and the module that it brings.
PACKAGES = {
    "skevgp": (str(ROOT), "skevgp"),
    "scikit-learn": ("scikit-learn", "sklearn/gaussian_process"),
    "GPflow": ("gpflow", "gpflow"),
    "GPyTorch": ("gpytorch", "gpytorch"),
    "GPJax": ("gpjax", "gpjax"),
}
LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING}
LAYOUT.add(tokenize.ENDMARKER)


def lines_of_code(source: str) -> int:
    """Count lines that hold code."""
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in LAYOUT:
            held.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            held.difference_update(range(node.lineno, node.end_lineno + 1))
    return len(held)


def code_in(folder: Path) -> int:
    """Count the code of a package without its tests."""
    files = [file for file in folder.rglob("*.py") if not {"tests", "testing"} & set(file.relative_to(folder).parts)]
    return sum(lines_of_code(file.read_text(encoding="utf-8")) for file in files)


def megabytes(folder: Path) -> float:
    """Measure what files hold, without what Python compiled of them."""
    files = (file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
    return sum(file.stat().st_size for file in files if "__pycache__" not in file.parts) / 1e6


def said(command: list[str]) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def measured(name: str) -> dict[str, str]:
    """Install a package in an empty environment, and measure it."""
    distribution, module = PACKAGES[name]
    with tempfile.TemporaryDirectory() as folder:
        said([sys.executable, "-m", "venv", "--without-pip", folder])
        python = str(Path(folder, "Scripts" if os.name == "nt" else "bin", "python"))
        pip = [sys.executable, "-m", "pip", "--python", python]
        said([*pip, "install", "--quiet", "--no-compile", distribution])
        listed = json.loads(said([*pip, "list", "--format=json"]))
        versions = {each["name"].lower(): each["version"] for each in listed}
        installed = Path(said([python, "-c", "import sysconfig; print(sysconfig.get_path('platlib'))"]).strip())
        return {
            "version": versions["skevgp" if name == "skevgp" else distribution],
            "distributions": str(len(versions)),
            "megabytes": f"{megabytes(installed):.1f}",
            "lines_of_code": str(code_in(installed / module)),
            "counted": module,
            "date": datetime.now(UTC).date().isoformat(),
            "machine": f"Python {platform.python_version()}, {platform.system()} {platform.machine()}",
        }


def main() -> None:
    """Measure the packages, or some of them; rows of others stay."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packages", nargs="+", choices=PACKAGES, default=list(PACKAGES))
    output = Path(__file__).with_suffix(".csv")
    rows = pd.read_csv(output, dtype=str, index_col="package")
    for name in parser.parse_args().packages:
        rows.loc[name] = pd.Series(measured(name))
        rows.to_csv(output)
    print(rows.to_string())


if __name__ == "__main__":
    main()
