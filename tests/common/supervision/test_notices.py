"""Certificates that end soon are told of with the state of the processes, of all hosts, and shown where that is."""

from __future__ import annotations

import asyncio
import io
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from common import topics
from common.client.tables import render
from common.client.watching import View
from common.config import load_cell
from common.messages import Notice, SupervisorStatus
from common.supervision import operation
from common.supervision.launch import Launch
from common.supervision.liveness_watchdog import Elsewhere
from common.transport.local import LocalNetwork
from page.diagnostics import HealthPanel
from page.server import close_server, make_server
from security.certificates import Authority

FAR = Notice(urgent=True, message="the certificate of panda.camera ends", host="camera")


def issue(folder: Path, days: float) -> None:
    authority = Authority.new(400)
    authority.write(folder / "ca.pem", folder / "ca.key")
    authority.issue("router", ["127.0.0.1"], days, folder / "router.pem", folder / "router.key")


async def test_supervisor_tells_of_certificates_that_end_until_they_are_renewed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    issue(tmp_path, 9.5)
    monkeypatch.setenv("ZENCELL_SECURE", str(tmp_path))
    monkeypatch.setattr(operation, "NOTICE_PERIOD", 0.0)
    net, changed = LocalNetwork(), asyncio.Event()
    supervisor = SimpleNamespace(mark_connected=lambda _: None, changed=changed, statuses=[])
    elsewhere, heard = Elsewhere("arm", []), net.bus("tool").reader(topics.SUPERVISOR_STATUS)
    elsewhere.hear(SupervisorStatus(cell="test", host="camera", services=[], notices=[
        FAR, Notice(message="of the arm, as the camera's heard it", host="arm")]))
    publishing = asyncio.create_task(operation._publish(
        net.bus("supervisor"), load_cell("panda"), Launch("panda"), supervisor, elsewhere))  # type: ignore[arg-type]
    own, far = (await asyncio.wait_for(heard.next(), 20)).notices
    assert far == FAR and (own.host, own.urgent) == ("arm", False)
    assert "the certificate of router ends on" in own.message and f"`zencell secure renew {tmp_path}`" in own.message
    issue(tmp_path, 300)
    assert (await asyncio.wait_for(heard.next(), 20)).notices == [FAR]
    publishing.cancel()


def test_page_and_top_show_them(monkeypatch: pytest.MonkeyPatch) -> None:
    said = SupervisorStatus(cell="test", services=[], notices=[FAR, Notice(message="<b>soon</b>\x1b[31m")])
    server = make_server("127.0.0.1", 0)
    try:
        panel = HealthPanel(server.gui, [])
        panel.show(said, frozenset())
        assert FAR.message in panel._html.content and "&lt;b&gt;soon" in panel._html.content
        panel.show(said.model_copy(update={"notices": []}), frozenset())
        assert FAR.message not in panel._html.content
    finally:
        close_server(server)
    view = View("panda", 1.0, True, 0.0, notices=[(each.urgent, each.message) for each in said.notices])
    console = Console(file=io.StringIO(), width=110)
    console.print(render(view))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert FAR.message in shown and "\x1b" not in shown and view.as_dict()["notices"][0] == (True, FAR.message)
