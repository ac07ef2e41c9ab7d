"""Pages made of what the repository has: results, the reproduction, the changelog, source files, the API.

They are written to ``generated`` before Sphinx looks for pages, so that there is one copy of each in the repository.
The role ``src`` links to a source file's page: ``{src}`skevgp/metrics.py```.
"""

import configparser
import inspect
import re
import shutil
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import matplotlib.pyplot as plt
from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.config import Config

import blocks
import comparison
import front
import skevgp

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
RESULTS = ROOT / "benchmarks" / "results"
GENERATED = DOCS / "generated"

SOURCE_ROLE = re.compile(r"(?:\{src\}|:src:)`([^`]+)`")
# [text](target) or ![text](target) with a target inside the repository; "[-1, 1)" opens a bracket that is not a link's.
LINK = re.compile(r"(!?)\[([^\[\]]*)\]\((?!https?:|#)([^)#\s]+)(#[^)]*)?\)")
# Pages of the site that stand for files of the repository.
PAGES = {"README.md": "/index", "REPRODUCTION.md": "/reproduction", "CHANGELOG.md": "/changelog"}
# What public functions return, and users therefore meet.
RETURNED = {"skevgp.control.compiled": ["CompiledPredictor"], "skevgp.control.acados": ["L4acadosModel"]}


def write(path: Path, text: str) -> None:
    """Write a file if its text is new: what is not touched is not built again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def source_page(path: str) -> str:
    """Name the page of a source file."""
    return "/generated/source/" + path.replace("/", "-")


def write_source_page(path: str) -> None:
    """Write the page of a source file, which search passes over."""
    if not (ROOT / path).is_file():
        raise FileNotFoundError(f"a page names the source file {path}, which is not there")
    page = GENERATED / source_page(path).removeprefix("/generated/")
    write(
        page.with_name(page.name + ".md"),
        f"---\norphan: true\nnosearch: true\nhtml_theme.sidebar_secondary.remove: true\n---\n\n# {path}\n\n"
        f"```{{literalinclude}} /../{path}\n:language: python\n:linenos:\n```\n",
    )


def rewritten(text: str, folder: Path) -> str:
    """Let the links of a Markdown file of the repository lead to pages of the site."""

    def link(found: re.Match[str]) -> str:
        picture, words, target, _ = found.groups()
        path = (folder / target).resolve().relative_to(ROOT).as_posix()
        if picture:
            return f"![{words}](/../{path})"
        if path.endswith(".py"):
            return f"{{src}}`{path}`"
        if path.startswith("docs/") and path.endswith(".md"):
            return f"{{doc}}`{words} </{path.removeprefix('docs/').removesuffix('.md')}>`"
        if path in PAGES:
            return f"{{doc}}`{words} <{PAGES[path]}>`"
        if path.startswith("benchmarks/results/") and path.endswith(".md"):
            return f"{{doc}}`{words.strip('`')} </generated/results/{Path(path).stem}>`"
        return f"{{download}}`{words.strip('`')} </../{path}>`"

    return LINK.sub(link, text)


def write_included(name: str) -> None:
    """Write a file of the repository as a part that a page includes, without its title."""
    text = (ROOT / name).read_text(encoding="utf-8")
    write(GENERATED / "parts" / name.lower(), rewritten(text.partition("\n")[2], ROOT))


def write_results() -> None:
    """Write a page for each report of a benchmark, with its picture and a link to its numbers."""
    titles: set[str] = set()
    for report in sorted(RESULTS.glob("*.md")):
        if "_quick" in report.stem:
            continue
        text = rewritten(report.read_text(encoding="utf-8"), RESULTS)
        title, _, rest = text.removeprefix("# ").partition("\n")
        if title in titles:  # of another run of the same benchmark
            title = f"{title} ({report.stem})"
        titles.add(title)
        picture = report.with_suffix(".png")
        if picture.exists() and picture.name not in text:
            rest += f"\n![{title}](/../benchmarks/results/{picture.name})\n"
        numbers = [file for file in sorted(RESULTS.glob(f"{report.stem}.csv*")) if file.is_file()]
        added = [f"{{download}}`{file.name} </../benchmarks/results/{file.name}>`: a row per run." for file in numbers]
        write(GENERATED / "results" / report.name, "\n\n".join([f"# {title}", *answer_first(rest), *added]) + "\n")


def answer_first(text: str) -> list[str]:
    """Split a report into paragraphs: its answer and its first picture come first, a note in italics after them."""
    parts = [part for part in re.split(r"\n{2,}", text.strip("\n")) if part]
    notes = parts[:1] if parts[0].startswith("*") else []
    answer, *others = parts[len(notes) :]
    pictures = [part for part in others if re.fullmatch(r"!\[[^\]]*\]\([^)]*\)", part)][:1]
    return [answer, *pictures, *notes, *(part for part in others if part not in pictures)]


def public_modules() -> list[tuple[str, ModuleType]]:
    """List the package and its public modules, by name."""
    names = [name for name in skevgp.__all__ if inspect.ismodule(getattr(skevgp, name))]
    return [("skevgp", skevgp), *((f"skevgp.{name}", import_module(f"skevgp.{name}")) for name in [*names, "robots"])]


def tables(module: str, names: Iterable[str]) -> str:
    """List a module's names in tables that link to their pages."""
    entries = "\n".join(f"   {name}" for name in names)
    return f".. currentmodule:: {module}\n\n.. autosummary::\n   :toctree: api\n   :nosignatures:\n\n{entries}\n"


