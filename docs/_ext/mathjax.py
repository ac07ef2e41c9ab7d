"""Formulas without a network: MathJax from the package sphinx-mathjax-offline, the part of it that the site needs.

The package's own extension copies all of MathJax, 24 MB; one component and its fonts are 2 MB.
"""

from importlib.util import find_spec
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util.fileutil import copy_asset

PARTS = ("tex-chtml.js", "output/chtml/fonts/woff-v2")


def copy(app: Sphinx, failed: Exception | None) -> None:
    """Copy MathJax into the site."""
    if failed is not None or app.builder.format != "html":
        return
    source = Path(find_spec("sphinx-mathjax-offline").origin).parent / "static" / "mathjax"
    for part in PARTS:
        target = Path(app.outdir, "_static", "mathjax", part)
        target.parent.mkdir(parents=True, exist_ok=True)
        copy_asset(source / part, target if (source / part).is_dir() else target.parent)


def setup(app: Sphinx) -> dict[str, bool]:
    """Set where pages look for MathJax."""
    app.config.mathjax_path = "mathjax/tex-chtml.js"
    # The horizontal stroke of \top is too thin for screens, which show a bar.
    app.config.mathjax3_config = {"tex": {"macros": {"top": r"{\mathsf{T}}"}}}
    app.connect("build-finished", copy)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
