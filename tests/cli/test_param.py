"""`zencell param`: parameters of a cell that is up, and files of them that are given back."""

from __future__ import annotations

import asyncio
import importlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from cli.main import app
from common.client import parameters
from common.config import load_cell, service_config
from common.errors import RequestFailed, RequestTimeout
from common.messages import Parameter, ParameterReply, ParameterRequest
from common.topics import parameters_of
from common.transport.local import LocalNetwork
from tests.cli.conftest import make_folder
from tests.harness import Zencell, free_domain

TUNED = '''"""Has parameters."""
import asyncio
from typing import Literal
from pydantic import Field
from common import topics
from common.config import Motion, Parameters, Tunable

from common.process.service import main

class Config(Parameters):
    """What it does."""
    motion: Motion
    rate: Tunable[float] = Field(10.0, gt=0, le=100, description="turns each second [Hz]")
    mode: Tunable[Literal["fast", "slow"]] = "fast"
    spots: Tunable[list[tuple[float, float]]] = Field([], description="places [m]")
    file: str = Field("", description="read at the start")

async def run(bus, config):
    await bus.ready()
    await asyncio.Event().wait()

if __name__ == "__main__":
    main(run, Config)
'''
OTHER = TUNED.replace("    motion: Motion\n", "")
CELL = """cell: tuned
robot: panda
world: balls
pipeline: cartesian_ompl
task: last
services:
  fakes.tuned: {rate: 20}
  fakes.other: {}
  fakes.last: {}
"""