def of_real_arms() -> tuple[str, ...]:
    """Name the modules of the part for real arms: those that the contract on imports protects."""
    contracts = configparser.ConfigParser()
    contracts.read(ROOT / "setup.cfg", encoding="utf-8")
    return tuple(f"{name}." for name in contracts["importlinter:contract:real_arms"]["protected_modules"].split())


def write_api() -> None:
    """Write the overview of all public names; autosummary writes a page for each."""
    title, listed, arms, homes = "API reference", set(), {}, of_real_arms()
    parts = [f"{title}\n{'=' * len(title)}\n\nAll public names. The examples in these pages are tests.\n"]
    for name, module in public_modules():
        members = [each for each in module.__all__ if not each.startswith("_")]
        members = [each for each in members if not inspect.ismodule(getattr(module, each))]
        # What two modules have is listed with the first.
        callables = [each for each in members if callable(thing := getattr(module, each)) and thing not in listed]
        listed |= {getattr(module, each) for each in callables}
        arms[name] = [each for each in callables if f"{getattr(module, each).__module__}.".startswith(homes)]
        summary = inspect.getdoc(module).splitlines()[0].rstrip(".")
        others = [each for each in callables if each not in arms[name]]
        parts.append(f"{name}\n{'-' * len(name)}\n\n{summary}.\n\n{tables(name, others)}")
    parts.append(".. _api-real-arms:\n\nReal arms\n---------\n")
    parts.append(":doc:`Logs, identification, contact and URDF files </real_arms>`.\n")
    parts += [f"Of ``{name}``:\n\n{tables(name, names)}" for name, names in arms.items() if names]
    parts.append("What methods return\n-------------------\n")
    parts += [tables(module, names) for module, names in RETURNED.items()]
    write(GENERATED / "api.rst", "\n".join(parts))


def write_pictures(page: Path) -> None:
    """Run a page whose code saves pictures, and keep them."""
    folder = GENERATED / "pictures"
    stamp = folder / f"{page.stem}.run"
    text = page.read_text(encoding="utf-8")
    if "savefig(" not in text or (stamp.exists() and stamp.read_text(encoding="utf-8") == text):
        return
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as scratch:
        for _ in blocks.run(page, Path(scratch)):
            pass
        plt.close("all")  # or the first story of the gallery would show them
        for picture in Path(scratch).glob("*.png"):
            shutil.copy(picture, folder)
    stamp.write_text(text, encoding="utf-8")


def generate(app: Sphinx, _: Config) -> None:
    """Write all generated pages."""
    for folder in ("api", "results", "source", "parts"):
        shutil.rmtree(GENERATED / folder, ignore_errors=True)
    for name in ("REPRODUCTION.md", "CHANGELOG.md"):
        write_included(name)
    write_results()
    write_api()
    for name, text in comparison.parts().items():
        write(GENERATED / "parts" / f"{name}.md", text)
    for page in DOCS.rglob("*.md"):
        if not {"_build", "generated", "tests"} & set(page.relative_to(DOCS).parts):
            write_pictures(page)
    front.write_front(GENERATED / "pictures")
    pages = [page for page in DOCS.rglob("*.md") if "_build" not in page.parts]
    pages.append(ROOT / "examples" / "GALLERY_HEADER.rst")
    named = {path for page in pages for path in SOURCE_ROLE.findall(page.read_text(encoding="utf-8"))}
    for path in sorted(named):
        write_source_page(path)


def source_role(name: str, raw: str, path: str, line: int, inliner: Any, *_: Any) -> tuple[list, list]:
    """Link to a source file's page."""
    target = addnodes.pending_xref(
        raw, nodes.literal(raw, path), refdomain="std", reftype="doc", reftarget=source_page(path), refexplicit=True
    )
    target["refwarn"] = True
    return [target], []


def skip_foreign(app: Sphinx, what: str, name: str, thing: Any, skip: bool, options: Any) -> bool | None:
    """Leave out methods that scikit-learn gives every estimator: they are documented there."""
    if name.startswith("_"):
        return None
    home = getattr(thing, "__module__", None)
    return True if callable(thing) and home and not home.startswith("skevgp") else None


def keep_initials(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Keep the initial of an author at the beginning of an item from becoming a list of its own."""
    lines[:] = [re.sub(r"^(\s*[*-] [A-Z])\. ", r"\1\\. ", line) for line in lines]


def setup(app: Sphinx) -> dict[str, bool]:
    """Generate pages before Sphinx looks for them."""
    app.connect("config-inited", generate)
    app.connect("autodoc-skip-member", skip_foreign)
    app.connect("autodoc-process-docstring", keep_initials, priority=400)  # before numpydoc
    app.add_role("src", source_role)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
