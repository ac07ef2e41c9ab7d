"""The code in the pages: found, run in the order of its page, and compared with the output that stands below it.

In a page's Markdown a fence ``python`` is code; a fence ``text`` right behind it is what it prints.
"""

import re
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from itertools import zip_longest
from pathlib import Path
from typing import Any

_FENCE = re.compile(r"^(?P<fence>```+)(?P<info>[^\n`]*)\n(?P<body>.*?)^(?P=fence)[ ]*$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"[-+]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Block:
    """A fence of a page.

    Attributes
    ----------
    language, body : str
    line : int
        Of the page, from 1.
    output : str or None
        What stands right below as ``text``.
    """

    language: str
    body: str
    line: int
    output: str | None = None


def blocks_of(text: str) -> Iterator[Block]:
    """Find the code of a page, each with its output."""
    found = list(_FENCE.finditer(text))
    for fence, following in zip_longest(found, found[1:]):
        info = fence["info"].strip()
        has_output = (
            following is not None
            and following["info"].strip() == "text"
            and not text[fence.end() : following.start()].strip()
        )
        output = following["body"] if has_output else None
        yield Block(info, fence["body"], text.count("\n", 0, fence.start()) + 1, output)


def run(page: Path, folder: Path) -> Iterator[tuple[Block, str]]:
    """Run the Python of a page in one namespace and in a folder, and give what each block printed."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks_of(page.read_text(encoding="utf-8")):
        if block.language == "python":
            printed = StringIO()
            code = compile("\n" * block.line + block.body, str(page), "exec")
            with chdir(folder), redirect_stdout(printed):
                exec(code, names)
            yield block, printed.getvalue()


def differences(printed: str, expected: str, share: float = 0.02) -> list[str]:
    """Compare what was printed with what a page says, numbers up to a share of them and to their last digit."""
    ours, theirs = (re.sub(r"\s+", " ", text).strip() for text in (printed, expected))
    if _NUMBER.sub("#", ours) != _NUMBER.sub("#", theirs):
        return [f"printed: {ours}", f"the page says: {theirs}"]
    pairs = zip(_NUMBER.findall(ours), _NUMBER.findall(theirs), strict=True)
    return [f"{one} for {other}" for one, other in pairs if not _near(one, other, share)]


def _near(one: str, other: str, share: float) -> bool:
    ours, theirs = (float(number.replace(",", "")) for number in (one, other))
    digits = re.search(r"\.(\d+)", other)
    last = 10.0 ** -len(digits[1]) if digits and "e" not in other else 0.0
    return abs(ours - theirs) <= max(share * abs(theirs), 1.5 * last)
