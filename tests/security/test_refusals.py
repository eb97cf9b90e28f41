"""`--secure` refuses incomplete or invalid files before any process starts, in one line with the remedy."""

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
from common.transport.credentials import ACCESS, REMEDY
from security.certificates import Authority
from security.preflight import require_secured
from tests.harness import free_domain
from tests.security.raw_client import issue

CELL = load_cell("panda")

Refusal = Callable[..., str]


@pytest.fixture
def folder(certificates: Path, tmp_path: Path) -> Path:
    """A copy of the certificates, to be damaged."""
    return Path(shutil.copytree(certificates, tmp_path / "certs"))


@pytest.fixture
def refusal(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refusal:
    """Runs a command that must be refused in one line; returns that line without the program's name."""
    for variable in ("ZENCELL_SECURE", "ZENCELL_LISTEN", "ZENCELL_LINK", "ZENCELL_CONNECT"):
        monkeypatch.setenv(variable, "")  # restored afterwards, whatever the command sets
    monkeypatch.chdir(folder.parent)
    monkeypatch.setattr(sys, "path", list(sys.path))  # the command adds the folder of custom services

    def run(*arguments: str, secure: str | None = "certs", code: int = 2) -> str:
        options = [] if secure is None else ["--secure", secure]
        ended = app.execute([*arguments, *options, "--domain", str(free_domain())])
        shown = capsys.readouterr()
        assert (ended, shown.out) == (code, "")
        (line,) = shown.err.splitlines() or ["nothing"]
        assert line.startswith("zencell: ")
        return line.removeprefix("zencell: ")

    return run


def test_missing_folder_is_named_with_the_command_that_creates_one(refusal: Refusal, monkeypatch) -> None:
    for verb, name in (("run", "nowhere"), ("up", "certs/ca.pem"), ("up", "")):
        line = refusal(verb, "panda", secure=name)
        assert line == f"--secure: {name!r} is not a folder; make one with `zencell secure init DIR`"
    monkeypatch.setenv("ZENCELL_SECURE", "nowhere")
    assert "'nowhere' is not a folder" in refusal("up", "panda", secure=None)


@pytest.mark.parametrize("missing", ["router.key", "panda.supervisor.pem", "panda.viewer.key", ACCESS])
def test_each_process_that_is_started_needs_its_files(refusal: Refusal, folder: Path, missing: str) -> None:
    (folder / missing).unlink()
    line = refusal("run", "panda", "--only", "viewer")
    assert line == f"--secure: '{folder}' has no {missing}: {REMEDY}"


def test_recorder_that_is_started_needs_its_own_certificate(refusal: Refusal, folder: Path, monkeypatch) -> None:
    (folder / "panda.recorder.key").unlink()
    monkeypatch.setattr("security.preflight._require_rules", lambda *_: None)  # in another process
    line = refusal("run", "panda", "--only", "robot_state_publisher", "--record", "all.mcap")
    assert line == f"--secure: '{folder}' has no panda.recorder.key: {REMEDY}"


def test_expired_certificate_is_named_with_its_date_and_the_remedy(refusal: Refusal, folder: Path) -> None:
    expired = issue(Authority.load(folder / "ca.pem", folder / "ca.key"), "panda.smart_pick_place", folder, -1)
    line = refusal("up", "panda")
    assert line.startswith(f"--secure: '{expired.certificate}' expired on 20") and "--renew" in line


def test_unencrypted_endpoint_with_certificates_is_named(refusal: Refusal, monkeypatch: pytest.MonkeyPatch) -> None:
    for option in ("--listen", "--link", "--connect"):
        line = refusal("up", "panda", option, "tcp/192.168.1.10:7489")
        assert line.startswith(f"{option}: 'tcp/192.168.1.10:7489' is an open endpoint: ")
        assert line.endswith("it must be tls/HOST:PORT")
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


def test_override_that_a_service_rejects_is_reported_in_its_words(refusal: Refusal) -> None:
    line = refusal("run", "panda", "--only", "scene_manager", "--set", "robot.gripper=null")
    assert "robot.gripper: is missing: scene_manager needs a robot with one" in line
    assert "Error" not in line


def test_service_that_crashes_before_it_declares_anything_is_named(refusal: Refusal, folder: Path) -> None:
    package = folder.parent / "extra"
    package.mkdir()
    (package / "crashes.py").write_text(
        "from common.config import Parameters as Config\nasync def run(bus, config):\n    raise KeyError('a bug')\n")
    (folder.parent / "small.yaml").write_text(
        "cell: panda\nrobot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: crashes\n"
        "services: {extra.crashes: {}}\n")
    issue(Authority.load(folder / "ca.pem", folder / "ca.key"), "panda.crashes", folder)
    line = refusal("run", "small.yaml", code=1)
    assert line == "services.crashes: failed before it declared its topics: KeyError('a bug')"
