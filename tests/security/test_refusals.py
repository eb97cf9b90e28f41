"""`--secure` refuses incomplete or invalid files before any process starts, in one line with the remedy."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cli.main import app
from common.config import load_cell
from common.errors import ConfigError
from common.supervision.launch import Launch
from common.supervision.multi_host import HostOptions
from common.transport.credentials import ACCESS, ROUTER_NAME
from security.certificates import Authority
from security.preflight import require_secured
from tests.harness import free_domain

CELL = load_cell("panda")

Shown = pytest.CaptureFixture[str]
Refusal = Callable[..., str]


@pytest.fixture
def folder(certificates: Path, tmp_path: Path) -> Path:
    """A copy of the certificates, to be damaged."""
    return Path(shutil.copytree(certificates, tmp_path / "certs"))


@pytest.fixture
def refusal(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Shown) -> Refusal:
    """Runs a command that must be refused in one line; returns that line without the program's name."""
    for variable in ("ZENCELL_SECURE", "ZENCELL_LISTEN", "ZENCELL_LINK", "ZENCELL_CONNECT"):
        monkeypatch.setenv(variable, "")  # restored afterwards, whatever the command sets
    monkeypatch.chdir(folder.parent)
    monkeypatch.setattr(sys, "path", list(sys.path))  # the command adds the folder of custom services

    def run(*arguments: str, secure: str | None = "certs", code: int = 2) -> str:
        options = [] if secure is None else ["--secure", secure]
        ended = app.execute([*arguments, *options, "--domain", str(free_domain())])
        shown = capsys.readouterr()
        assert shown.out == ""
        (line,) = shown.err.splitlines() or ["nothing"]
        assert ended == code
        assert line.startswith("zencell: ")
        return line.removeprefix("zencell: ")

    return run


@pytest.mark.parametrize("verb", ["run", "up"])
@pytest.mark.parametrize("folder_name", ["nowhere", "certs/ca.pem", ""])
def test_missing_folder_is_named_with_the_command_that_creates_one(
    refusal: Refusal, verb: str, folder_name: str
) -> None:
    line = refusal(verb, "panda", secure=folder_name)
    assert line == f"--secure: {folder_name!r} is not a folder; make one with `zencell secure init DIR`"


