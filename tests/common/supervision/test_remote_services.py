"""Services and notices of other hosts in the supervisor's status, and where they are shown."""

import asyncio
import io
from pathlib import Path
from types import SimpleNamespace

from rich.console import Console

from cli.top import render
from common import topics
from common.client.monitor import View
from common.config import load_cell
from common.messages import Notice, ServiceStatus, SupervisorStatus
from common.supervision.launch import Launch
from common.supervision.lifecycle import publish_status
from common.supervision.liveness_watchdog import MOST_ELSEWHERE, MOST_NOTICES, RemoteServices
from common.transport.codec import decode, encode
from common.transport.local import LocalNetwork
from page.diagnostics import HealthPanel
from page.server import close_server, make_server
from security.certificates import Authority

FAR = Notice(urgent=True, message="the certificate of panda.camera ends", host="camera")


def status_of(host: str, *services: tuple[str, str, str]) -> SupervisorStatus:
    listed = [ServiceStatus(name=name, host=of, state=state) for name, of, state in services]
    return SupervisorStatus(cell="toy", host=host, services=listed)


def test_services_of_another_host_are_reported_under_its_name_and_wait_behind_a_cut_link() -> None:
    remote = RemoteServices("arm", ["router", "motion_planner"])
    remote.update(status_of("camera", ("router", "camera", "ready"), ("vision_detector", "camera", "ready"),
                            ("motion_planner", "arm", "failed"), ("smart_pick_place", "third", "failed")))
    (other,) = remote.statuses({"vision_detector"})  # those that a supervisor passes on from others are ignored
    assert (other.name, other.host, other.state, other.message) == ("vision_detector", "camera", "ready", "")
    (gone,) = remote.statuses(set())
    assert (gone.state, gone.message) == ("waiting", "host camera is not reached")
    (own,) = remote.ours([ServiceStatus(name="motion_planner", state="ready")])
    assert own.host == "arm"


def test_invented_names_of_other_hosts_leave_room_for_our_own_services() -> None:
    remote, long = RemoteServices("arm", ["motion_planner"]), "\N{MATHEMATICAL BOLD CAPITAL A}"
    for number in range(12):
        host = f"{number:03}" + long * 117
        remote.update(SupervisorStatus(
            cell="toy", host=host, notices=[Notice(message=long * 4000, host=host)] * 30, services=[
                ServiceStatus(name=f"{number:03}{i:04}" + long * 113, host=host, state="waiting", message=long * 4000)
                for i in range(100)]))
    remote.update(status_of("camera", ("vision_detector", "camera", "ready")))
    own = [ServiceStatus(name=f"service_{i}", state="ready") for i in range(20)]
    status = SupervisorStatus(
        cell="toy", services=[*own, *remote.statuses({"vision_detector"})], notices=remote.notices)
    received = decode(SupervisorStatus, encode(status)).services
    assert len(received) == 20 + MOST_ELSEWHERE and received[-1].name == "vision_detector"
    assert len(remote.notices) <= MOST_NOTICES


def issue(folder: Path, days: float) -> None:
    authority = Authority.new(400)
    authority.write(folder / "ca.pem", folder / "ca.key")
    authority.issue("router", ["127.0.0.1"], days, folder / "router.pem", folder / "router.key")


async def test_expiring_certificates_are_reported_until_they_are_renewed(tmp_path: Path, monkeypatch) -> None:
    issue(tmp_path, 9.5)
    monkeypatch.setenv("ZENCELL_SECURE", str(tmp_path))
    net, changed = LocalNetwork(), asyncio.Event()
    supervisor = SimpleNamespace(mark_connected=lambda _: None, changed=changed, statuses=[])
    remote, reader = RemoteServices("arm", []), net.bus("tool").reader(topics.SUPERVISOR_STATUS)
    remote.update(SupervisorStatus(cell="test", host="camera", services=[], notices=[
        FAR, Notice(message="of the arm, as the camera's host received it", host="arm")]))
    publishing = asyncio.create_task(publish_status(
        net.bus("supervisor"), load_cell("panda"), Launch("panda"), supervisor, remote,  # type: ignore[arg-type]
        notice_period=0.0))
    own, far = (await asyncio.wait_for(reader.next(), 20)).notices
    assert far == FAR and (own.host, own.urgent) == ("arm", False)
    assert "the certificate of router" in own.message and f"`zencell secure renew {tmp_path}`" in own.message
    issue(tmp_path, 300)
    assert (await asyncio.wait_for(reader.next(), 20)).notices == [FAR]
    publishing.cancel()


def test_page_and_top_show_notices() -> None:
    status = SupervisorStatus(cell="test", services=[], notices=[FAR, Notice(message="<b>soon</b>\x1b[31m")])
    server = make_server("127.0.0.1", 0)
    try:
        panel = HealthPanel(server.gui, [])
        panel.show(status, frozenset())
        assert FAR.message in panel._html.content and "&lt;b&gt;soon" in panel._html.content
        panel.show(status.model_copy(update={"notices": []}), frozenset())
        assert FAR.message not in panel._html.content
    finally:
        close_server(server)
    view = View("panda", 1.0, True, 0.0, notices=[(each.urgent, each.message) for each in status.notices])
    console = Console(file=io.StringIO(), width=110)
    console.print(render(view))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert FAR.message in shown and "\x1b" not in shown and view.as_dict()["notices"][0] == (True, FAR.message)