class Person:
    """Somebody who stands in a folder beside a cell that is up."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder, self.domain = folder, domain
        self.capture: pytest.CaptureFixture[str]

    def __call__(self, *arguments: str) -> tuple[int, list[str], str]:
        """Exit code, lines on stdout, and what is on stderr."""
        code = app.execute([*arguments, "--domain", str(self.domain)])
        shown = self.capture.readouterr()
        return code, shown.out.splitlines(), shown.err.strip()

    def param(self, *arguments: str) -> list[str]:
        code, lines, error = self("param", *arguments)
        assert (code, error) == (0, ""), error
        return lines

    def refused(self, *arguments: str) -> tuple[int, str]:
        before = self.param("dump", "--all")
        code, lines, error = self("param", *arguments)
        assert lines == [] and len(error.splitlines()) == 1
        assert self.param("dump", "--all") == before
        return code, error.removeprefix("zencell: ")


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Person, Zencell]]:
    folder = make_folder(tmp_path_factory.mktemp("tuned"))
    (folder / "fakes" / "tuned.py").write_text(TUNED)
    (folder / "fakes" / "other.py").write_text(OTHER)
    (folder / "tuned.yaml").write_text(CELL)
    given = folder / "given.yaml"
    given.write_text("services: {tuned: {mode: slow}}\n")
    up = Zencell(folder, free_domain(), "up", "tuned.yaml", "--set", "@given.yaml")
    try:
        up.until("is up at")
        given.unlink()  # it was read once: services that are started again do not need it
        yield Person(folder, up.domain), up
    finally:
        up.interrupt()
        assert up.end() == 0


@pytest.fixture
def person(cell: tuple[Person, Zencell], capsys: pytest.CaptureFixture[str],
           monkeypatch: pytest.MonkeyPatch) -> Person:
    person, _ = cell
    person.capture = capsys
    monkeypatch.chdir(person.folder)
    monkeypatch.syspath_prepend(str(person.folder))
    return person


def test_the_list_has_a_line_for_each_parameter_of_each_service(person: Person) -> None:
    lines = person.param("list")
    assert [line.split()[0] for line in lines if "tuned" in line] == [
        f"services.tuned.{name}" for name in ("rate", "mode", "spots", "file")]
    (rate,) = [line for line in lines if line.startswith("services.tuned.rate")]
    assert rate.split()[1:3] == ["20.0", "live"] and "0 to 100; turns each second [Hz]" in rate
    assert any(line.startswith("motion.velocity_scaling") for line in lines)
    (file,) = [line for line in lines if line.startswith("services.tuned.file")]
    assert "restart" in file
    assert [line.split()[0] for line in person.param("list", "other")] == [
        f"services.other.{name}" for name in ("rate", "mode", "spots", "file")]


def test_the_list_is_one_json_object_a_line(person: Person) -> None:
    found = {p["path"]: p for p in map(json.loads, person.param("list", "tuned", "--json"))}
    mode = found["services.tuned.mode"]
    assert (mode["service"], mode["value"], mode["default"], mode["choices"]) == (
        "tuned", "slow", "fast", ["fast", "slow"])
    assert found["services.tuned.rate"]["unit"] == "Hz"


@pytest.mark.parametrize(("path", "value"), [
    ("services.tuned.rate", "20.0"), ("tuned.rate", "20.0"), ("motion.velocity_scaling", "0.2"),
    ("other.spots", "[]"), ("tuned.file", "''"),
])
def test_get_prints_the_value_and_nothing_else(person: Person, path: str, value: str) -> None:
    assert person.param("get", path) == [value]


def test_set_changes_several_services_and_says_from_what_to_what(
    person: Person, cell: tuple[Person, Zencell]
) -> None:
    lines = person.param(
        "set", "tuned.rate=30", "other.spots=[[1, 2]]", "motion.velocity_scaling=0.5", "tuned.mode=slow")
    assert sorted(lines) == [
        "motion.velocity_scaling: 0.2 -> 0.5", "services.other.spots: [] -> [[1.0, 2.0]]",
        "services.tuned.mode: is slow already", "services.tuned.rate: 20.0 -> 30.0"]
    assert person.param("get", "tuned.rate") == ["30.0"]
    said = cell[1].until("services.tuned.rate: 20.0 -> 30.0 (by ")
    assert "@" in said and said.rstrip(")").rpartition("/")[2].isdigit()
    back = person.param("set", "tuned.rate=20", "other.spots=[]", "motion.velocity_scaling=0.2")
    assert "services.tuned.rate: 30.0 -> 20.0" in back


def test_a_service_that_would_refuse_keeps_the_others_as_they_are(person: Person) -> None:
    code, said = person.refused("set", "other.rate=50", "tuned.rate=500", "other.mode=slow")
    assert code == 2
    assert said == "services.tuned.rate: 500 must be less than or equal to 100 (number, > 0, <= 100)"


@pytest.mark.parametrize(("arguments", "wanted"), [
    (["set", "tuned.rat=1"], ["unknown parameter 'services.tuned.rat'", "did you mean", "services.tuned.rate"]),
    (["set", "tund.rate=1"], ["unknown parameter 'tund.rate'", "choices:", "tuned...", "motion.velocity_scaling"]),
    (["set", "services.tund.rate=1"], ["unknown service 'tund'", "did you mean 'tuned'?"]),
    (["set", "tuned.mode=medium"], ["services.tuned.mode: 'medium' must be 'fast' or 'slow'"]),
    (["set", "tuned.rate"], ["'tuned.rate'", "must be PATH=VALUE"]),
    (["set", "tuned.rate=[1"], ["'[1'", "is not a YAML value"]),
    (["set", "tuned.rate=.nan"], ["services.tuned.rate: nan"]),
    (["set", "@no.yaml"], ["no.yaml", "cannot be read"]),
    (["get", "tuned"], ["unknown parameter 'services.tuned'"]),
    (["list", "tund"], ["unknown service 'tund'", "choices: last, other, tuned"]),
    (["dump", "-o", "no/where.yaml"], ["--output", "no/where.yaml", "cannot be written"]),
])
def test_bad_input_is_one_line_with_the_choices(person: Person, arguments: list[str], wanted: list[str]) -> None:
    code, said = person.refused(*arguments)
    assert code == 2
    for part in wanted:
        assert part in said


def test_what_needs_a_restart_fails_and_says_how(person: Person) -> None:
    code, said = person.refused("set", "tuned.rate=50", "tuned.file=a.txt")
    assert code == 1
    assert said == "services.tuned.file: needs a restart: zencell up CELL --set services.tuned.file=a.txt"


def test_a_dump_is_what_differs_from_the_defaults_or_was_changed(person: Person) -> None:
    assert yaml.safe_load("\n".join(person.param("dump"))) == {"services": {"tuned": {"rate": 20.0, "mode": "slow"}}}
    person.param("set", "tuned.rate=10", "other.spots=[[1, 2]]")
    tree = yaml.safe_load("\n".join(person.param("dump")))
    # The cell file says 20: without the 10, though it is the default, this would not come back.
    assert tree == {"services": {"other": {"spots": [[1.0, 2.0]]}, "tuned": {"rate": 10.0, "mode": "slow"}}}
    assert yaml.safe_load("\n".join(person.param("dump", "other"))) == {"services": {"other": {"spots": [[1.0, 2.0]]}}}
    person.param("set", "tuned.rate=20", "other.spots=[]")


def test_a_dump_reads_back_into_a_cell_and_into_one_that_is_up(person: Person) -> None:
    kept = str(person.folder / "kept.yaml")
    person.param("dump", "--all", "-o", str(person.folder / "before.yaml"))
    changes = ["tuned.rate=10", "other.spots=[[1, 2], [3, 4]]", "motion.velocity_scaling=0.05", "other.mode=slow"]
    person.param("set", *changes)
    everything = [json.loads(line) for line in person.param("list", "--json")]
    for options in ([], ["--all"]):
        person.param("dump", *options, "-o", kept)
        cell = load_cell("tuned.yaml", [f"@{kept}"])
        assert cell.motion.velocity_scaling == 0.05
        for name in ("tuned", "other"):
            config = service_config(cell, name, importlib.import_module(f"fakes.{name}").Config).model_dump(mode="json")
            for parameter in everything:
                if parameter["path"].startswith(f"services.{name}."):
                    assert config[parameter["path"].split(".")[2]] == parameter["value"]
    person.param("set", f"@{person.folder / 'before.yaml'}")
    assert person.param("get", "tuned.rate") == ["20.0"]
    said = person.param("set", f"@{kept}")
    assert "services.tuned.rate: 20.0 -> 10.0" in said and "services.tuned.file: is '' already" in said
    assert [json.loads(line)["value"] for line in person.param("list", "--json")] == [p["value"] for p in everything]
    person.param("set", f"@{person.folder / 'before.yaml'}")


def test_a_service_that_is_started_again_begins_as_the_cell_was_brought_up(
    person: Person, cell: tuple[Person, Zencell]
) -> None:
    person.param("set", "other.rate=55", "tuned.rate=55")
    cell[1].children()["tuned"].kill()
    cell[1].until("tuned is ready again")
    assert (person.param("get", "tuned.rate"), person.param("get", "tuned.mode")) == (["20.0"], ["slow"])
    assert person.param("get", "other.rate") == ["55.0"]
    person.param("set", "other.rate=10")


def test_the_request_itself_can_be_called_and_looked_at(person: Person) -> None:
    code, (line,), _ = person("call", "param/tuned", "{}")
    assert code == 0 and json.loads(line)["service"] == "tuned"
    assert app.execute(["topic", "info", "param/tuned"]) == 0
    lines = person.capture.readouterr().out.splitlines()
    assert lines[0].startswith("param/tuned: ") and "served by: tuned" in lines
    assert lines[-1] == "example: zencell call param/tuned '{}'"


async def test_a_service_that_does_not_answer_hides_nothing_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameters, "TIMEOUT", 0.05)
    bus = LocalNetwork().bus("tuned")

    async def answer(request: ParameterRequest) -> ParameterReply:
        return ParameterReply(service="tuned", parameters=[Parameter(path="services.tuned.x", value=1, type="integer")])

    async def never(request: ParameterRequest) -> ParameterReply:
        await asyncio.Event().wait()
        raise AssertionError

    bus.serve(parameters_of("frozen"), never)
    bus.serve(parameters_of("tuned"), answer)
    await bus.ready()
    # The token of what is served is named by who serves it; here one bus stands for two services.
    monkeypatch.setattr(parameters, "tunable_services", lambda _: asyncio.sleep(0, ["frozen", "tuned"]))
    found = await parameters.listing(bus, None)
    assert [p.path for p in found.parameters["tuned"]] == ["services.tuned.x"]
    with pytest.raises(RequestTimeout, match="param/frozen"):
        found.raise_first()
    assert (await parameters.look_up(bus, ["tuned.x"]))["tuned.x"][1].value == 1
    with pytest.raises(RequestTimeout, match="param/frozen"):
        await parameters.look_up(bus, ["motion.velocity_scaling"])  # may be one of that service
    await bus.close()


async def test_answers_that_make_no_sense_are_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, asked = LocalNetwork().bus("tuned"), 0

    async def answer(request: ParameterRequest) -> ParameterReply:
        nonlocal asked
        asked += 1
        paths = () if request.set and not request.dry_run else ("services.tuned.x", "services.tuned.x.y")
        return ParameterReply(service="tuned", parameters=[
            Parameter(path=path, value=1, type="integer", changed=True) for path in paths])

    bus.serve(parameters_of("tuned"), answer)
    await bus.ready()
    monkeypatch.setattr(parameters, "tunable_services", lambda _: asyncio.sleep(0, ["tuned"]))
    with pytest.raises(RequestFailed, match=r"tuned did not report services\.tuned\.x after the change"):
        await parameters.change(bus, {"tuned.x": 2})
    assert asked == 3
    with pytest.raises(RequestFailed, match=r"services\.tuned\.x\.y lies inside the value of another parameter"):
        await parameters.dumped(bus, None)
    await bus.close()


def test_where_no_cell_is_up_it_says_how_to_start_one(
    capsys: pytest.CaptureFixture[str], domain: int
) -> None:
    assert app.execute(["param", "list", "--domain", str(domain)]) == 1
    assert "zencell up panda" in capsys.readouterr().err
