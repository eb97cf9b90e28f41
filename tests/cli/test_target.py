"""The options that say where a verb is done, which each verb has by one parameter."""

from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from cli import options
from cli.main import app as zencell
from cli.target import RUNNING, CellTarget, CommandGroup

seen: list[tuple[CellTarget, str]] = []
app = CommandGroup("CommandGroup.")


@app.command()
def ask(what: str, at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Ask."""
    seen.append((at, what))


@app.command()
def tell(what: Annotated[str, typer.Argument(help="this")]) -> None:
    """Tell, at no place."""


@pytest.mark.parametrize(("arguments", "place"), [
    ([], RUNNING),
    (["--cell", "a"], CellTarget("a")),
    (["--connect", "tcp/b:1", "--cell", "a", "--domain", "7"], CellTarget("a", "7", "tcp/b:1")),
])
def test_a_verb_is_told_its_place(arguments: list[str], place: CellTarget) -> None:
    seen.clear()
    assert CliRunner().invoke(app, ["ask", "something", *arguments]).exit_code == 0
    assert seen == [(place, "something")]


def test_a_verb_without_a_place_has_no_such_options() -> None:
    assert CliRunner().invoke(app, ["tell", "something", "--domain", "7"]).exit_code == 2


def test_where_it_is_comes_last_among_the_options_and_cell_where_the_place_stands() -> None:
    group = typer.main.get_command(app)
    names = [parameter.name for parameter in group.commands["ask"].params]  # type: ignore[attr-defined]
    assert names == ["what", "cell", "as_json", "domain", "connect"]


def test_every_verb_of_the_project_with_a_domain_has_a_router_to_choose() -> None:
    def verbs(group: object, name: str) -> list[tuple[str, set[str]]]:
        below = getattr(group, "commands", None)
        if below is None:
            return [(name, {parameter.name for parameter in group.params})]  # type: ignore[attr-defined]
        return [found for part, verb in below.items() for found in verbs(verb, f"{name} {part}")]

    found = [(name, options) for name, options in verbs(typer.main.get_command(zencell), "zencell")
             if "domain" in options]
    assert len(found) > 40
    assert [name for name, options in found if "connect" not in options] == ["zencell router config"]
