"""Optional packages: imported when they are used, or an error with the pip command."""

from __future__ import annotations

import importlib
from types import ModuleType

# Importable name -> (what to pip install, the extra of this package that brings it).
_PACKAGES = {
    "pinocchio": ("pin", "physics"),
    "matplotlib": ("matplotlib", "plot"),
    "dask": ("'dask[array,distributed]'", "dask"),
    "casadi": ("casadi", "casadi"),
    "rosbags": ("rosbags", "logs"),
    "skops": ("skops", "io"),
    "tqdm": ("tqdm", "progress"),
}


def require(name: str, purpose: str) -> ModuleType:
    """Import an optional package or module, or raise an ImportError with ``purpose`` as subject and the pip command."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        top = name.partition(".")[0]
        package, extra = _PACKAGES.get(top, (top, "all"))
        raise ImportError(
            f"{purpose} needs the optional package {package!r}, which cannot be imported ({error}). "
            f"Install it with: pip install {package} (or, from a clone of the project: pip install '.[{extra}]')"
        ) from error
