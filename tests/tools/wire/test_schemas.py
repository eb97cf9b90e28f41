"""The schemas of a cell against what is on its wire, judged by other people's programs only."""

import base64
import copy
import json
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
from jsonschema import Draft7Validator, Draft202012Validator, validators
from mcap.reader import make_reader

from cli.main import app
from common import topics
from common.application import message_class
from common.client.json_codec import message_from_json
from common.config import load_cell
from common.messages.schema import EXAMPLES
from common.supervision.wiring import ServiceWiring
from common.transport.codec import encode
from tools.wire import asyncapi

Payloads = list[tuple[str, bytes]]
HERE = Path(__file__).parent
PACKAGES = ("@msgpack/msgpack@3", "ajv@8", "@asyncapi/specs@6")
# JSON Schema knows no bytes: docs/wire.md says that a validator accepts them where a string is required.
TYPES = Draft202012Validator.TYPE_CHECKER.redefine("string", lambda _, value: isinstance(value, str | bytes))
Validator = validators.extend(Draft202012Validator, type_checker=TYPES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("schema") / "wire"
    assert app.execute(["schema", "panda", "--out", str(made), "--domain", "43"]) == 0
    return made


@pytest.fixture(scope="module")
def document(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "asyncapi.json").read_text())


@pytest.fixture(scope="module")
def schemas(folder: Path) -> dict[str, Any]:
    return {path.stem: json.loads(path.read_text()) for path in (folder / "messages").glob("*.json")}


@pytest.fixture(scope="module")
def payloads(tmp_path_factory: pytest.TempPathFactory) -> Payloads:
    """Return message names and payloads of a simulated run."""
    trace = tmp_path_factory.mktemp("run") / "run.mcap"
    assert app.execute(["simulate", "panda", "--seed", "1", "--limit", "5", "--trace", str(trace)]) == 1  # not done
    with trace.open("rb") as file:
        return [(schema.name, message.data) for schema, _, message in make_reader(file).iter_messages()
                if schema is not None and "." not in schema.name]  # not what the recorder adds


def error_of(schema: Any, payload: bytes) -> str:
    error = next(Validator(schema).iter_errors(msgpack.unpackb(payload)), None)
    return "" if error is None else f"{error.json_path}: {error.message[:200]}"


def test_field_that_messages_leave_out_has_its_default_in_the_schema(schemas: dict[str, Any]) -> None:
    omitting = [found for name in schemas if (found := message_class(name)) is not None and found.omitted_defaults]
    assert len(omitting) > 5
    for model in omitting:
        schema = schemas[model.__name__]
        assert not {*model.omitted_defaults} & {*schema.get("required", [])}, model
        assert all("default" in schema["properties"][name] for name in model.omitted_defaults), model


def test_every_recorded_payload_holds_its_schema(schemas: dict[str, Any], payloads: Payloads) -> None:
    counts = Counter(name for name, _ in payloads)
    assert {"Image", "JointState", "TFMessage", "PlanningScene", "PickPlaceStatus", "JointTrajectory"} <= counts.keys()
    assert min(counts["JointState"], counts["TFMessage"]) > 100
    seen = Counter()
    for name, payload in payloads:
        seen[name] += 1
        if seen[name] <= 20:
            assert error_of(schemas[name], payload) == "", name


@pytest.mark.parametrize("name", EXAMPLES)
def test_documented_example_of_a_request_holds_its_schema(name: str, schemas: dict[str, Any]) -> None:
    request = next(each for each in topics.platform_topics().values() if each.message.__name__ == name)
    payload = encode(message_from_json(request, request.key, json.dumps(EXAMPLES[name])))
    assert error_of(schemas[name], payload) == ""


@pytest.mark.parametrize(("message", "change", "where"), [
    ("JointState", {"position": ["0.1"]}, "$.position[0]"),
    ("JointState", {"colour": 1}, "$"),
    ("JointState", {"header": {"stamp": -1}}, "$.header.stamp"),
    ("Image", {"data": [1, 2, 3]}, "$.data"),
    ("Image", {"width": 0}, "$.width"),
])
def test_schema_refuses_what_the_cell_refuses(
    message: str, change: dict[str, Any], where: str, schemas: dict[str, Any], payloads: Payloads
) -> None:
    first = next(msgpack.unpackb(payload) for name, payload in payloads if name == message)
    assert error_of(schemas[message], msgpack.packb({**first, **change})).startswith(f"{where}:")


def test_schemas_are_valid_and_say_where_bytes_are(schemas: dict[str, Any]) -> None:
    for schema in schemas.values():
        Draft202012Validator.check_schema(schema)
        assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert schemas["Image"]["properties"]["data"]["format"] == "binary"
    assert schemas["Image"]["x-zenoh-encoding"] == "application/msgpack;Image"
    assert schemas["PlanRequest"]["$defs"]["JointGoal"]["properties"]["kind"]["const"] == "joints"


