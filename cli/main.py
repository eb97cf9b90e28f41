"""The `zencell` command: runs, inspects and commands work cells.

Each group of verbs is one file in this folder; heavy modules are imported when a verb is called.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import typer

from cli import (
    bringup,
    calibrate,
    catalogue,
    checks,
    choices,
    commands,
    node,
    options,
    recording,
    robot,
    secure,
    top,
    topic,
    verbs,
)
from cli.options import CommandGroup
from common.errors import RequestFailed, ZencellError
from common.terminal import echo, printable
from tools import io_verbs
from tools.payload import verbs as payload
from tools.teleoperation.verbs import VERBS as TELEOPERATION

built = functools.cache(lambda app, _applications: typer.main.get_command(app))  # once for all commands of a process
NO_HOME = "Could not determine home directory."  # pathlib's error for ~NAME/...
EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130


class CommandLine(CommandGroup):
    """CommandGroup that prints errors as one line: exit code 1 for failures, 2 for bad input, 130 for Ctrl-C."""

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        """Run the verb in the process's arguments and end the process with its exit code."""
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _leave(self.execute(sys.argv[1:]))

    def execute(self, arguments: Sequence[str]) -> int:
        """Run a verb, print its error if it fails, and return the exit code."""
        choices.prepare()
        try:
            of_applications.take_own(arguments)
            command, given = built(self, len(of_applications.known)), options.with_optional_values(arguments)
            code = command(given, standalone_mode=False, prog_name="zencell", obj=verbs.CommandShell())
        except typer.TyperException as error:
            code = _fail(_with_choices(error), error.exit_code)
        except RequestFailed as error:
            code = _fail(printable(error), EXIT_FAILED)  # the text comes from another process
        except ZencellError as error:
            code = _fail(str(error), getattr(error, "exit_code", EXIT_BAD_INPUT))
        except (KeyboardInterrupt, typer.Abort):
            code = EXIT_INTERRUPTED
        except BrokenPipeError:  # as in `zencell topic echo ... | head`
            code = EXIT_FAILED
        except OSError as error:  # for example a file of another user
            if error.strerror is None:  # not from the operating system
                raise
            code = _fail(f"{error.filename}: {error.strerror}" if error.filename else error.strerror, EXIT_FAILED)
        except RuntimeError as error:
            if str(error) != NO_HOME:
                raise
            code = _fail("a path begins with ~ and a user name without a home folder", EXIT_BAD_INPUT)
        return code if isinstance(code, int) else 0


def _with_choices(error: typer.TyperException) -> str:
    """Return the error text; for an unknown verb with the choices."""
    message = error.format_message()
    verbs_there = getattr(getattr(getattr(error, "ctx", None), "command", None), "commands", {})
    return f"{message} choices: {', '.join(verbs_there)}" if message.startswith("No such command") else message


def _fail(message: str, code: int) -> int:
    echo(f"zencell: {message}", err=True)
    return code


def _leave(code: int) -> NoReturn:
    """End the process without waiting for threads that are still in foreign code, such as one that connects."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # the reader has closed the pipe
            stream.flush()
    os._exit(code)


app = CommandLine(
    "Robot work cells as a mesh of processes over Zenoh.",
    add_completion=False,  # the options below take the name of the shell
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.callback()(choices.root)
of_applications = verbs.ApplicationVerbs(app, {"task": commands.task, "robot": robot.app}, bringup.run, last="chaos")
app.command()(bringup.run)
app.command()(bringup.up)
app.command()(catalogue.new)
app.command()(catalogue.cells)
app.command()(catalogue.services)
app.command()(catalogue.service)
app.command()(top.top)
app.add_typer(topic.app, name="topic")
app.command(context_settings={"ignore_unknown_options": True})(commands.call)
app.add_typer(node.app, name="node")
app.add_typer(node.param, name="param")
app.add_typer(topic.tf, name="tf")
app.command()(node.graph)
app.command()(node.schema)
app.add_typer(commands.task, name="task")
app.add_typer(commands.world, name="world")
app.add_typer(commands.scene, name="scene")
of_applications.take_verbs(io_verbs.VERBS)
of_applications.take_verbs(payload.VERBS)
of_applications.take_all()
app.add_typer(robot.app, name="robot")
app.add_typer(calibrate.app, name="calibrate")
of_applications.take_verbs(TELEOPERATION)
app.command("record")(recording.record_)
app.command()(recording.info)
app.command("play")(recording.play_)
app.command()(recording.recover)
app.command()(recording.report)
app.command()(recording.export)
app.add_typer(secure.app, name="secure")
app.add_typer(secure.router, name="router")
app.command()(checks.simulate)
app.command()(checks.check)
app.command()(checks.doctor)


if __name__ == "__main__":
    app()
