"""Hooks of `mkdocs build` (mkdocs.yml): adapt GitHub's Markdown and links to files outside of docs/."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import Abort
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"\[([^\]]*)\]\(((?:\.\./)+[^)#\s]+)(?:#[^)]*)?\)")
FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)

FOREIGN = re.compile(r"""<(?:script|img|iframe)\b[^>]*\bsrc=["']?(?:https?:)?//[^>]*>"""
                     r"""|<link\b(?=[^>]*\brel=["']?(?:stylesheet|preload|preconnect|icon))[^>]*\bhref=["']?(?:https?:)?//[^>]*>""")


def on_post_build(config: Any) -> None:
    """Fail if a page would load anything from another host.

    Raises:
        Abort: with the page and the element.
    """
    for page in sorted(Path(config.site_dir).rglob("*.html")):
        if found := FOREIGN.search(page.read_text(encoding="utf-8")):
            raise Abort(f"{page.name} loads from another host: {found[0]}")


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Adapt a page to Python-Markdown; linked files outside of docs/ become text files of the site."""
    folder = posixpath.dirname(page.file.src_uri)
    parts, end = [], 0
    for fence in FENCE.finditer(markdown):
        parts += [_prose(markdown[end:fence.start()], folder, config, files), fence[0]]
        end = fence.end()
    return "".join([*parts, _prose(markdown[end:], folder, config, files)])


def _prose(text: str, folder: str, config: Any, files: Any) -> str:
    text = re.sub(r"^( +)(?=\S)", r"\1\1", text, flags=re.MULTILINE)  # nested lists: two blanks here, four in Python-Markdown
    return LINK.sub(lambda link: _shown(link, folder, config, files), text)


def _shown(link: re.Match[str], folder: str, config: Any, files: Any) -> str:
    """Keep a link within docs/, point one to another file to its copy in the site, and turn one to a folder into text."""
    target = posixpath.normpath(posixpath.join("docs", folder, link[2]))
    if target.startswith("docs/") or not (ROOT / target).exists():
        return link[0]  # mkdocs reports a dead link
    if (ROOT / target).is_dir():
        return link[1]
    uri = f"files/{target}.txt"
    if files.get_file_from_path(uri) is None:
        files.append(File.generated(config, uri, content=(ROOT / target).read_text(encoding="utf-8")))
    return f"[{link[1]}]({posixpath.relpath(uri, folder or '.')})"
