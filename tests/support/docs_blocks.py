"""The blocks of code in README and docs, and the commands in them.

A block whose line above is `<!-- not run: why -->` is marked with why.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


@dataclass(frozen=True)
class Block:
    """One fenced block of a page."""

    page: str
    line: int
    kind: str
    """What stands behind the fence; "" where nothing does."""
    text: str
    marked: str
    """Why it is not run; "" where it is."""

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks() -> Iterator[Block]:
    """All blocks of all pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        pattern = r"(?:^<!-- not run: (.+?) -->\n)?^```(\w*)\n(.*?)^```$"
        for found in re.finditer(pattern, text, re.MULTILINE | re.DOTALL):
            line = text.count("\n", 0, found.start()) + 1
            yield Block(page.relative_to(ROOT).as_posix(), line, found[2], found[3], found[1] or "")


BLOCKS = list(blocks())


def of_kind(*kinds: str) -> list[Block]:
    return [block for block in BLOCKS if block.kind in kinds and not block.marked]


def commands(block: Block) -> Iterator[list[str]]:
    """The words of each command: of a shell's lines, or of those behind a `$` where output stands between them."""
    lines = block.text.replace("\\\n", " ").splitlines()
    prompted = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    if not prompted and block.kind != "bash":
        return
    for line in prompted or lines:
        lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;<>()")
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, "&&"]:
            if set(word) <= set("&|;"):
                if words:
                    yield words
                words = []
            else:
                words.append(word)
