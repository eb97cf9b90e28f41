"""Where the page of a cell is to be, from what a person asked for."""

import hashlib
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from common.config import Cell, load_cell
from common.errors import ConfigError
from common.transport.credentials import SECURE_VARIABLE
from page.address import FIRST_PORT, plan_page
from security.page_tokens import TOKEN_VARIABLE
from tests.harness import Zencell, ask

OPTIONS = (("--viewer-port", "9000"), ("--viewer-host", "0.0.0.0"))


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    return cell_with(tmp_path, "{}")


def cell_with(folder: Path, parameters: str) -> Cell:
    file = folder / "viewed.yaml"
    file.write_text(
        "robot: panda\nworld: balls\npipeline: cartesian_ompl\ntask: last\n"
        f"services:\n  anywhere.viewer: {parameters}\n  anywhere.last: {{}}\n"
    )
    return load_cell(str(file))


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that somebody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def test_cell_without_a_viewer_has_no_page(cell: Cell) -> None:
    bare = cell.model_copy(update={"services": {}})
    assert plan_page(bare, None, None) is None


@pytest.mark.parametrize(("option", "value"), OPTIONS)
def test_option_for_a_page_that_there_is_not_is_refused(tmp_path: Path, option: str, value: str) -> None:
    done = ask(tmp_path, "up", "panda", "--no-viewer", option, value)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"zencell: {option}: {value!r} needs a cell with a viewer, and not --no-viewer\n"


def test_page_is_on_this_machine_alone_unless_asked_for_more(cell: Cell) -> None:
    page = plan_page(cell, None, None)
    assert page is not None
    port = int(page.url.rpartition(":")[2])
    assert page.url == f"http://127.0.0.1:{port}" and port >= FIRST_PORT
    assert page.overrides == (f"services.viewer.port={port}",)
    assert not page.environment


def test_next_free_port_is_taken_when_none_was_named(cell: Cell, monkeypatch: pytest.MonkeyPatch, taken: int) -> None:
    monkeypatch.setattr("page.address.FIRST_PORT", taken)
    monkeypatch.setattr("page.address.LAST_PORT", taken + 50)
    page = plan_page(cell, None, None)
    assert page is not None and taken < int(page.url.rpartition(":")[2]) <= taken + 50


def test_two_cells_that_come_up_at_the_same_time_have_pages_of_their_own(cell: Cell) -> None:
    one, other = plan_page(cell, None, None), plan_page(cell, None, None)
    assert one is not None and other is not None and one.url != other.url
    address = one.url
    del one
    again = plan_page(cell, None, None)
    assert again is not None and again.url == address


def test_no_free_port_is_said(cell: Cell, monkeypatch: pytest.MonkeyPatch, taken: int) -> None:
    monkeypatch.setattr("page.address.FIRST_PORT", taken)
    monkeypatch.setattr("page.address.LAST_PORT", taken)
    with pytest.raises(ConfigError, match=f"--viewer-port: ports {taken} to {taken} are all in use"):
        plan_page(cell, None, None)


def test_port_that_was_named_and_is_taken_is_refused_with_its_holder(cell: Cell, taken: int) -> None:
    with pytest.raises(ConfigError, match=f"--viewer-port: {taken} is in use by .*python"):
        plan_page(cell, None, str(taken))


def test_port_that_the_cell_names_and_that_is_taken_is_refused_too(tmp_path: Path, taken: int) -> None:
    with pytest.raises(ConfigError, match=f"services.viewer.port: {taken} is in use by .*python"):
        plan_page(cell_with(tmp_path, f"{{port: {taken}}}"), None, None)


@pytest.mark.parametrize("port", ["0", "65536", "-1", "80 80", "http", "²", ""])
def test_port_that_is_none_is_refused(cell: Cell, port: str) -> None:
    with pytest.raises(ConfigError, match=r"--viewer-port: .* must be a whole number from 1 to 65535"):
        plan_page(cell, None, port)


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])
def test_host_that_is_not_of_this_machine_is_refused(cell: Cell, host: str) -> None:
    with pytest.raises(ConfigError, match=f"services.viewer.host: '{host}' cannot listen at this address: "):
        plan_page(cell, host, None)


def test_beyond_this_machine_a_token_is_made_that_no_command_line_shows(cell: Cell) -> None:
    page, other = plan_page(cell, "0.0.0.0", None), plan_page(cell, "0.0.0.0", None)
    assert page is not None and other is not None
    token = page.environment[TOKEN_VARIABLE]
    assert len(token) > 40 and token != other.environment[TOKEN_VARIABLE]
    assert page.url.endswith(f"/?token={token}") and "0.0.0.0" not in page.url
    assert page.overrides[0] == "services.viewer.host=0.0.0.0"
    assert token not in repr(page.overrides)


def test_page_of_a_secured_cell_has_a_token_on_its_own_machine_too(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    open_page = plan_page(cell, None, None)
    assert open_page is not None and not open_page.environment
    monkeypatch.setenv(SECURE_VARIABLE, "certs")
    page = plan_page(cell, None, None)
    assert page is not None and page.url.endswith(f"/?token={page.environment[TOKEN_VARIABLE]}")


def test_token_that_a_person_gave_is_not_shown(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, "correct-horse-battery")
    page = plan_page(cell, "0.0.0.0", None)
    assert page is not None and "token" not in page.url and not page.environment


VIEWER = '''"""Says the fingerprint of the token that it was given, and serves nothing."""
import asyncio, hashlib, os
from common.config import Parameters
from common.process.service import main
from security.page_tokens import TOKEN_VARIABLE

class Config(Parameters):
    """Where."""
    host: str = ""
    port: int = 0

async def run(bus, config):
    bus.log.info("told %s", hashlib.sha256(os.environ.get(TOKEN_VARIABLE, "").encode()).hexdigest())
    await bus.ready()
    await asyncio.Event().wait()

if __name__ == "__main__":
    main(run, Config)
'''


def test_token_is_said_once_and_is_in_no_command_line_and_no_summary(
    folder: Path, zencell: Callable[..., Zencell]
) -> None:
    (folder / "fakes" / "viewer.py").write_text(VIEWER)
    (folder / "viewed.yaml").write_text((folder / "tiny.yaml").read_text() + "  fakes.viewer: {}\n")
    command = zencell("up", "viewed.yaml", "--viewer-host", "0.0.0.0", "--summary", "out.json")
    address = command.until("Open ").removeprefix("Open ")
    token = address.partition("/?token=")[2]
    command.until("zenoh --mode client")
    shown = [" ".join(process.cmdline()) for process in command.children().values()]
    assert any("services.viewer.host=0.0.0.0" in line for line in shown)
    command.interrupt()
    assert command.end() == 0
    assert any(hashlib.sha256(token.encode()).hexdigest() in line for line in command.lines)
    assert [line for line in command.lines if token in line] == [f"Open {address}"]
    assert not any(token in line for line in shown)
    assert token not in (folder / "out.json").read_text()
