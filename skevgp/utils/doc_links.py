"""Links from the HTML display of an estimator to its page of the documentation."""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, metadata

_PACKAGE = __name__.partition(".")[0]


class DocumentedEstimator:
    """An estimator whose HTML display links to its page, by the protocol of scikit-learn.

    Its page is on the site that ``Documentation`` of ``[project.urls]`` in ``pyproject.toml`` names. Without this
    address, and for classes without a page, there is no link.
    """

    _doc_link_module = _PACKAGE

    @property
    def _doc_link_template(self) -> str:
        site, page = site_address(), page_of(type(self))
        return f"{site}/{page}" if site and page else ""


@lru_cache(maxsize=1)
def site_address() -> str:
    """Return the address of the documentation without a slash at its end; empty if the package names none."""
    try:
        entries = metadata(_PACKAGE).get_all("Project-URL") or []
    except PackageNotFoundError:
        return ""
    addresses = dict(entry.split(", ", 1) for entry in entries)
    return addresses.get("Documentation", "").rstrip("/")


def page_of(kind: type) -> str:
    """Return the page of a class on the site; empty if it is not public."""
    # The overview of the API lists a name with the first of these modules that has it.
    for module in (_PACKAGE, ".".join(kind.__module__.split(".")[:2])):
        if getattr(sys.modules[module], kind.__name__, None) is kind and kind.__name__ in sys.modules[module].__all__:
            return f"generated/api/{module}.{kind.__name__}.html"
    return ""
