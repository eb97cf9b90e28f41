"""Options of `run` and `up` for a cell on several hosts."""

import pytest

from common.clock import EPOCH_VARIABLE
from common.config import load_cell
from common.errors import ConfigError, UnknownName
from common.supervision.launch import Launch
from common.supervision.multi_host import HostOptions
from common.transport.credentials import SECURE_VARIABLE
from common.transport.endpoint import LINK_VARIABLE, LISTEN_VARIABLE

CELL = load_cell("panda")
OWN, FAR = "tcp/127.0.0.1:7489", "tcp/192.168.1.10:7489"
PERCEPTION = ["camera_simulator", "vision_detector", "workspace_validator"]
ALL = [entry.name for entry in CELL.services.values()]


@pytest.fixture(autouse=True)
def _no_variables(monkeypatch):
    for variable in (EPOCH_VARIABLE, LINK_VARIABLE, LISTEN_VARIABLE, SECURE_VARIABLE):
        monkeypatch.delenv(variable, raising=False)


def names(options: HostOptions) -> list[str]:
    return [entry.name for entry in options.part_of(CELL).services.values()]


def test_only_and_without_divide_a_cell_in_start_order():
    assert names(HostOptions()) == ALL
    assert names(HostOptions(only=[" , ".join(reversed(PERCEPTION))])) == PERCEPTION
    assert names(HostOptions(without=PERCEPTION)) == [name for name in ALL if name not in PERCEPTION]


@pytest.mark.parametrize(("options", "linked", "links"), [
    (HostOptions(), [], ""),
    (HostOptions(listen=[FAR]), ["--listen", OWN, "--listen", FAR], ""),
    (HostOptions(listen=["tcp/0.0.0.0:7489"]), ["--listen", "tcp/0.0.0.0:7489"], ""),  # includes its own
    (HostOptions(listen=["tcp/0.0.0.0:7600"]), ["--listen", OWN, "--listen", "tcp/0.0.0.0:7600"], ""),
    (HostOptions(), ["--link", "tcp/a:1", "--link", "tcp/b:2"], "tcp/a:1, tcp/b:2"),
    (HostOptions(link=[FAR]), ["--link", FAR], "tcp/a:1, tcp/b:2"),
])
def test_router_listens_for_its_host_and_is_linked_by_options_or_the_environment(options, linked, links, monkeypatch):
    if links:
        monkeypatch.setenv(LINK_VARIABLE, links)
    command = options.linked(Launch("panda")).router_command()
    assert command[command.index("42") + 1:-1] == linked


@pytest.mark.parametrize(("options", "variables", "reason"), [
    (HostOptions(only=["vision_detektor"]), {}, r"--only 'vision_detektor'.*did you mean 'vision_detector'"),
    (HostOptions(only=["viewer"], without=["viewer"]), {}, "exclude each other"),
    (HostOptions(without=ALL), {}, "leaves no service"),
    (HostOptions(link=["192.168.1.10"]), {}, r"--link: '192\.168\.1\.10' must be an endpoint"),
    (HostOptions(only=["viewer"]), {}, r"--speed: 3.0 needs ZENCELL_EPOCH on several hosts"),
    (HostOptions(), {EPOCH_VARIABLE: "yesterday"}, "nanoseconds"),
])
def test_bad_options_are_rejected(options, variables, reason, monkeypatch):
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    with pytest.raises((ConfigError, UnknownName), match=reason):
        options.part_of(CELL)
        options.linked(Launch("panda"))
        options.epoch(3.0)


def test_link_needs_a_router_of_this_host():
    with pytest.raises(ConfigError, match="with --connect none is started"):
        HostOptions(link=[FAR]).linked(Launch("panda", connect=FAR))


def test_epoch_comes_from_the_environment(monkeypatch):
    assert HostOptions(only=["viewer"]).epoch(1.0) is None and HostOptions().epoch(3.0) is None
    monkeypatch.setenv(EPOCH_VARIABLE, "1700000000000000000")
    assert HostOptions(only=["viewer"]).epoch(3.0) == 1_700_000_000_000_000_000
