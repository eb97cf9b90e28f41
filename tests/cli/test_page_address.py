"""Address and token of the page of a cell, from the options of `run` and `up`."""

import hashlib
import socket
from pathlib import Path

import pytest

from common.config import Cell, load_cell
from common.errors import ConfigError
from common.transport.credentials import SECURE_VARIABLE
from page.address import FIRST_PORT, PageAddress, plan_page
from security.page_tokens import TOKEN_VARIABLE


def cell_with(folder: Path, parameters: str = "{}") -> Cell:
    file = folder / "viewed.yaml"
    file.write_text("robot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: last\n"
                    f"services:\n  anywhere.viewer: {parameters}\n  anywhere.last: {{}}\n")
    return load_cell(str(file))


@pytest.fixture
def cell(tmp_path, monkeypatch):
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    return cell_with(tmp_path)


@pytest.fixture
def taken():
    """A port on which a server listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def planned(cell: Cell, host: str | None = None, port: str | None = None) -> PageAddress:
    page = plan_page(cell, host, port)
    assert page is not None
    return page


def test_cell_without_a_viewer_has_no_page(cell):
    assert plan_page(cell.model_copy(update={"services": {}}), None, None) is None


def test_page_is_local_by_default_and_each_cell_has_a_free_port(cell, monkeypatch):
    page, other = planned(cell), planned(cell)
    port = int(page.url.rpartition(":")[2])
    assert page.url == f"http://127.0.0.1:{port}" != other.url and port >= FIRST_PORT
    assert page.overrides == (f"services.viewer.port={port}",) and not page.environment
    url = page.url
    monkeypatch.setattr("page.address.FIRST_PORT", port)  # lower ones become free as other cells end
    del page
    assert planned(cell).url == url, "the port of a cell that ended is free again"


def test_next_free_port_is_used_up_to_the_last(cell, monkeypatch, taken):
    monkeypatch.setattr("page.address.FIRST_PORT", taken)
    monkeypatch.setattr("page.address.LAST_PORT", taken + 50)
    assert taken < int(planned(cell).url.rpartition(":")[2]) <= taken + 50
    monkeypatch.setattr("page.address.LAST_PORT", taken)
    with pytest.raises(ConfigError, match=f"--viewer-port: ports {taken} to {taken} are all in use"):
        plan_page(cell, None, None)


def test_port_in_use_is_rejected_with_its_process(cell, tmp_path, taken):
    with pytest.raises(ConfigError, match=f"--viewer-port: {taken} is in use by .*python"):
        plan_page(cell, None, str(taken))
    with pytest.raises(ConfigError, match=f"services.viewer.port: {taken} is in use by .*python"):
        plan_page(cell_with(tmp_path, f"{{port: {taken}}}"), None, None)


@pytest.mark.parametrize("port", ["0", "65536", "-1", "80 80", "http", "²", ""])
def test_invalid_port_is_rejected(cell, port):
    with pytest.raises(ConfigError, match=r"--viewer-port: .* must be a whole number from 1 to 65535"):
        plan_page(cell, None, port)


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])
def test_address_of_another_machine_is_rejected(cell, host):
    with pytest.raises(ConfigError, match=f"services.viewer.host: '{host}' cannot listen at this address: "):
        plan_page(cell, host, None)


def test_page_on_the_network_and_of_a_secured_cell_gets_a_new_token(cell, monkeypatch):
    pages = [planned(cell, "0.0.0.0"), planned(cell, "0.0.0.0")]
    monkeypatch.setenv(SECURE_VARIABLE, "certs")
    pages.append(planned(cell))
    tokens = [page.environment[TOKEN_VARIABLE] for page in pages]
    assert len(set(tokens)) == 3 and min(map(len, tokens)) > 40
    for page, token in zip(pages, tokens, strict=True):
        assert page.url.endswith(f"/?token={token}") and token not in repr(page.overrides)
    assert "0.0.0.0" not in pages[0].url and pages[0].overrides[0] == "services.viewer.host=0.0.0.0"


def test_token_from_the_environment_is_not_shown(cell, monkeypatch):
    monkeypatch.setenv(TOKEN_VARIABLE, "correct-horse-battery")
    page = planned(cell, "0.0.0.0")
    assert "token" not in page.url and not page.environment


def test_token_is_printed_once_and_is_in_no_command_line_and_no_summary(folder, zencell):
    file = folder / "tiny.yaml"
    file.write_text(file.read_text().replace("services: {", "services: {tests.cli.fakes.viewer: {}, "))
    command = zencell("up", "tiny.yaml", "--viewer-host", "0.0.0.0", "--summary", "out.json")
    address = command.until("Open ").removeprefix("Open ")
    token = address.partition("/?token=")[2]
    command.until("zenoh --mode client")
    shown = [" ".join(process.cmdline()) for process in command.children().values()]
    assert not any("services.viewer" in line for line in shown)
    command.interrupt()
    assert command.end() == 0
    assert any(hashlib.sha256(token.encode()).hexdigest() in line for line in command.lines)
    assert [line for line in command.lines if token in line] == [f"Open {address}"]
    assert not any(token in line for line in shown)
    assert token not in (folder / "out.json").read_text()
