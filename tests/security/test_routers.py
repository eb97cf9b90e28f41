"""Secured routers without a cell: two that are linked, endpoints that are not encrypted, and one made of a file."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from cli.main import app
from common.errors import ConfigError
from common.transport.credentials import ACCESS, ROUTER_NAME, credentials_of, read_access
from common.transport.endpoint import MAX_OTHER_BYTES, port_of, router_config
from common.transport.router import open_router
from security.access import Rights, access_control
from security.certificates import Authority
from tests.harness import ROOT, environment, free_domain
from tests.security.holders import REFUSED, Holder


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Certificates of a cell with a writer of `seen` and `secret`, a reader of `seen`, and the rules for them."""
    authority = Authority.new(10)
    authority.write(tmp_path / "ca.pem", tmp_path / "ca.key")
    for name, hosts in ((ROUTER_NAME, ["127.0.0.1"]), ("cell.writer", []), ("cell.reader", [])):
        authority.issue(name, hosts, 10, tmp_path / f"{name}.pem", tmp_path / f"{name}.key")
    rights = {"writer": Rights(write={"seen", "secret"}), "reader": Rights(read={"seen"})}
    (tmp_path / ACCESS).write_text(json.dumps(access_control({"cell": rights})))
    return tmp_path


def test_what_is_too_large_for_a_key_under_another_name_goes_no_farther_than_the_router() -> None:
    here, key = f"tcp/127.0.0.1:{free_port()}", "cell/left/camera/camera_info"
    with ExitStack() as stack:
        stack.enter_context(open_router([here], small=["left/camera/camera_info"]))
        writer, reader = (stack.enter_context(Holder(here, None)) for _ in range(2))
        heard = reader.hear(key)
        for _ in range(100):
            writer.put(key, bytes(MAX_OTHER_BYTES + 1))
            writer.put(key, b"small")
            if heard.samples:
                break
            heard.soon(0.1)
        assert {len(payload) for _, payload in heard.samples} == {len(b"small")}


def test_linked_routers_pass_on_what_each_lets_through_and_no_more(folder: Path) -> None:
    here, there = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
    with ExitStack() as stack:
        stack.enter_context(open_router([here], folder))
        stack.enter_context(open_router([there], folder, [here]))
        writer = stack.enter_context(Holder(here, credentials_of("cell.writer", folder)))
        reader = stack.enter_context(Holder(there, credentials_of("cell.reader", folder)))
        other = stack.enter_context(Holder(there, credentials_of("cell.reader", folder)))
        heard = reader.hear("cell/**", "cell/seen", "cell/secret")
        for _ in range(100):
            writer.put("cell/secret", b"not for all")
            writer.put("cell/seen", b"for all")
            other.put("cell/seen", b"by a reader")
            if heard.samples:
                break
            heard.soon(0.1)
        assert set(heard.samples) == {("cell/seen", b"for all")}


@pytest.mark.parametrize("option", ["--listen", "--link"])
def test_an_open_endpoint_is_refused_beside_certificates(folder: Path, option: str) -> None:
    open_one, tls = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    listen, link = ([open_one], []) if option == "--listen" else ([tls], [open_one])
    with pytest.raises(ConfigError, match=f"^{option}: .*must be tls/"):
        open_router(listen, folder, link)


@pytest.mark.parametrize("secured", [False, True])
def test_a_router_that_is_reached_from_elsewhere_names_the_remedy_unless_it_is_secured(
    folder: Path, secured: bool
) -> None:
    protocol, extra = ("tls", {"ZENCELL_SECURE": str(folder)}) if secured else ("tcp", {})
    listen = f"{protocol}/0.0.0.0:{free_port()}"
    with subprocess.Popen(
        [sys.executable, "-m", "services.router", "--gate", "--listen", listen], cwd=ROOT, text=True,
        stdin=subprocess.PIPE, stderr=subprocess.PIPE, env={**environment(), **extra},
    ) as router:
        assert router.stdin is not None
        assert router.stderr is not None
        router.stdin.write("go\n")
        router.stdin.flush()
        said = [router.stderr.readline()]
        router.stdin.close()  # its supervisor is gone: it ends
        said += router.stderr.readlines()
    warnings = [line for line in said if "WARNING" in line]
    assert len(warnings) == (0 if secured else 1)
    assert all("zencell secure init DIR" in line for line in warnings)


# --- the router's configuration as a file, for a router that is not ours ----------------------------------------------


def written(capsys: pytest.CaptureFixture[str], place: Path, *arguments: str) -> Path:
    """What `zencell router config` prints, as a file."""
    assert app.execute(["router", "config", *arguments]) == 0
    place.write_text(capsys.readouterr().out)
    return place


@pytest.fixture
def nothing_handed_down(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("ZENCELL_SECURE", "ZENCELL_LISTEN", "ZENCELL_LINK", "ZENCELL_DOMAIN"):
        monkeypatch.setenv(variable, "42" if variable == "ZENCELL_DOMAIN" else "")


@pytest.mark.usefixtures("nothing_handed_down")
def test_the_file_says_what_our_own_router_is_told(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    file = written(capsys, tmp_path / "open.json5", "--link", "tcp/192.168.1.10:7489")
    told = router_config(["tcp/127.0.0.1:7489"], links=["tcp/192.168.1.10:7489"])
    assert str(zenoh.Config.from_file(file)) == str(told)
    file = written(capsys, tmp_path / "secured.json5", "--secure", str(folder), "--listen", "tls/0.0.0.0:7449",
                   "--domain", "2")
    told = router_config(["tls/0.0.0.0:7449"], credentials_of(ROUTER_NAME, folder), read_access(folder))
    assert str(zenoh.Config.from_file(file)) == str(told)


@pytest.mark.usefixtures("nothing_handed_down")
def test_a_router_that_was_given_the_file_lets_in_and_passes_on_what_ours_does(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    domain = free_domain()
    file = written(capsys, tmp_path / "router.json5", "--secure", str(folder), "--domain", str(domain))
    endpoint = f"tls/127.0.0.1:{port_of(domain)}"
    with zenoh.open(zenoh.Config.from_file(file)):
        with pytest.raises(zenoh.ZError):
            Holder(endpoint, None, connect_ms=REFUSED)
        with (Holder(endpoint, credentials_of("cell.writer", folder)) as writer,
              Holder(endpoint, credentials_of("cell.reader", folder)) as reader):
            heard = reader.hear("cell/**", "cell/seen", "cell/secret")
            for _ in range(100):
                writer.put("cell/secret", b"not for all")
                writer.put("cell/seen", b"for all")
                if heard.samples:
                    break
                heard.soon(0.1)
            assert set(heard.samples) == {("cell/seen", b"for all")}


@pytest.mark.usefixtures("nothing_handed_down")
@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["--domain", "233"], "--domain: '233'"),
        (["--secure", "nowhere"], "'nowhere' is not a folder"),
        (["--listen", "here"], "--listen: 'here' must be an endpoint"),
    ],
)
def test_a_file_that_no_router_could_use_is_not_written(
    capsys: pytest.CaptureFixture[str], arguments: list[str], wanted: str
) -> None:
    assert app.execute(["router", "config", *arguments]) == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert shown.out == ""
    assert wanted in line
