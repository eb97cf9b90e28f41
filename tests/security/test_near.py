"""Services of the router's own host come in at a listener of their own; neither door shuts the other."""

from __future__ import annotations

import asyncio
import logging
import shutil
import socket
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from common.supervision.launch import Launch, free_endpoints
from common.transport.credentials import credentials_of
from common.transport.endpoint import LINKS, NEAR_MS, nearby_endpoints
from common.transport.router import Router
from common.transport.zenoh_session import ZenohSession, open_zenoh
from security.certificates import Authority
from tests.common.transport.conftest import until
from tests.security.holders import REFUSED, Holder
from tests.security.test_routers import free_port

SILENT = 150  # Zenoh itself accepts nobody for 100 ms after each
WITHIN = 3.0  # [s]


class Door:
    """A secured router with its front, and where it listens besides."""

    def __init__(self, certificates: Path) -> None:
        self.certificates = certificates
        self.endpoint, self.near = f"tls/127.0.0.1:{free_port()}", free_endpoints(2)
        self.router = Router([self.endpoint], certificates, near=self.near)

    @property
    def through_the_gate(self) -> int:
        return len(self.router._gate._sockets)

    async def enter(self, *, near: bool) -> tuple[ZenohSession, float]:
        began = time.monotonic()
        camera = credentials_of("panda.camera_simulator", self.certificates)
        session = await open_zenoh(self.endpoint, camera, self.near if near else ())
        return session, time.monotonic() - began


@pytest.fixture
def door(certificates: Path, tmp_path: Path):
    folder = tmp_path / "certificates"
    shutil.copytree(certificates, folder)
    made = Door(folder)
    with made.router:
        yield made


def connections(ports: list[str]) -> list[socket.socket]:
    return [socket.create_connection(("127.0.0.1", int(each.rpartition(":")[2]))) for each in ports]


async def test_who_is_near_passes_no_front_and_has_the_rights_of_his_certificate(door: Door) -> None:
    session, _ = await door.enter(near=True)
    assert session.connected and not door.through_the_gate and len(session._session.info.links()) == len(LINKS)
    far, _ = await door.enter(near=False)
    assert far.connected and door.through_the_gate
    with Holder(door.endpoint, credentials_of("operator", door.certificates)) as operator:
        heard = operator.hear("panda/**")
        for _ in range(100):
            for key in ("panda/joint_states", "panda/camera/camera_info"):
                session.publisher(key, "", reliable=True).put(b"by the camera", b"")
            if heard.samples:
                break
            heard.soon(0.1)
        assert heard.keys == {"panda/camera/camera_info"}
    for each in (session, far):
        each.close()


@pytest.mark.parametrize("expression", ["panda/camera/camera_info", "panda/camera/*", "panda/**", "*/camera/**"])
async def test_whoever_reads_after_a_writer_has_begun_hears_it_whatever_expression_he_reads(
    door: Door, expression: str
) -> None:
    writer, _ = await door.enter(near=True)
    answered = asyncio.get_running_loop().create_future()
    publisher = writer.publisher("panda/camera/camera_info", "", reliable=True)
    # Answered after all that was declared before: the router knows by then that nobody reads.
    writer.get_tokens("panda/alive/*", lambda _: None, lambda: answered.get_loop().call_soon_threadsafe(
        answered.set_result, None), timeout=WITHIN)
    await answered
    assert not publisher.matched
    with Holder(door.endpoint, credentials_of("operator", door.certificates)) as operator:
        heard = operator.hear(expression)
        for _ in range(100):
            publisher.put(b"by the camera", b"")
            if heard.samples:
                break
            heard.soon(0.1)
        assert heard.keys == {"panda/camera/camera_info"}
    writer.close()


@pytest.mark.parametrize("flooded", [pytest.param("near", marks=pytest.mark.slow), "front"])
async def test_silent_connections_at_one_door_keep_nobody_out_at_the_other(door: Door, flooded: str) -> None:
    listening = [each for each in door.near if _listens(each)]
    assert len(listening) == 1
    at = listening if flooded == "near" else [door.endpoint]
    silent = connections(at * SILENT)
    for state in ("while they are there", "after they went"):
        for near in (True, False):
            session, took = await door.enter(near=near)
            assert took < WITHIN + (NEAR_MS / 1000 if near else 0), (state, near)
            session.close()
        for each in silent:
            each.close()


def _listens(endpoint: str) -> bool:
    try:
        connections([endpoint])[0].close()
    except ConnectionRefusedError:
        return False
    return True


@pytest.mark.slow
async def test_one_without_a_certificate_or_of_another_authority_is_not_let_in_near_either(
    door: Door, tmp_path: Path
) -> None:
    authority = Authority.new(10)
    strange = tmp_path / "strange"
    strange.mkdir()
    authority.write(strange / "ca.pem", strange / "ca.key")
    authority.issue("operator", [], 10, strange / "operator.pem", strange / "operator.key")
    shutil.copy(door.certificates / "ca.pem", strange / "ca.pem")
    (near,) = [each for each in door.near if _listens(each)]
    for credentials in (None, credentials_of("operator", strange)):
        with pytest.raises(Exception, match="Unable to connect"):
            Holder(near, credentials, connect_ms=REFUSED)


async def test_after_a_renewal_who_is_near_comes_in_near_again(door: Door) -> None:
    session, _ = await door.enter(near=True)
    authority = Authority.load(door.certificates / "ca.pem", door.certificates / "ca.key")
    authority.issue("router", ["127.0.0.1"], 30, door.certificates / "router.pem", door.certificates / "router.key")
    renewed = [door.router.renew() for _ in range(2)]
    assert renewed == [False, True]
    before = door.near[1]
    await until(lambda: not _listens(before) and _listens(door.near[0]))
    await until(lambda: session.connected and not door.through_the_gate)
    session.close()


def test_router_goes_without_where_somebody_else_has_the_port(
    certificates: Path, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, near = f"tls/127.0.0.1:{free_port()}", free_endpoints(1)
    with ExitStack() as stack:
        stack.enter_context(socket.create_server(("127.0.0.1", int(near[0].rpartition(":")[2]))))
        with caplog.at_level(logging.WARNING):
            stack.enter_context(Router([endpoint], certificates, near=near))
        assert "services of this host connect through the gate" in caplog.text
        assert stack.enter_context(Holder(endpoint, credentials_of("operator", certificates))).connected


def test_supervisor_hands_down_where_the_router_of_its_domain_is_near(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENCELL_SECURE", "somewhere")
    launch = Launch("panda", domain=3, near=("tls/127.0.0.1:1", "tls/127.0.0.1:2"))
    environment = launch.environment({})
    assert nearby_endpoints("tls/127.0.0.1:7450", environment) == ["tls/127.0.0.1:1", "tls/127.0.0.1:2"]
    assert nearby_endpoints("tls/192.168.1.10:7450", environment) == [] == nearby_endpoints("tls/127.0.0.1:7450", {})
    assert launch.router_command()[-5:] == ["--near", "tls/127.0.0.1:1", "--near", "tls/127.0.0.1:2", "--gate"]
