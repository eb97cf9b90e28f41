"""Secured routers without a cell: linked routers, unencrypted endpoints, and a router configured by a file."""

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
from tests.security.raw_client import REFUSAL_MS, RawClient


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


def test_size_limit_of_a_remapped_key_is_enforced_by_the_router() -> None:
    here, key = f"tcp/127.0.0.1:{free_port()}", "cell/left/camera/camera_info"
    with ExitStack() as stack:
        stack.enter_context(open_router([here], small=["left/camera/camera_info"]))
        writer, reader = (stack.enter_context(RawClient(here, None)) for _ in range(2))
        received = reader.subscribe(key)
        for _ in range(100):
            writer.put(key, bytes(MAX_OTHER_BYTES + 1))
            writer.put(key, b"small")
            if received.samples:
                break
            received.wait_briefly(0.1)
        assert {len(payload) for _, payload in received.samples} == {len(b"small")}


def test_linked_routers_forward_only_what_each_admits(folder: Path) -> None:
    here, there = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
    with ExitStack() as stack:
        stack.enter_context(open_router([here], folder))
        stack.enter_context(open_router([there], folder, [here]))
        writer = stack.enter_context(RawClient(here, credentials_of("cell.writer", folder)))
        reader = stack.enter_context(RawClient(there, credentials_of("cell.reader", folder)))
        other = stack.enter_context(RawClient(there, credentials_of("cell.reader", folder)))
        received = reader.subscribe("cell/**", "cell/seen", "cell/secret")
        for _ in range(100):
            writer.put("cell/secret", b"not for all")
            writer.put("cell/seen", b"for all")
            other.put("cell/seen", b"by a reader")
            if received.samples:
                break
            received.wait_briefly(0.1)
        assert set(received.samples) == {("cell/seen", b"for all")}


@pytest.mark.parametrize("option", ["--listen", "--link"])
def test_unencrypted_endpoint_is_refused_with_certificates(folder: Path, option: str) -> None:
    open_one, tls = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    listen, link = ([open_one], []) if option == "--listen" else ([tls], [open_one])
    with pytest.raises(ConfigError, match=f"^{option}: .*must be tls/"):
        open_router(listen, folder, link)


@pytest.mark.parametrize("secured", [False, True])
def test_router_reachable_from_other_hosts_warns_unless_it_is_secured(
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
        output = [router.stderr.readline()]
        router.stdin.close()  # the router ends without its supervisor
        output += router.stderr.readlines()
    warnings = [line for line in output if "WARNING" in line]
    assert len(warnings) == (0 if secured else 1)
    assert all("zencell secure init DIR" in line for line in warnings)


# --- the router's configuration as a file, for zenohd and other routers ----------------------------------------------


def write_config(capsys: pytest.CaptureFixture[str], place: Path, *arguments: str) -> Path:
    """Write the output of `zencell router config` to a file; return its path."""
    assert app.execute(["router", "config", *arguments]) == 0
    place.write_text(capsys.readouterr().out)
    return place


@pytest.fixture
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("ZENCELL_SECURE", "ZENCELL_LISTEN", "ZENCELL_LINK", "ZENCELL_DOMAIN"):
        monkeypatch.setenv(variable, "42" if variable == "ZENCELL_DOMAIN" else "")


@pytest.mark.usefixtures("no_variables")
def test_config_file_equals_the_configuration_of_our_router(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    file = write_config(capsys, tmp_path / "open.json5", "--link", "tcp/192.168.1.10:7489")
    expected = router_config(["tcp/127.0.0.1:7489"], links=["tcp/192.168.1.10:7489"])
    assert str(zenoh.Config.from_file(file)) == str(expected)
    file = write_config(capsys, tmp_path / "secured.json5", "--secure", str(folder), "--listen", "tls/0.0.0.0:7449",
                   "--domain", "2")
    expected = router_config(["tls/0.0.0.0:7449"], credentials_of(ROUTER_NAME, folder), read_access(folder))
    assert str(zenoh.Config.from_file(file)) == str(expected)


@pytest.mark.usefixtures("no_variables")
def test_router_with_the_config_file_enforces_the_same_rules(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    domain = free_domain()
    file = write_config(capsys, tmp_path / "router.json5", "--secure", str(folder), "--domain", str(domain))
    endpoint = f"tls/127.0.0.1:{port_of(domain)}"
    with zenoh.open(zenoh.Config.from_file(file)):
        with pytest.raises(zenoh.ZError):
            RawClient(endpoint, None, connect_ms=REFUSAL_MS)
        with (RawClient(endpoint, credentials_of("cell.writer", folder)) as writer,
              RawClient(endpoint, credentials_of("cell.reader", folder)) as reader):
            received = reader.subscribe("cell/**", "cell/seen", "cell/secret")
            for _ in range(100):
                writer.put("cell/secret", b"not for all")
                writer.put("cell/seen", b"for all")
                if received.samples:
                    break
                received.wait_briefly(0.1)
            assert set(received.samples) == {("cell/seen", b"for all")}


@pytest.mark.usefixtures("no_variables")
@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--domain", "233"], "--domain: '233'"),
        (["--secure", "nowhere"], "'nowhere' is not a folder"),
        (["--listen", "here"], "--listen: 'here' must be an endpoint"),
    ],
)
def test_invalid_options_write_no_config_file(
    capsys: pytest.CaptureFixture[str], arguments: list[str], reason: str
) -> None:
    assert app.execute(["router", "config", *arguments]) == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert shown.out == ""
    assert reason in line