def test_missing_folder_in_the_environment_variable_is_named(
    refusal: Refusal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENCELL_SECURE", "nowhere")
    assert "'nowhere' is not a folder" in refusal("up", "panda", secure=None)


@pytest.mark.parametrize(
    "missing",
    ["ca.pem", "router.pem", "router.key", "panda.supervisor.pem", "panda.vision_detector.pem", "panda.viewer.key",
     ACCESS],
)
def test_missing_file_is_named(refusal: Refusal, folder: Path, missing: str) -> None:
    (folder / missing).unlink()
    line = refusal("run", "panda")
    assert line == f"--secure: '{folder}' has no {missing}: make it with `zencell secure init`"


def test_recorder_that_is_started_needs_its_own_certificate(refusal: Refusal, folder: Path) -> None:
    (folder / "panda.recorder.key").unlink()
    line = refusal("run", "panda", "--only", "robot_state_publisher", "--record", "all.mcap")
    assert line == f"--secure: '{folder}' has no panda.recorder.key: make it with `zencell secure init`"


@pytest.mark.parametrize(("name", "remedy"), [(ROUTER_NAME, "--renew"), ("panda.smart_pick_place", "--renew"),
                                              ("ca", "--renew")])
def test_expired_certificate_is_named_with_its_date(
    refusal: Refusal, folder: Path, name: str, remedy: str
) -> None:
    own = Authority.new(-1) if name == "ca" else Authority.load(folder / "ca.pem", folder / "ca.key")
    place = folder / f"{name}.pem", folder / f"{name}.key"
    if name == "ca":
        own.write(*place)
    else:
        own.issue(name, [], -1, *place)
    line = refusal("up", "panda")
    assert line.startswith(f"--secure: '{place[0]}' expired on 20")
    assert remedy in line


def test_certificate_of_another_authority_is_named(refusal: Refusal, folder: Path) -> None:
    name = "panda.motion_planner"
    Authority.new(10).issue(name, [], 10, folder / f"{name}.pem", folder / f"{name}.key")
    assert f"{name}.pem' is not of ca.pem: `zencell secure init" in refusal("up", "panda")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
@pytest.mark.parametrize("name", [ROUTER_NAME, "panda.trajectory_executor"])
def test_key_that_others_can_read_is_named_with_the_remedy(
    refusal: Refusal, folder: Path, name: str, mode: int
) -> None:
    key = folder / f"{name}.key"
    key.chmod(mode)
    assert refusal("run", "panda") == f"--secure: '{key}' can be read by others: chmod 600 it"


@pytest.mark.parametrize("option", ["--listen", "--link", "--connect"])
def test_unencrypted_endpoint_with_certificates_is_named(refusal: Refusal, option: str) -> None:
    line = refusal("up", "panda", option, "tcp/192.168.1.10:7489")
    assert line.startswith(f"{option}: 'tcp/192.168.1.10:7489' is an open endpoint: ")
    assert line.endswith("it must be tls/HOST:PORT")


def test_unencrypted_endpoint_of_the_environment_is_named_with_its_variable(
    refusal: Refusal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENCELL_LINK", "tls/192.168.1.10:7489, tcp/192.168.1.11:7489")
    assert refusal("up", "panda").startswith("ZENCELL_LINK: 'tcp/192.168.1.11:7489' is an open endpoint")


def test_outdated_rules_are_refused_with_the_difference(refusal: Refusal, folder: Path) -> None:
    rules = (folder / ACCESS).read_text()
    (folder / ACCESS).write_text(rules.replace('"panda/detected_objects"', '"panda/something_else"'))
    line = refusal("run", "panda", "--only", "vision_detector")
    assert "has other rules for panda.vision_detector than it declares now (" in line
    assert line.endswith(f"`zencell secure init {folder} --renew`")


def test_host_needs_only_the_files_of_what_it_starts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = HostOptions(only=["viewer,vision_detector"]).part_of(CELL)  # the viewer's topics depend on the complete cell
    eye = folder.parent / "eye"
    eye.mkdir()
    for name in ("router", "panda.supervisor", "panda.viewer", "panda.vision_detector"):
        for kind in ("pem", "key"):
            shutil.copy(folder / f"{name}.{kind}", eye)
    shutil.copy(folder / "ca.pem", eye)
    rules = (folder / ACCESS).read_text()
    of_another_host = '"panda/alive/motion_planner"'
    assert of_another_host in rules
    (eye / ACCESS).write_text(rules.replace(of_another_host, '"changed"'))
    monkeypatch.setenv("ZENCELL_SECURE", str(eye))
    require_secured(Launch("panda"), part)
    with pytest.raises(ConfigError, match=r"has no panda\.motion_planner\.pem"):
        require_secured(Launch("panda"), CELL)


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("robot.gripper=null", "robot.gripper: is missing: scene_manager needs a robot with one"),
        ("robot.urdf=package://example-robot-data/robots/unknown/unknown.urdf", "unknown.urdf' is missing"),
        ("services.scene_manager.nothing=3", "services.scene_manager.nothing: 3 is not a parameter"),
    ],
)
def test_override_that_a_service_rejects_is_reported_in_its_words(
    refusal: Refusal, override: str, reason: str
) -> None:
    line = refusal("run", "panda", "--only", "scene_manager", "--set", override)
    assert reason in line
    assert "Error" not in line


def test_service_that_crashes_before_it_declares_anything_is_named(refusal: Refusal, folder: Path) -> None:
    package = folder.parent / "extra"
    package.mkdir()
    (package / "crashes.py").write_text(
        "from common.config import Parameters as Config\nasync def run(bus, config):\n    raise KeyError('a bug')\n"
    )
    (folder.parent / "small.yaml").write_text(
        "cell: panda\nrobot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: crashes\n"
        "services: {extra.crashes: {}}\n"
    )
    name = "panda.crashes"
    Authority.load(folder / "ca.pem", folder / "ca.key").issue(
        name, [], 10, folder / f"{name}.pem", folder / f"{name}.key"
    )
    line = refusal("run", "small.yaml", code=1)
    assert line == "services.crashes: failed before it declared its topics: KeyError('a bug')"
