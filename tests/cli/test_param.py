"""`zencell param`: parameters of a running cell, and files of them that are read back."""

import asyncio
import importlib
import json
from typing import Any

import pytest
import yaml

from common.client import parameters
from common.config import load_cell, service_config
from common.errors import RequestFailed, RequestTimeout
from common.messages import Parameter, ParameterReply, ParameterRequest
from common.topics import parameters_of
from common.transport.local import LocalNetwork
from tests.harness import Place, ask, place_of

DEFAULTS = ["tuned.rate=20", "tuned.mode=slow", "other.rate=10", "other.mode=fast", "other.spots=[]",
            "motion.velocity_scaling=0.2"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuned")
    (folder / "tuned.yaml").write_text(
        "cell: tuned\nrobot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: last\nservices:\n"
        "  tests.cli.fakes.tuned: {rate: 20}\n  tests.cli.fakes.other: {}\n  tests.cli.fakes.last: {}\n")
    overrides = folder / "overrides.yaml"
    overrides.write_text("services: {tuned: {mode: slow}}\n")
    with place_of(folder, "tuned.yaml", "--set", "@overrides.yaml") as place:
        overrides.unlink()  # it was read once: restarted services do not need it
        yield place


@pytest.fixture(scope="module")
def unchanged(place):
    return place.say("param", "dump", "--all")


@pytest.fixture
def restored(place):
    """Restore the values that a test changes."""
    yield
    place.say("param", "set", *DEFAULTS)


def listed(place: Place, *arguments: str) -> dict[str, Any]:
    found = map(json.loads, place.say("param", "list", *arguments, "--json"))
    return {parameter["path"]: parameter for parameter in found}


def test_list_has_a_line_for_each_parameter_with_its_limits(place):
    lines = {line.split()[0]: line for line in place.say("param", "list")}
    fields = ("rate", "mode", "spots", "file")
    names = [f"services.{service}.{field}" for service in ("other", "tuned") for field in fields]
    assert [name for name in lines if "other" in name or "tuned" in name] == names
    assert lines["services.tuned.rate"].split()[1:3] == ["20.0", "live"]
    assert "0 to 100; turns each second [Hz]" in lines["services.tuned.rate"]
    assert "motion.velocity_scaling" in lines and "restart" in lines["services.tuned.file"]
    assert [line.split()[0] for line in place.say("param", "list", "other")] == names[:4]
    found = listed(place, "tuned")
    mode = found["services.tuned.mode"]
    assert [mode[key] for key in ("service", "value", "default", "choices")] == [
        "tuned", "slow", "fast", ["fast", "slow"]]
    assert found["services.tuned.rate"]["unit"] == "Hz"


@pytest.mark.parametrize(("path", "value"), [
    ("services.tuned.rate", "20.0"), ("tuned.rate", "20.0"), ("motion.velocity_scaling", "0.2"),
    ("other.spots", "[]"), ("tuned.file", "''"),
])
def test_get_prints_the_value_alone(place, path, value):
    assert place.say("param", "get", path) == [value]


@pytest.mark.usefixtures("restored")
def test_set_changes_several_services_and_reports_old_and_new_values(place):
    lines = place.say("param", "set", "tuned.rate=30", "other.spots=[[1, 2]]", "motion.velocity_scaling=0.5",
                      "tuned.mode=slow")
    assert sorted(lines) == [
        "motion.velocity_scaling: 0.2 -> 0.5", "services.other.spots: [] -> [[1.0, 2.0]]",
        "services.tuned.mode: is slow already", "services.tuned.rate: 20.0 -> 30.0"]
    assert place.say("param", "get", "tuned.rate") == ["30.0"]
    line = place.started[0].until("services.tuned.rate: 20.0 -> 30.0 (by ")
    assert "@" in line and line.rstrip(")").rpartition("/")[2].isdigit()


@pytest.mark.parametrize(("arguments", "code", "wanted"), [
    (["set", "tuned.rat=1"], 2, ["unknown parameter 'services.tuned.rat'", "did you mean", "services.tuned.rate"]),
    (["set", "tund.rate=1"], 2, ["unknown parameter 'tund.rate'", "choices:", "tuned...", "motion.velocity_scaling"]),
    (["set", "services.tund.rate=1"], 2, ["unknown service 'tund'", "did you mean 'tuned'?"]),
    (["set", "tuned.mode=medium"], 2, ["services.tuned.mode: 'medium' must be 'fast' or 'slow'"]),
    (["set", "tuned.rate=.nan"], 2, ["services.tuned.rate: nan"]),
    (["set", "@no.yaml"], 2, ["no.yaml", "cannot be read"]),
    (["set", "other.rate=50", "tuned.rate=500", "other.mode=slow"], 2, [
        "services.tuned.rate: 500 must be less than or equal to 100 (number, > 0, <= 100)"]),
    (["set", "tuned.rate=50", "tuned.file=a.txt"], 1, [
        "services.tuned.file: needs a restart: zencell up CELL --set services.tuned.file=a.txt"]),
    (["get", "tuned"], 2, ["unknown parameter 'services.tuned'"]),
    (["list", "tund"], 2, ["unknown service 'tund'", "choices: last, other, tuned"]),
    (["dump", "-o", "no/where.yaml"], 2, ["--output", "no/where.yaml", "cannot be written"]),
])
def test_rejected_change_is_one_line_and_changes_no_service(place, unchanged, arguments, code, wanted):
    done = place.ask("param", *arguments)
    (line,) = done.stderr.splitlines()
    assert (done.returncode, done.stdout) == (code, "")
    assert all(part in line for part in wanted), line
    assert place.say("param", "dump", "--all") == unchanged


@pytest.mark.usefixtures("restored")
def test_dump_has_changed_values_and_those_that_differ_from_the_defaults(place):
    def dump(*arguments: str) -> Any:
        return yaml.safe_load("\n".join(place.say("param", "dump", *arguments)))

    place.say("param", "set", "tuned.rate=10", "other.spots=[[1, 2]]")
    # The cell file has 20: without the 10, though it is the default, reading it back would not restore it.
    other = {"other": {"spots": [[1.0, 2.0]]}}
    assert dump() == {"services": {**other, "tuned": {"rate": 10.0, "mode": "slow"}}}
    assert dump("other") == {"services": other}


@pytest.mark.usefixtures("restored")
def test_dump_is_read_by_a_cell_that_starts_and_by_a_running_one(place, monkeypatch):
    monkeypatch.chdir(place.folder)
    place.say("param", "set", "tuned.rate=10", "other.spots=[[1, 2], [3, 4]]", "motion.velocity_scaling=0.05",
              "other.mode=slow")
    changed = listed(place)
    for options in ([], ["--all"]):
        place.say("param", "dump", *options, "-o", "saved.yaml")
        cell = load_cell("tuned.yaml", ["@saved.yaml"])
        assert cell.motion.velocity_scaling == 0.05
        for name in ("tuned", "other"):
            model = importlib.import_module(f"tests.cli.fakes.{name}").Config
            config = service_config(cell, name, model).model_dump(mode="json")
            for field in ("rate", "mode", "spots", "file"):
                assert config[field] == changed[f"services.{name}.{field}"]["value"]
    place.say("param", "set", *DEFAULTS)
    assert place.say("param", "get", "tuned.rate") == ["20.0"]
    lines = place.say("param", "set", "@saved.yaml")
    assert "services.tuned.rate: 20.0 -> 10.0" in lines and "services.tuned.file: is '' already" in lines
    assert [each["value"] for each in listed(place).values()] == [each["value"] for each in changed.values()]


@pytest.mark.usefixtures("restored")
def test_restarted_service_has_the_values_that_the_cell_started_with(place):
    place.say("param", "set", "other.rate=55", "tuned.rate=55")
    up = place.started[0]
    up.children()["tuned"].kill()
    up.until("tuned is ready again")
    values = [place.say("param", "get", path) for path in ("tuned.rate", "tuned.mode", "other.rate")]
    assert values == [["20.0"], ["slow"], ["55.0"]]


def test_parameter_request_is_described_and_can_be_called(place):
    assert json.loads(*place.say("call", "param/tuned", "{}"))["service"] == "tuned"
    lines = ask(place.folder, "topic", "info", "param/tuned").stdout.splitlines()
    assert lines[0].startswith("param/tuned: ") and "served by: tuned" in lines
    assert lines[-1] == "example: zencell call param/tuned '{}'"


async def test_service_that_does_not_answer_hides_no_other(monkeypatch):
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
    # The token of a request has the name of its service; here one bus is two services.
    monkeypatch.setattr(parameters, "tunable_services", lambda _: asyncio.sleep(0, ["frozen", "tuned"]))
    found = await parameters.listing(bus, None)
    assert [p.path for p in found.parameters["tuned"]] == ["services.tuned.x"]
    with pytest.raises(RequestTimeout, match="param/frozen"):
        found.raise_first()
    assert (await parameters.look_up(bus, ["tuned.x"]))["tuned.x"][1].value == 1
    with pytest.raises(RequestTimeout, match="param/frozen"):
        await parameters.look_up(bus, ["motion.velocity_scaling"])  # may be a parameter of that service
    await bus.close()


async def test_inconsistent_answers_are_rejected(monkeypatch):
    bus, requests = LocalNetwork().bus("tuned"), 0

    async def answer(request: ParameterRequest) -> ParameterReply:
        nonlocal requests
        requests += 1
        paths = () if request.set and not request.dry_run else ("services.tuned.x", "services.tuned.x.y")
        return ParameterReply(service="tuned", parameters=[
            Parameter(path=path, value=1, type="integer", changed=True) for path in paths])

    bus.serve(parameters_of("tuned"), answer)
    await bus.ready()
    monkeypatch.setattr(parameters, "tunable_services", lambda _: asyncio.sleep(0, ["tuned"]))
    with pytest.raises(RequestFailed, match=r"tuned did not report services\.tuned\.x after the change"):
        await parameters.change(bus, {"tuned.x": 2})
    assert requests == 3
    with pytest.raises(RequestFailed, match=r"services\.tuned\.x\.y lies inside the value of another parameter"):
        await parameters.dumped(bus, None)
    await bus.close()
