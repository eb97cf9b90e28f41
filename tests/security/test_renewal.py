"""`zencell secure init --renew` replaces all certificates and leaves the authority and the router's host names."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cli.main import app
from security.validation import certificate_in, hosts_in, require_valid

LOCAL = {"localhost", "127.0.0.1", "::1"}
Init = Callable[..., Path]


@pytest.fixture
def init(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Init:
    """Creates or renews the certificates of a small cell."""
    (tmp_path / "extra").mkdir()
    (tmp_path / "extra" / "quiet.py").write_text(
        "from common.config import Parameters as Config\nasync def run(bus, config):\n    await bus.ready()\n"
    )
    (tmp_path / "small.yaml").write_text(
        "cell: small\nrobot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: quiet\nservices: {extra.quiet: {}}\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))

    def run(*arguments: str) -> Path:
        assert app.execute(["secure", "init", "certs", "--cell", "small.yaml", *arguments]) == 0, capsys.readouterr()
        return tmp_path / "certs"

    return run


def hosts(folder: Path) -> set[str]:
    return set(hosts_in(certificate_in(folder / "router.pem")))


def test_renewal_leaves_the_authority_and_the_host_names_of_the_router(init: Init) -> None:
    folder = init("--host", "arm.example.org", "--host", "192.168.1.11")
    assert hosts(folder) == {*LOCAL, "arm.example.org", "192.168.1.11"}
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    init("--renew")
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {name for name in before if after[name] == before[name]} == {"ca.pem", "ca.key", "access.json5"}
    assert hosts(folder) == {*LOCAL, "arm.example.org", "192.168.1.11"}
    require_valid(folder, ["router", "operator", "observer", "small.quiet", "small.supervisor"], "")
    init("--renew", "--host", "eye.example.org")
    assert hosts(folder) == {*LOCAL, "eye.example.org"}


def test_existing_certificates_are_not_overwritten_by_mistake(init: Init, capsys: pytest.CaptureFixture[str]) -> None:
    folder = init()
    before = (folder / "router.pem").read_bytes()
    capsys.readouterr()
    assert app.execute(["secure", "init", "certs", "--cell", "small.yaml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "zencell: DIR: 'certs' has certificates already: --renew replaces all except the authority"
    (folder / "ca.key").unlink()
    assert app.execute(["secure", "init", "certs", "--cell", "small.yaml", "--renew"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "zencell: --renew: 'certs' has no ca.key to sign with"
    assert (folder / "router.pem").read_bytes() == before
