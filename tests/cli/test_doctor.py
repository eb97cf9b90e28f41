import socket
from pathlib import Path

import pytest

from cli import doctor


def found(endpoint: str) -> dict[str, doctor.Finding]:
    return {finding.what: finding for finding in doctor.examine(endpoint)}


def test_what_is_not_well_comes_with_a_remedy() -> None:
    for finding in found("tcp/127.0.0.1:1").values():
        assert finding.level == "ok" or finding.remedy


def test_a_port_that_something_else_holds_is_a_warning() -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        endpoint = f"tcp/127.0.0.1:{holder.getsockname()[1]}"
        (finding,) = [f for what, f in found(endpoint).items() if what.startswith(endpoint)]
    assert finding.level == "warn"
    assert "in use by process" in finding.what
    assert "--domain" in finding.remedy


def test_a_missing_description_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "it.yaml").write_text(
        "{name: it, urdf: nowhere.urdf, joints: [a], base_link: b, tcp_link: t, named_poses: {home: [0]},"
        " acceleration_limits: [1], jerk_limits: [1]}"
    )
    (tmp_path / "robots" / "wrong.yaml").write_text("{name: wrong}")
    monkeypatch.setenv("ZENCELL_CONFIG", str(tmp_path))
    findings = found("tcp/127.0.0.1:1")
    assert findings["robot it: nowhere.urdf is missing"].level == "fail"
    assert any(what.startswith("robot wrong: urdf: is missing") for what in findings)


def test_the_robots_that_come_with_us_are_described() -> None:
    for what, finding in found("tcp/127.0.0.1:1").items():
        if what.startswith("robot "):
            assert finding.level == "ok", what
