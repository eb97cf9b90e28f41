"""`zencell secure init --renew` replaces all certificates and leaves the authority and the router's host names."""

import sys
from pathlib import Path

import pytest

from cli.main import app
from security.validation import certificate_in, hosts_in, require_valid

LOCAL = {"localhost", "127.0.0.1", "::1"}
INIT = ("secure", "init", "certs", "--cell", "small.yaml")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """Where the certificates of a small cell are created, next to its file."""
    (tmp_path / "extra").mkdir()
    (tmp_path / "extra" / "quiet.py").write_text(
        "from common.config import Parameters as Config\nasync def run(bus, config):\n    await bus.ready()\n")
    (tmp_path / "small.yaml").write_text(
        "cell: small\nrobot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: quiet\nservices: {extra.quiet: {}}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path / "certs"


def test_renewal_leaves_the_authority_and_the_host_names_of_the_router(folder: Path) -> None:
    def init(*arguments: str) -> dict[str, bytes]:
        assert app.execute([*INIT, *arguments]) == 0
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    def hosts() -> set[str]:
        return set(hosts_in(certificate_in(folder / "router.pem")))

    before = init("--host", "arm.example.org", "--host", "192.168.1.11")
    assert hosts() == {*LOCAL, "arm.example.org", "192.168.1.11"}
    after = init("--renew")
    assert {name for name in before if after[name] == before[name]} == {"ca.pem", "ca.key", "access.json5"}
    assert hosts() == {*LOCAL, "arm.example.org", "192.168.1.11"}
    require_valid(folder, ["router", "operator", "observer", "small.quiet", "small.supervisor"], "")
    init("--renew", "--host", "eye.example.org")
    assert hosts() == {*LOCAL, "eye.example.org"}


def test_existing_certificates_are_not_overwritten_by_mistake(folder: Path, capsys) -> None:
    def refusal(*arguments: str) -> str:
        capsys.readouterr()
        assert app.execute([*INIT, *arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("zencell: ")

    assert app.execute(INIT) == 0
    before = (folder / "router.pem").read_bytes()
    assert refusal() == "DIR: 'certs' has certificates already: --renew replaces all except the authority"
    (folder / "ca.key").unlink()
    assert refusal("--renew") == "--renew: 'certs' has no ca.key to sign with"
    assert (folder / "router.pem").read_bytes() == before


def test_runner_of_a_program_gets_a_certificate_in_place_of_the_task(folder: Path) -> None:
    (folder.parent / "wave.yaml").write_text("cell: panda\nsteps: [{step: move, to: home}]\n")
    assert app.execute(["secure", "init", "certs", "--cell", "wave.yaml"]) == 0
    require_valid(folder, ["router", "panda.program_runner", "panda.motion_planner"], "")
    assert not (folder / "panda.smart_pick_place.pem").exists()
    assert app.execute(["secure", "check", "certs", "--cell", "wave.yaml"]) == 0
    assert app.execute(["secure", "check", "certs", "--cell", "panda"]) == 2
