"""How the gallery runs the examples, and in which groups, with which pictures and in which order it shows them."""

from __future__ import annotations

import builtins
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import thumbnails

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
# The name of a file, without "plot_".
GROUPS = {
    "Tables of numbers": ["sparse_gp", "tabular", "many_rows"],
    "Dynamics of robots": ["learn_dynamics", "any_robot", "nominal_dynamics", "link_gravity", "calibrate_simulator"],
    "Prediction and control": ["rollout", "online", "swing_up", "acrobot", "crocoddyl"],
    "Real arms": ["real_arm", "payload", "tracking"],
}
OTHERS = "More examples"  # of no group
ORDER = [story for stories in GROUPS.values() for story in stories]


class Order:
    """A key to sort the examples of a folder by."""

    def __init__(self, folder: str):
        self.folder = folder

    def __call__(self, name: str) -> tuple[int, str]:
        """Place an example by the name of its file."""
        story = Path(name).stem.removeprefix("plot_")
        return ORDER.index(story) if story in ORDER else len(ORDER), story


def arguments(_: dict[str, Any], script: dict[str, Any]) -> list[str]:
    """Keep what an example writes out of its folder, where it has an option for that."""
    if "--output" not in Path(script["src_file"]).read_text(encoding="utf-8"):
        return []
    return ["--output", "../docs/_build/examples"]  # from the examples' folder, where they run; it is printed


def as_a_script(_: dict[str, Any], name: str) -> None:
    """Let examples know where they are, as scripts do: sphinx-gallery gives them no ``__file__``."""
    builtins.__file__ = str(DOCS.parent / "examples" / name)


def grouped(text: str) -> str:
    """Put a heading above each group of the gallery's thumbnails."""
    opened = '.. raw:: html\n\n    <div class="sphx-glr-thumbnails">\n\n.. thumbnail-parent-div-open\n\n'
    closed = ".. thumbnail-parent-div-close\n\n.. raw:: html\n\n    </div>\n\n"
    before, _, rest = text.partition(opened)
    inside, found, after = rest.partition(closed)
    if not found:
        raise ValueError("the index of the gallery is not what sphinx-gallery used to write")
    group_of = {story: group for group, stories in GROUPS.items() for story in stories}
    groups: dict[str, list[str]] = {group: [] for group in (*GROUPS, OTHERS)}
    for part in re.split(r'(?=\.\. raw:: html\n\n    <div class="sphx-glr-thumbcontainer")', inside):
        if name := re.search(r":doc:`/auto_examples/plot_(\w+)`", part):
            groups[group_of.get(name[1], OTHERS)].append(part)
    sections = []
    for group, parts in groups.items():
        if parts:
            label = f".. _gallery-{group.lower().replace(' ', '-')}:"
            sections.append(f"{label}\n\n{group}\n{'-' * len(group)}\n\n{opened}{''.join(parts)}{closed}")
    return before + "\n".join(sections) + after


def group_gallery(app: Sphinx) -> None:
    """Group the index of the gallery, after sphinx-gallery has written it."""
    index = Path(app.srcdir, "auto_examples", "index.rst")
    index.write_text(grouped(index.read_text(encoding="utf-8")), encoding="utf-8")
    thumbnails.put(index.with_name("images") / "thumb")


def setup(app: Sphinx) -> dict[str, bool]:
    """Group the gallery before Sphinx looks for pages."""
    app.connect("builder-inited", group_gallery, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
