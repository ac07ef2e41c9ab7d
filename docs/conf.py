"""The site: ``python -m sphinx -W -n docs docs/_build/html``, with the extra ``docs``."""

import os
import sys
from pathlib import Path

# Before anything is imported that reads them. Pictures are drawn into files, and examples take minutes, not hours.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SKEVGP_EXAMPLES_QUICK", "1")

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS / "_ext"))

import skevgp

project = "skevgp"
author = "The skevgp developers"
copyright = author
version = release = skevgp.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "myst_parser",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "mathjax",
    "pages",
    "stories",
]
exclude_patterns = ["_build", "tests", "generated/parts", "**sg_execution_times.rst"]
templates_path = ["_templates"]
# Names in docstrings link to what they name if the site has a page of it.
default_role = "py:obj"

# Docstrings name private helpers, other packages' classes and each other's attributes, which have no page here. All
# other references must lead somewhere.
nitpick_ignore_regex = [("py:(obj|class|attr|meth|func|mod)", ".*")]

autosummary_generate = ["generated/api.rst"]
toc_object_entries_show_parents = "hide"
autodoc_typehints = "none"  # docstrings have the types, with shapes and units
numpydoc_show_class_members = False

myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
myst_dmath_double_inline = True

copybutton_exclude = ".linenos, .gp, .go"


sphinx_gallery_conf = {
    "examples_dirs": str(DOCS.parent / "examples"),
    "gallery_dirs": "auto_examples",
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"^(?!plot_)",  # helpers beside them
    "within_subsection_order": "stories.Order",
    "image_scrapers": ("thumbnails.scrape",),
    "reset_argv": "stories.arguments",
    "reset_modules": ("matplotlib", "stories.as_a_script"),
    "abort_on_example_error": True,
    "only_warn_on_example_error": False,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 0,
    "download_all_examples": False,
    "image_srcset": [],
    "doc_module": ("skevgp",),
    "backreferences_dir": "generated/backreferences",
    "inspect_global_variables": False,
}

html_theme = "pydata_sphinx_theme"
html_title = "skevgp"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_favicon = "_static/favicon.svg"
html_context = {"default_mode": "auto"}
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "logo": {"text": "skevgp", "image_light": "_static/favicon.svg", "image_dark": "_static/favicon.svg"},
    "header_links_before_dropdown": 7,
    "navigation_with_keys": False,
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
# Pages on their own have nothing to list beside them; results are wide, and stories are listed by their pictures.
ALONE = [
    "index",
    "start",
    "real_arms",
    "which_model",
    "comparison",
    "reproduction",
    "tests",
    "changelog",
    "generated/source/*",
]
ALONE += ["from_0_1_to_0_2", "from_0_2_to_0_3"]
ALONE += ["benchmarks", "generated/results/*", "auto_examples/*"]
html_sidebars = {page: [] for page in [*ALONE, "questions"]}
