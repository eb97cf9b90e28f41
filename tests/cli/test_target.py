"""Options for the router and the cell of a command, which it has by one parameter."""

import pytest
import typer
from typer.testing import CliRunner

from cli import options
from cli.main import app as zencell
from cli.options import RUNNING, CellTarget, CommandGroup

seen: list[tuple[CellTarget, str]] = []
app = CommandGroup("CommandGroup.")


@app.command()
def ask(what: str, at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Ask."""
    seen.append((at, what))


@app.command()
def show(what: str) -> None:
    """Show, without a target."""


@pytest.mark.parametrize(("arguments", "target"), [
    ([], RUNNING),
    (["--cell", "a"], CellTarget("a")),
    (["--connect", "tcp/b:1", "--cell", "a", "--domain", "7"], CellTarget("a", "7", "tcp/b:1")),
])
def test_options_become_the_target(arguments, target):
    seen.clear()
    assert CliRunner().invoke(app, ["ask", "something", *arguments]).exit_code == 0
    assert seen == [(target, "something")]


def test_target_has_options_only_where_it_is_a_parameter_and_they_are_last():
    assert CliRunner().invoke(app, ["show", "something", "--domain", "7"]).exit_code == 2
    group = typer.main.get_command(app)
    names = [parameter.name for parameter in group.commands["ask"].params]
    assert names == ["what", "cell", "as_json", "domain", "connect"]


def test_every_command_with_a_domain_has_an_endpoint():
    def commands(group: object, name: str) -> list[tuple[str, set[str]]]:
        below = getattr(group, "commands", None)
        if below is None:
            return [(name, {parameter.name for parameter in group.params})]
        return [found for part, command in below.items() for found in commands(command, f"{name} {part}")]

    found = commands(typer.main.get_command(zencell), "zencell")
    with_domain = [(name, options) for name, options in found if "domain" in options]
    assert len(with_domain) > 40
    assert [name for name, options in with_domain if "connect" not in options] == ["zencell router config"]
