"""Services of the router's host connect at a listener of their own; a flood at one listener leaves the other open."""

import asyncio
import functools
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
from tests.domains import free_port
from tests.security.raw_client import REFUSAL_MS, RawClient, issue

SILENT = 150  # Zenoh without the gate accepts no client for 100 ms after each
WITHIN = 10.0  # [s] less than those 15 s, though a loaded machine takes seconds


class SecuredRouter:
    """A router with its TLS gate and its listeners for services of this host."""

    def __init__(self, certificates: Path) -> None:
        self.certificates = certificates
        self.endpoint, self.near = f"tls/127.0.0.1:{free_port()}", free_endpoints(2)
        self.process = Router([self.endpoint], certificates, near=self.near)

    @property
    def uses_gate(self) -> bool:
        return bool(self.process._gate._sockets)

    async def connect(self, *, near: bool) -> tuple[ZenohSession, float]:
        began = time.monotonic()
        camera = credentials_of("panda.camera_simulator", self.certificates)
        session = await open_zenoh(self.endpoint, camera, self.near if near else ())
        return session, time.monotonic() - began

    def operator(self) -> RawClient:
        return RawClient(self.endpoint, credentials_of("operator", self.certificates))


@pytest.fixture
def router(certificates: Path, tmp_path: Path):
    router = SecuredRouter(Path(shutil.copytree(certificates, tmp_path / "certificates")))
    with router.process:
        yield router


def connections(ports: list[str]) -> list[socket.socket]:
    return [socket.create_connection(("127.0.0.1", int(each.rpartition(":")[2]))) for each in ports]


def listens(endpoint: str) -> bool:
    try:
        connections([endpoint])[0].close()
    except ConnectionRefusedError:
        return False
    return True


@pytest.mark.slow
async def test_local_client_bypasses_the_gate_and_has_the_rights_of_its_certificate(router: SecuredRouter) -> None:
    session, _ = await router.connect(near=True)
    assert session.connected and not router.uses_gate and len(session._session.info.links()) == len(LINKS)
    far, _ = await router.connect(near=False)
    assert far.connected and router.uses_gate
    keys = "panda/joint_states", "panda/camera/camera_info"
    publishers = [session.publisher(key, "", reliable=True) for key in keys]
    with router.operator() as operator:
        received = operator.subscribe("panda/**")
        received.repeat(lambda: [each.put(b"by the camera", b"") for each in publishers])
        assert received.keys == {"panda/camera/camera_info"}
    for each in (session, far):
        each.close()


async def test_late_subscriber_receives_from_a_local_writer_with_any_expression(router: SecuredRouter) -> None:
    for expression in ("panda/camera/camera_info", "panda/camera/*", "panda/**", "*/camera/**"):
        writer, _ = await router.connect(near=True)
        publisher, answered = writer.publisher("panda/camera/camera_info", "", reliable=True), asyncio.Event()
        done = functools.partial(asyncio.get_running_loop().call_soon_threadsafe, answered.set)
        # The reply comes after all earlier declarations: the router knows by then that there is no subscriber.
        writer.get_tokens("panda/alive/*", lambda _: None, done, timeout=WITHIN)
        await answered.wait()
        assert not publisher.matched
        with router.operator() as operator:
            received = operator.subscribe(expression)
            received.repeat(lambda: publisher.put(b"by the camera", b""))  # noqa: B023
            assert received.keys == {"panda/camera/camera_info"}
        writer.close()


@pytest.mark.parametrize("flooded", [pytest.param("near", marks=pytest.mark.slow), "gate"])
async def test_silent_connections_at_one_listener_block_no_client_at_any(router: SecuredRouter, flooded: str) -> None:
    listening = [each for each in router.near if listens(each)]
    assert len(listening) == 1
    silent = connections((listening if flooded == "near" else [router.endpoint]) * SILENT)
    for state in ("while the silent ones are open", "after the silent ones have closed"):
        for near in (True, False):
            session, took = await router.connect(near=near)
            assert took < WITHIN + (NEAR_MS / 1000 if near else 0), (state, near)
            session.close()
        for each in silent:
            each.close()


@pytest.mark.slow
async def test_local_listener_refuses_invalid_certificates(router: SecuredRouter, tmp_path: Path) -> None:
    foreign = issue(Authority.new(10), "operator", tmp_path)
    shutil.copy(router.certificates / "ca.pem", foreign.authority)
    (near,) = [each for each in router.near if listens(each)]
    for credentials in (None, foreign):
        with pytest.raises(Exception, match="Unable to connect"):
            RawClient(near, credentials, connect_ms=REFUSAL_MS)


async def test_local_client_reconnects_locally_after_a_renewal(router: SecuredRouter) -> None:
    session, _ = await router.connect(near=True)
    authority = Authority.load(router.certificates / "ca.pem", router.certificates / "ca.key")
    issue(authority, "router", router.certificates, 30, hosts=["127.0.0.1"])
    assert [router.process.renew() for _ in range(2)] == [False, True]
    before = router.near[1]
    await until(lambda: not listens(before) and listens(router.near[0]))
    await until(lambda: session.connected and not router.uses_gate)
    session.close()


def test_router_starts_without_its_local_listener_if_the_port_is_taken(certificates: Path, caplog) -> None:
    endpoint, near = f"tls/127.0.0.1:{free_port()}", free_endpoints(1)
    with ExitStack() as stack:
        stack.enter_context(socket.create_server(("127.0.0.1", int(near[0].rpartition(":")[2]))))
        with caplog.at_level(logging.WARNING):
            stack.enter_context(Router([endpoint], certificates, near=near))
        assert "services of this host connect through the gate" in caplog.text
        assert stack.enter_context(RawClient(endpoint, credentials_of("operator", certificates))).connected


def test_supervisor_passes_the_local_listeners_of_its_router_to_services(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENCELL_SECURE", "somewhere")
    near = ["tls/127.0.0.1:1", "tls/127.0.0.1:2"]
    launch = Launch("panda", domain=3, near=tuple(near))
    environment = launch.environment({})
    assert nearby_endpoints("tls/127.0.0.1:7450", environment) == near
    assert nearby_endpoints("tls/192.168.1.10:7450", environment) == [] == nearby_endpoints("tls/127.0.0.1:7450", {})
    assert launch.router_command()[-5:] == ["--near", near[0], "--near", near[1], "--gate"]
