import io
import json
import logging
import re
import threading

from rich.console import Console

from cli.session.screens import (
    MOST_LINES,
    Content,
    JsonScreen,
    LiveScreen,
    PlainScreen,
    ScreenHandler,
    open_screen,
    render,
)
from common.messages import ServiceStatus

CONTENT = Content(
    [ServiceStatus(name="router", state="ready", pid=12), ServiceStatus(name="vision", state="restarting", restarts=2)],
    {"vision": ("detected_objects", 9.96)},
    "3 of 7 placed - GRASPING ball_4",
)


def test_table_shows_state_restarts_rates_and_progress():
    console = Console(file=io.StringIO(), width=100)
    console.print(render(CONTENT))
    text = console.file.getvalue()
    assert ["vision", "restarting", "2", "detected_objects", "10.0"] in [line.split() for line in text.splitlines()]
    assert "3 of 7 placed - GRASPING ball_4" in text


def test_flood_of_lines_is_drawn_in_batches_and_the_excess_is_counted():
    text = io.StringIO()
    screen = LiveScreen(Console(file=text, width=100, force_terminal=True), lambda: CONTENT)
    screen.note("it is up")
    for number in range(2000):
        screen.line("chatty", f"line {number}")
    screen.close()
    shown = [int(number) for number in re.findall(r"chatty: line (\d+)", text.getvalue())]
    lost = sum(int(number) for number in re.findall(r"(\d+) lines were dropped: too many", text.getvalue()))
    assert shown == sorted(shown) and shown[:MOST_LINES - 1] == list(range(MOST_LINES - 1))
    assert len(shown) + lost == 2000
    assert text.getvalue().count(CONTENT.progress) < 200, "the table is not drawn for each line"
    assert "it is up" in text.getvalue()


def test_table_is_updated_also_during_a_flood_of_lines():
    text, progress, updated = io.StringIO(), ["the first"], threading.Event()

    def content() -> Content:
        if progress[0] in text.getvalue():
            updated.set()
        return Content([], {}, progress[0])

    screen = LiveScreen(Console(file=text, width=100, force_terminal=True), content)
    progress[0] = "the second"
    while not updated.wait(0.01):
        screen.line("chatty", "a line")
    screen.close()
    assert "the second" in text.getvalue()


def test_output_without_a_terminal_has_no_control_characters(capsys):
    screen = open_screen(lambda: CONTENT, log_json=False)  # stderr is no terminal here
    assert isinstance(screen, PlainScreen)
    screen.line("router", "INFO router: listening")
    screen.line("router", "bare")
    screen.progress("3 of 7 placed")
    screen.note("it is up")
    screen.close()
    shown = capsys.readouterr()
    assert shown.err == "INFO router: listening\nrouter: bare\ntask: 3 of 7 placed\n"
    assert shown.out == "it is up\n"


def test_json_lines_are_passed_on_and_others_wrapped(capsys):
    screen = JsonScreen()
    for line in ('{"level": "error", "message": "x", "service": "b", "time": 1.0}', '{"half": ', "plain"):
        screen.line("a", line)
    record = logging.LogRecord("supervisor", logging.WARNING, "", 0, "%s", ("y",), None)
    ScreenHandler(screen, log_json=True).emit(record)
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [(line["service"], line["message"]) for line in lines] == [
        ("b", "x"), ("a", '{"half": '), ("a", "plain"), ("supervisor", "y")]
    assert lines[3]["level"] == "warning"
