"""Descriptions from others: their XML within bounds, and what a file is that is no description."""

from __future__ import annotations

import unicodedata
import xml.etree.ElementTree as ET
from pathlib import Path
from xml.parsers import expat

from common.errors import ConfigError
from common.robot.description_values import check_values

MAX_BYTES = 50_000_000
MAX_ELEMENTS = 200_000
MAX_DEPTH = 100  # of elements in each other
MAX_NAME = 200  # characters
MAX_LINKS = 400
LFS = "is a pointer of Git LFS, not the file itself: run `git lfs pull` in its clone"
_KINDS = ((b"version https://git-lfs", LFS), (b"\x1f\x8b", "is compressed (gzip): unpack it first"),
          (b"<!doctype html", "is a page of a web site, not the file: download the raw file"),
          (b"<html", "is a page of a web site, not the file: download the raw file"))


def fault_of(path: Path) -> str:
    """Return why a file cannot be what its name says, such as a pointer of Git LFS; empty if it may be."""
    with path.open("rb") as file:
        head = file.read(512).removeprefix(b"\xef\xbb\xbf").lstrip()
    if not head:
        return "is empty"
    return next((fault for start, fault in _KINDS if head[:len(start)].lower() == start), "")


def read_xml(field: str, path: Path) -> ET.Element:
    """Return the elements of a description; without prefixes of namespaces.

    Raises:
        ConfigError: the file cannot be read, exceeds the bounds, declares entities, or contains names with line breaks,
            control or invisible characters, duplicate names, or unusable numbers.
    """
    try:
        fault = fault_of(path)
        if not fault and path.stat().st_size > MAX_BYTES:
            fault = f"has more than {MAX_BYTES // 10**6} MB"
        data = b"" if fault else path.read_bytes()
    except OSError as error:
        fault = f"cannot be read: {error.strerror}"
    if fault:
        raise ConfigError(field, str(path), fault)
    return parse_xml(field, str(path), data)


def parse_xml(field: str, source: str, data: bytes) -> ET.Element:
    """Return the elements of a description's text; `source` names it in errors, which are those of `read_xml`."""
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    depth = count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MAX_DEPTH or count > MAX_ELEMENTS:
            raise ConfigError(field, source, f"has more than {MAX_ELEMENTS} elements" if count > MAX_ELEMENTS else
                              f"has more than {MAX_DEPTH} elements nested in each other")
        builder.start(tag.rpartition(":")[2], {k: v for k, v in attributes.items() if ":" not in k})

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag.rpartition(":")[2])

    def entity(*_: object) -> None:
        raise ConfigError(field, source, "declares XML entities, which descriptions do not need")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    parser.EntityDeclHandler = entity
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # also an unknown encoding
        raise ConfigError(field, source, f"does not parse: {error}") from None
    found = builder.close()
    if found.tag != "robot":
        raise ConfigError(field, source, f"does not parse: its root is <{found.tag[:MAX_NAME]}>, not <robot>")
    _check_names(field, source, found)
    check_values(field, source, found)
    return found


def _check_names(field: str, source: str, root: ET.Element) -> None:
    if (links := len(root.findall("link"))) > MAX_LINKS:
        raise ConfigError(field, source, f"has {links} links; at most {MAX_LINKS} are supported")
    for element in root.iter():
        for key, value in element.attrib.items():
            # Names are written into robot files, comments and messages.
            if key in ("name", "link", "joint", "link1", "link2", "group", "base_link", "tip_link", "child_link"):
                if len(value) > MAX_NAME:
                    raise ConfigError(field, source, f"has a name of {len(value)} characters: {value[:20]!r}...")
                if bad := next((c for c in value if unicodedata.category(c)[0] == "C" or c in "\u2028\u2029"), None):
                    raise ConfigError(field, source, f"has a name with the character U+{ord(bad):04X}: {value!a}")
