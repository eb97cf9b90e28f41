"""Received text cannot control a terminal or the page."""

import json
import logging
import re
from collections.abc import Callable
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from cli.session.screens import Content, PlainScreen, render
from cli.top import services_table, topics_table
from common.client.monitor import ServiceRow, TopicRow
from common.messages import ServiceStatus
from common.process.log import log_to_stderr
from common.terminal import echo, printable
from page import markup

ROOT = Path(__file__).parents[2]
EVIL = "a\x1b]0;owned\x07\r\x9b2J\u202eb\u2028\x7f\ud800[/x][red]\nERROR router: forged"
CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u202e\ud800]")


def drawn(table: object) -> str:
    console = Console(file=StringIO(), width=400)
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_control_characters_are_escaped_as_in_json() -> None:
    assert printable("a\x1b[2J\nb") == "a\\u001b[2J\\u000ab"
    assert json.loads(f'"{printable(EVIL)}"') == EVIL
    assert printable("Ω ü 球 – [x]") == "Ω ü 球 – [x]"


@pytest.mark.parametrize("show", [
    lambda: drawn(services_table([ServiceRow(EVIL, "ready", restarts=0)])),
    lambda: drawn(topics_table([TopicRow(EVIL, 1.0, 1.0, 1, None, None)])),
    lambda: drawn(render(Content([ServiceStatus(name="camera", state="ready")], {"camera": (EVIL, 1.0)}, EVIL))),
    lambda: markup.text(EVIL),
], ids=["top: a service", "top: a topic", "the live table", "the page"])
def test_received_text_is_shown_without_control_characters(show: Callable[[], str]) -> None:
    text = show()
    assert not CONTROL.search(text)
    assert "[/x][red]" in text


def test_line_of_a_process_stays_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    PlainScreen().line("camera", EVIL)
    PlainScreen().progress(EVIL)
    echo(EVIL, err=True)
    lines = capsys.readouterr().err.splitlines()
    assert not CONTROL.search("".join(lines))
    assert [line.startswith("ERROR") for line in lines] == [False, False, False, True], "our own text may have two"


def test_log_line_cannot_be_forged(capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    try:
        log_to_stderr("planner", as_json=False)
        try:
            raise ValueError(EVIL)
        except ValueError:
            logging.getLogger("test").exception("refused: %s", EVIL)
    finally:
        root.handlers[:], root.level = before
        logging.captureWarnings(False)
    log = capsys.readouterr().err
    assert not CONTROL.search(log)
    assert "ERROR router" not in log.splitlines()[1]


def test_only_the_terminal_module_prints() -> None:
    product = ("cli", "common", "services", "page", "recording", "tools", "lab", "security", "drivers", "applications")
    files = [path for folder in product for path in (ROOT / folder).rglob("*.py")]
    assert [p.name for p in files if re.search(r"\b(typer|click)\.s?echo\(", p.read_text())] == ["terminal.py"]
