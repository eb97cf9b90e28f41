"""`make audit` with a database that has findings, that has none, and that cannot be reached."""

from __future__ import annotations

import json
import os
import re
import socketserver
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from security.certificates import Authority
from tests.harness import ROOT

BIN = Path(sys.executable).parent
pytestmark = pytest.mark.skipif(not (BIN / "pip-audit").exists(), reason="pip-audit is not installed")

PINNED = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.M))
FINDING = {
    "id": "PYSEC-0000-1", "details": "invented", "summary": None, "aliases": [], "fixed_in": ["999"], "link": "",
    "source": "osv", "withdrawn": None,
}


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


class Database(socketserver.ThreadingTCPServer):
    """A fake package index, reached as a proxy."""

    daemon_threads = True

    def __init__(self, folder: Path) -> None:
        authority = Authority.new(1)
        authority.write(folder / "ca.pem", folder / "ca.key")
        authority.issue("index", ["pypi.org"], 1, folder / "index.pem", folder / "index.key")
        self.tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        self.tls.load_cert_chain(folder / "index.pem", folder / "index.key")
        self.reachable = True
        self.vulnerable: str | None = None
        self.requested: dict[str, str] = {}
        super().__init__(("127.0.0.1", 0), _Connection)

    def answer(self, path: str) -> bytes:
        match = re.fullmatch(r"/pypi/([^/]+)/([^/]+)/json", path)
        if match is None or not self.reachable:
            return b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
        name, version = plain(match[1]), match[2]
        self.requested[name] = version
        body = json.dumps({"info": {}, "vulnerabilities": [FINDING] if name == self.vulnerable else []}).encode()
        head = f"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n"
        return f"{head}Connection: close\r\n\r\n".encode() + body


class _Connection(socketserver.StreamRequestHandler):
    server: Database

    def handle(self) -> None:
        while self.rfile.readline().strip():  # CONNECT pypi.org:443
            pass
        self.request.sendall(b"HTTP/1.1 200 Connection established\r\n\r\n")
        with self.server.tls.wrap_socket(self.request, server_side=True) as inside, inside.makefile("rb") as lines:
            path = lines.readline().decode().split(" ")[1]
            while lines.readline().strip():
                pass
            inside.sendall(self.server.answer(path))


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    with Database(tmp_path) as server:
        serving = threading.Thread(target=server.serve_forever, args=[0.02], daemon=True)
        serving.start()
        yield server
        server.shutdown()
        serving.join()


@pytest.fixture
def audit(database: Database, tmp_path: Path) -> Callable[[], subprocess.CompletedProcess[str]]:
    """Runs the command of `make audit` against the fake package index."""
    authority = str(tmp_path / "ca.pem")
    inherited = {name: value for name, value in os.environ.items() if not name.lower().endswith(("_proxy", "_bundle"))}
    environment = {
        **inherited, "HTTPS_PROXY": f"http://127.0.0.1:{database.server_address[1]}", "SSL_CERT_FILE": authority,
        "REQUESTS_CA_BUNDLE": authority, "PIP_CACHE_DIR": str(tmp_path / "cache"), "HOME": str(tmp_path),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    return lambda: subprocess.run(
        [ROOT / ".ci" / "audit", BIN], env=environment, capture_output=True, text=True, timeout=100, check=False
    )


Audit = Callable[[], subprocess.CompletedProcess[str]]


@pytest.mark.slow
def test_every_pinned_version_is_looked_up_and_a_finding_fails(database: Database, audit: Audit) -> None:
    done = audit()
    assert done.returncode == 0, done.stderr
    assert "No known vulnerabilities found" in done.stdout + done.stderr
    assert {plain(name): version for name, version in PINNED.items()}.items() <= database.requested.items()
    database.vulnerable = "cryptography"
    done = audit()
    assert done.returncode == 1
    (found,) = [line for line in done.stdout.splitlines() if FINDING["id"] in line]
    assert found.split()[:2] == ["cryptography", PINNED["cryptography"]]


def test_unreachable_database_is_reported_in_one_line(database: Database, audit: Audit) -> None:
    database.reachable = False
    done = audit()
    assert (done.returncode, done.stdout) == (0, "")
    (line,) = done.stderr.splitlines()
    assert line == "dependencies were not audited: https://pypi.org/pypi/pip/24.0/json cannot be reached"
