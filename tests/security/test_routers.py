"""Secured routers without a cell: linked routers, unencrypted endpoints, and a router configured by a file."""

import json
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from cli.main import app
from common.errors import ConfigError
from common.transport.credentials import ACCESS, ROUTER_NAME, credentials_of, read_access
from common.transport.endpoint import MAX_OTHER_BYTES, router_config
from common.transport.router import open_router
from security.access import Rights, access_control
from security.certificates import Authority
from tests.domains import free_port
from tests.harness import ROOT, environment
from tests.security.raw_client import RawClient, issue


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Certificates of a cell with a writer of `seen` and `secret`, a reader of `seen`, and the rules for them."""
    authority = Authority.new(10)
    authority.write(tmp_path / "ca.pem", tmp_path / "ca.key")
    for name in (ROUTER_NAME, "cell.writer", "cell.reader"):
        issue(authority, name, tmp_path, hosts=["127.0.0.1"] if name == ROUTER_NAME else ())
    rights = {"writer": Rights(write={"seen", "secret"}), "reader": Rights(read={"seen"})}
    (tmp_path / ACCESS).write_text(json.dumps(access_control({"cell": rights})))
    return tmp_path


def test_size_limit_of_a_remapped_key_is_enforced_by_the_router() -> None:
    here, key = f"tcp/127.0.0.1:{free_port()}", "cell/left/camera/camera_info"
    with ExitStack() as stack:
        stack.enter_context(open_router([here], small=["left/camera/camera_info"]))
        writer, reader = (stack.enter_context(RawClient(here, None)) for _ in range(2))
        received = reader.subscribe(key)
        received.repeat(lambda: (writer.put(key, bytes(MAX_OTHER_BYTES + 1)), writer.put(key, b"small")))
        assert {len(payload) for _, payload in received.samples} == {len(b"small")}


def test_linked_routers_forward_only_what_each_admits(folder: Path) -> None:
    here, there = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
    with ExitStack() as stack:
        stack.enter_context(open_router([here], folder))
        stack.enter_context(open_router([there], folder, [here]))
        writer = stack.enter_context(RawClient(here, credentials_of("cell.writer", folder)))
        reader, other = (stack.enter_context(RawClient(there, credentials_of("cell.reader", folder))) for _ in range(2))
        received = reader.subscribe("cell/**", "cell/seen", "cell/secret")
        received.repeat(lambda: (writer.put("cell/secret", b"not for all"), writer.put("cell/seen", b"for all"),
                                 other.put("cell/seen", b"by a reader")))
        assert set(received.samples) == {("cell/seen", b"for all")}


@pytest.mark.parametrize("option", ["--listen", "--link"])
def test_unencrypted_endpoint_is_refused_with_certificates(folder: Path, option: str) -> None:
    plain, tls = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    listen, link = ([plain], []) if option == "--listen" else ([tls], [plain])
    with pytest.raises(ConfigError, match=f"^{option}: .*must be tls/"):
        open_router(listen, folder, link)


@pytest.mark.parametrize("secured", [pytest.param(True, marks=pytest.mark.slow), False])
def test_router_reachable_from_other_hosts_warns_unless_it_is_secured(folder: Path, secured: bool) -> None:
    protocol, extra = ("tls", {"ZENCELL_SECURE": str(folder)}) if secured else ("tcp", {})
    listen = f"{protocol}/0.0.0.0:{free_port()}"
    with subprocess.Popen(
        [sys.executable, "-m", "services.router", "--gate", "--listen", listen], cwd=ROOT, text=True,
        stdin=subprocess.PIPE, stderr=subprocess.PIPE, env={**environment(), **extra},
    ) as router:
        assert router.stdin is not None and router.stderr is not None
        router.stdin.write("go\n")
        router.stdin.flush()
        output = [router.stderr.readline()]
        router.stdin.close()  # the router ends without its supervisor
        output += router.stderr.readlines()
    warnings = [line for line in output if "WARNING" in line]
    assert len(warnings) == (0 if secured else 1)
    for warning in warnings:
        assert f"every client that reaches {listen} can read and command every cell of this router" in warning
        assert "`zencell secure init DIR`, then --secure DIR" in warning


# --- the router's configuration as a file, for zenohd and other routers ----------------------------------------------


def test_config_file_equals_the_configuration_of_our_router(capsys, monkeypatch, folder: Path, tmp_path: Path) -> None:
    for variable in ("ZENCELL_SECURE", "ZENCELL_LISTEN", "ZENCELL_LINK", "ZENCELL_DOMAIN"):
        monkeypatch.setenv(variable, "42" if variable == "ZENCELL_DOMAIN" else "")
    tls, far = "tls/0.0.0.0:7449", "tcp/192.168.1.10:7489"
    credentials = credentials_of(ROUTER_NAME, folder)
    for arguments, expected in (
        (["--link", far], router_config(["tcp/127.0.0.1:7489"], links=[far])),
        (["--secure", str(folder), "--listen", tls, "--domain", "2"],
         router_config([tls], credentials, read_access(folder))),
    ):
        assert app.execute(["router", "config", *arguments]) == 0
        file = tmp_path / "router.json5"
        file.write_text(capsys.readouterr().out)
        assert str(zenoh.Config.from_file(file)) == str(expected)
    assert app.execute(["router", "config", "--secure", "nowhere"]) == 2
    shown = capsys.readouterr()
    assert shown.out == "" and "'nowhere' is not a folder" in shown.err and shown.err.count("\n") == 1
