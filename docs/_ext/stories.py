"""How the gallery runs the examples, and in which order it shows them."""

import builtins
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
# From the shortest story to the longest; the name of a file, without "plot_". New ones come last.
ORDER = ["sparse_gp", "tabular", "learn_dynamics", "rollout", "link_gravity", "nominal_dynamics", "any_robot"]
ORDER += ["online", "swing_up", "crocoddyl", "real_arm", "payload", "tracking"]


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
