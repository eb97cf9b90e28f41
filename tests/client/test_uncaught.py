"""Errors of the client that a script does not catch."""

from __future__ import annotations

import sys

import pytest

from common.client import uncaught

ERROR = 'from zencell import Cell\nCell("panda", owner="a\\nb")\n'


@pytest.mark.parametrize(("script", "line"), [
    (ERROR, "script.py:2: ConfigError: "),
    ("from common.errors import ZencellError\nraise ZencellError('mine')", "script.py:2: ZencellError: mine"),
    ("1 / 0", ""), ("raise KeyboardInterrupt", ""),
    ("from common.client import task\ntask.find_application = None\ntask.TaskControl(None, '').topic", ""),
])
def test_client_errors_are_one_line_with_the_line_of_the_script(script: str, line: str, capsys) -> None:
    try:
        exec(compile(script, "script.py", "exec"), {})
    except BaseException as error:
        trace = error.__traceback__
        assert trace is not None
        uncaught._report(type(error), error, trace.tb_next)
    shown = capsys.readouterr().err
    assert (shown.startswith(line) and shown.count("\n") == 1) if line else "Traceback" in shown


def test_hook_of_another_program_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "excepthook", print)
    uncaught.install()
    assert sys.excepthook is print
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    uncaught.install()
    assert sys.excepthook is uncaught._report
