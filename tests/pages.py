"""Commands, files and expected output in pages of the documentation."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
STARTS = (".venv/bin/", "make ", "zencell ", "zenoh ", "python ", "PYTHONPATH=", "xacro ")


@dataclass(frozen=True)
class Step:
    """A command and its expected output, in which `...` matches anything."""

    line: str
    shows: str = ""

    def shown_in(self, text: str) -> bool:
        """Return whether a text contains the expected output."""
        parts = [re.escape(part.strip()) for part in re.split(r"\.\.\.(?!\.)", self.shows)]
        return re.search(r"[\s\S]*?".join(parts), text) is not None


def text_of(page: str) -> str:
    """Return the text of a page by its path in the project."""
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(text: str, language: str = r"\w*") -> list[tuple[str, str]]:
    """Return (language, text) of the code blocks of a page."""
    return re.findall(rf"^```({language})\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def files(text: str) -> dict[str, str]:
    """Return by name the files that a page asks its reader to write."""
    return dict(re.findall(r"^`([\w./]+)`:\n\n```\w+\n(.*?)^```$", text, re.DOTALL | re.MULTILINE))


def steps(text: str, language: str = r"\w*") -> list[Step]:
    """Return the commands of a page in order, without comments; a block `text` below a command is its output."""
    found: list[Step] = []
    for kind, block in blocks(text):
        if kind == "text" and found:
            found[-1] = Step(found[-1].line, block.strip())
        elif re.fullmatch(language, kind):
            lines = [re.sub(r"\s+# .*$", "", line).strip() for line in block.splitlines()]
            found += [Step(line) for line in lines if line.startswith(STARTS)]
    return found


def lines(text: str, language: str = r"\w*") -> list[str]:
    """Return the command lines of a page."""
    return [step.line for step in steps(text, language)]


def prose(text: str) -> str:
    """Return a page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(text: str) -> set[str]:
    """Return the link anchors of the headings of a page."""
    headings = re.findall(r"^#{1,6} (.*)$", prose(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}