def references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        yield from [value["$ref"]] if isinstance(value.get("$ref"), str) else ()
        for item in value.values():
            yield from references(item)
    elif isinstance(value, list):
        for item in value:
            yield from references(item)


def resolve(document: Any, reference: str) -> Any:
    for part in reference.removeprefix("#/").split("/"):
        document = document[part.replace("~1", "/").replace("~0", "~")]
    return document


def test_references_of_the_document_resolve(document: dict[str, Any]) -> None:
    found = set(references(document))
    assert len(found) > 100
    assert all(resolve(document, each) is not None for each in found)
    for schema in document["components"]["schemas"].values():
        Draft7Validator.check_schema(schema)


def test_document_has_keys_kinds_directions_and_replies(document: dict[str, Any]) -> None:
    channels, operations = document["channels"], document["operations"]
    assert document["servers"]["router"]["host"] == "127.0.0.1:7490"
    joints = channels["joint_states"]
    assert (joints["address"], joints["x-kind"]) == ("panda/joint_states", "stream")
    assert joints["x-written-by"] == ["trajectory_executor"]
    assert operations["send.joint_states"]["action"] == "send" and "receive.joint_states" not in operations
    assert {"send.motion.jog", "receive.motion.jog"} <= operations.keys(), "any client may write it"
    plan = operations["receive.motion.plan"]
    assert plan["messages"] == [{"$ref": "#/channels/motion.plan/messages/PlanRequest"}]
    assert plan["reply"]["messages"] == [{"$ref": f"#/channels/motion.plan/messages/{name}"}
                                         for name in ("PlanResponse", "ErrorReply")]
    assert {name for name, each in operations.items() if "reply" in each} == {
        f"receive.{name}" for name, each in channels.items() if each["x-kind"] == "request"}


def test_keys_of_one_service_have_its_name_as_a_variable(document: dict[str, Any]) -> None:
    names = [entry.name for entry in load_cell("panda").services.values()]
    parameters = document["channels"]["param"]
    assert parameters["address"] == "panda/param/{service}"
    assert parameters["parameters"]["service"]["enum"] == names
    assert document["channels"]["log"]["parameters"]["service"]["enum"] == [*names, "supervisor"]


def test_topic_that_no_service_writes_is_received_by_the_cell() -> None:
    wired = ServiceWiring("arm", "", reads=["motion/jog"], topics={"motion/jog": topics.MOTION_JOG})  # type: ignore[dict-item]
    made = asyncapi.document("tiny", [wired], "tcp/h:1")
    assert [name for name in made["operations"] if "jog" in name] == ["receive.motion.jog"]


def test_without_a_folder_the_document_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert app.execute(["schema", "sort_cubes/cell.yaml"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert app.execute(["schema", str(HERE.parents[2] / "examples/sort_cubes/cell.yaml")]) == 0
    assert json.loads(capsys.readouterr().out)["asyncapi"] == "3.0.0"


def test_folder_that_cannot_be_written_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert app.execute(["schema", "panda", "--out", str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err.startswith("zencell: --out: ")


# --- with packages of npm ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the packages; skip where they cannot be had."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node or npm is not installed")
    made = tmp_path_factory.mktemp("npm")
    (made / "package.json").write_text("{}")
    command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefer-offline", "--fetch-retries=0",
               "--fetch-timeout=10000", *PACKAGES]
    try:
        done = subprocess.run(command, cwd=made, capture_output=True, text=True, check=False, timeout=60)
    except subprocess.TimeoutExpired:
        pytest.skip("npm does not reach its registry in time")
    if done.returncode:
        pytest.skip(f"npm cannot install {', '.join(PACKAGES)}: {done.stderr.strip().splitlines()[:1]}")
    return made


def test_document_holds_the_official_schema_of_asyncapi(packages: Path, document: dict[str, Any]) -> None:
    official = packages / "node_modules/@asyncapi/specs/schemas/3.0.0-without-$id.json"
    validator = Draft7Validator(json.loads(official.read_text()))
    assert [f"{error.json_path}: {error.message[:200]}" for error in validator.iter_errors(document)] == []
    broken = copy.deepcopy(document)
    broken["operations"]["send.joint_states"]["action"] = "publish"
    assert not validator.is_valid(broken)


def test_payloads_hold_their_schemas_in_javascript(
    packages: Path, folder: Path, payloads: Payloads, tmp_path: Path
) -> None:
    chosen: dict[str, list[bytes]] = {}
    for name, payload in payloads:
        if len(chosen.setdefault(name, [])) < 5:
            chosen[name].append(payload)
    listed = [(name, base64.b64encode(each).decode()) for name, some in chosen.items() for each in some]
    (tmp_path / "payloads.json").write_text(json.dumps(listed))
    shutil.copy(HERE / "validate.mjs", packages)
    done = subprocess.run(["node", "validate.mjs", str(folder), str(tmp_path / "payloads.json")], cwd=packages,
                          capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {name: len(some) for name, some in chosen.items()}
