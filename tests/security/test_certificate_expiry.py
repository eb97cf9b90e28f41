"""Certificates expire with a warning, are renewed in a running cell, and an authority is replaced with overlap."""

import datetime
import json
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from cli.main import app
from common.transport.credentials import CertificateMonitor, Credentials, credentials_of, expiry_of, expiry_warning
from common.transport.router import Router, maintain
from security.access import Rights, access_control
from security.certificates import Authority
from security.validation import certificate_in, require_valid
from tests.domains import free_port
from tests.security.raw_client import REFUSAL_MS, RawClient, issue
from tools.doctor.network import certificates as findings

NAMES = ("router", "operator", "panda.camera")
TIMEOUT = 20.0  # [s] only a failing test waits that long
RENEW = "zencell secure renew DIR"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    authority = Authority.new(100)
    authority.write(tmp_path / "ca.pem", tmp_path / "ca.key")
    for name in NAMES:
        issue(authority, name, tmp_path, 40, hosts=["localhost", "127.0.0.1"] if name == "router" else ())
    rules = access_control({"panda": {"camera": Rights(write={"x"}, read={"x"})}})
    (tmp_path / "access.json5").write_text(json.dumps(rules))
    return tmp_path


@pytest.fixture
def endpoint(folder: Path, monkeypatch):
    """A router that adopts new certificates, as in its process."""
    monkeypatch.setattr("common.transport.router._CHECK_SECONDS", 0.1)
    endpoint, stop = f"tls/127.0.0.1:{free_port()}", threading.Event()
    with Router([endpoint], folder) as router:
        maintaining = threading.Thread(target=maintain, args=[router, stop])
        maintaining.start()
        yield endpoint
        stop.set()
        maintaining.join()


def until(what: str, reached: Callable[[], object]) -> None:
    end = time.monotonic() + TIMEOUT
    while not reached():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def now_in(days: float) -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)


def renew(folder: Path, *options: str) -> None:
    assert app.execute(["secure", "renew", str(folder), *options]) == 0


def can_connect(endpoint: str, credentials: Credentials) -> bool:
    try:
        with RawClient(endpoint, credentials, connect_ms=REFUSAL_MS) as one:
            return one.connected
    except zenoh.ZError:
        return False


# --- warnings --------------------------------------------------------------------------------------------------------


def test_expiry_is_that_of_the_certificate(folder: Path) -> None:
    Authority.new(365 * 40).write(folder / "late.pem", folder / "late.key")  # encoded in another form from 2050 on
    for name in ("ca", "late", *NAMES):
        assert expiry_of(folder / f"{name}.pem") == certificate_in(folder / f"{name}.pem").not_valid_after_utc
    assert expiry_of(folder / "ca.key") is expiry_of(folder / "none.pem") is None


@pytest.mark.parametrize(("days", "urgent", "text"), [
    (9, None, ""), (11, False, "in 29 days"), (38, False, "in 2 days"), (39.5, True, "in 12 hours"),
    (41, True, "expired on"),
])
def test_warnings_start_30_days_and_one_day_before(folder: Path, monkeypatch, days: float, urgent, text: str) -> None:
    monkeypatch.setenv("ZENCELL_SECURE", str(folder))
    at = now_in(days) + datetime.timedelta(minutes=-1)
    found = expiry_warning("router", certificate_in(folder / "router.pem").not_valid_after_utc, at)
    assert (found[0] if found else None) is urgent
    reported = [*findings(at)]
    assert {finding.level for finding in reported} == {{None: "ok", False: "warn", True: "fail"}[urgent]}
    assert all(text in finding.what for finding in reported)
    assert len(reported) == (1 if urgent is None else len(NAMES))


def test_each_expiry_is_logged_once_and_again_when_urgent(folder: Path) -> None:
    watch = CertificateMonitor(folder)
    warned = [[urgent for urgent, _ in watch.new_warnings(now_in(days))] for days in (0, 11, 12, 39.5, 41, 42)]
    assert warned == [[], [False] * len(NAMES), [], [True] * len(NAMES), [True] * len(NAMES), []]
    ((_, line),) = CertificateMonitor(folder, frozenset(["panda.camera"])).new_warnings(now_in(11))
    assert "the certificate of panda.camera expires on" in line
    assert f"`zencell secure renew {folder}`" in line


# --- renewal of a running cell ----------------------------------------------------------------------------------------


def test_renewal_includes_an_authority_that_would_expire_earlier(folder: Path) -> None:
    before = {name: (folder / f"{name}.pem").read_bytes() for name in (*NAMES, "ca")}
    renew(folder)
    assert all((folder / f"{name}.pem").read_bytes() != text for name, text in before.items())
    require_valid(folder, NAMES, RENEW, now_in(363))
    (folder / "camera.pem").write_bytes(before["panda.camera"])
    certificate_in(folder / "camera.pem").verify_directly_issued_by(certificate_in(folder / "ca.pem"))


@pytest.mark.slow
def test_authority_is_replaced_with_overlap_while_clients_are_connected(folder, endpoint, tmp_path_factory) -> None:
    elsewhere = tmp_path_factory.mktemp("another_host")  # gets its new files later
    for name in ("ca.pem", "operator.pem", "operator.key"):
        (elsewhere / name).write_bytes((folder / name).read_bytes())
        (elsewhere / name).chmod(0o600)
    old, new = credentials_of("operator", elsewhere), credentials_of("operator", folder)
    with RawClient(endpoint, credentials_of("panda.camera", folder)) as camera:
        assert camera.connected
        for option, authorities in (("--authority", 2), ("--forget", 1)):
            renew(folder, option)
            (elsewhere / "ca.pem").write_bytes((folder / "ca.pem").read_bytes())
            assert (folder / "ca.pem").read_bytes().count(b"BEGIN") == authorities
            if option == "--forget":
                until("the old certificate can still connect", lambda: not can_connect(endpoint, old))
            until("the new certificate cannot connect", lambda: can_connect(endpoint, new))
            if option == "--authority":
                until("the old certificate cannot connect", lambda: can_connect(endpoint, old))
            else:
                assert not can_connect(endpoint, old)
        # The router adopts the new files and closes all links: a client that reconnects uses the new ones, too.
        until("the connected client does not reconnect", lambda: camera.connected)


def test_unusable_files_leave_the_previous_ones_in_force(folder: Path, endpoint: str, caplog) -> None:
    with caplog.at_level(logging.ERROR, "router"):
        (folder / "router.key").write_bytes((folder / "operator.key").read_bytes())
        until("nothing was logged", lambda: caplog.records)
    assert "the previous ones stay in force" in caplog.text
    until("the operator cannot connect", lambda: can_connect(endpoint, credentials_of("operator", folder)))


@pytest.mark.slow
def test_expired_certificate_opens_no_new_link_and_closes_none(folder: Path, endpoint: str) -> None:
    validity = 3.0  # [s]
    issue(Authority.load(folder / "ca.pem", folder / "ca.key"), "operator", folder, validity / 86400)
    own = credentials_of("operator", folder)
    with RawClient(endpoint, own) as running:
        received = running.subscribe("panda/x")
        until("the expired certificate can still connect", lambda: not can_connect(endpoint, own))
        with RawClient(endpoint, credentials_of("panda.camera", folder)) as camera:
            received.repeat(lambda: camera.put("panda/x", b"a"))
        assert running.connected
