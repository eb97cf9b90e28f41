"""What `run` and `up` make of a host's share in a cell."""

from __future__ import annotations

import pytest

from common.clock import EPOCH_VARIABLE
from common.config import load_cell
from common.errors import ConfigError, UnknownName
from common.supervision.launch import Launch
from common.supervision.multi_host import HostOptions
from common.transport.credentials import SECURE_VARIABLE
from common.transport.endpoint import LINK_VARIABLE, LISTEN_VARIABLE

CELL = load_cell("panda")
FAR = "tcp/192.168.1.10:7489"
PERCEPTION = ["camera_simulator", "vision_detector", "workspace_validator"]


@pytest.fixture(autouse=True)
def nothing_handed_down(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in (EPOCH_VARIABLE, LINK_VARIABLE, LISTEN_VARIABLE, SECURE_VARIABLE):
        monkeypatch.delenv(variable, raising=False)


def router_of(share: HostOptions) -> list[str]:
    """What the router is told beside its domain."""
    command = share.linked(Launch("panda")).router_command()
    return command[command.index("42") + 1:-1]


def names(share: HostOptions) -> list[str]:
    return [entry.name for entry in share.part_of(CELL).services.values()]


def test_only_and_without_are_two_halves_of_a_cell_in_start_order() -> None:
    text = " , ".join(reversed(PERCEPTION))
    assert names(HostOptions(only=[text])) == PERCEPTION
    assert names(HostOptions(without=PERCEPTION)) == [name for name in names(HostOptions()) if name not in PERCEPTION]
    assert names(HostOptions()) == [entry.name for entry in CELL.services.values()]


def test_bad_shares_are_refused_with_the_choices() -> None:
    with pytest.raises(UnknownName, match=r"--only 'vision_detektor'.*did you mean 'vision_detector'"):
        HostOptions(only=["vision_detektor"]).part_of(CELL)
    with pytest.raises(ConfigError, match="exclude each other"):
        HostOptions(only=["viewer"], without=["viewer"]).part_of(CELL)
    with pytest.raises(ConfigError, match="leaves no service"):
        HostOptions(without=names(HostOptions())).part_of(CELL)


def test_a_router_listens_for_its_own_host_and_beside_that_where_it_is_told_to() -> None:
    own = "tcp/127.0.0.1:7489"
    assert router_of(HostOptions()) == []
    assert router_of(HostOptions(listen=[FAR])) == ["--listen", own, "--listen", FAR]
    assert router_of(HostOptions(listen=["tcp/0.0.0.0:7489"])) == ["--listen", "tcp/0.0.0.0:7489"], "includes its own"
    assert router_of(HostOptions(listen=["tcp/0.0.0.0:7600"])) == ["--listen", own, "--listen", "tcp/0.0.0.0:7600"]


def test_a_router_is_linked_by_options_and_else_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LINK_VARIABLE, "tcp/a:1, tcp/b:2")
    assert router_of(HostOptions()) == ["--link", "tcp/a:1", "--link", "tcp/b:2"]
    assert router_of(HostOptions(link=[FAR])) == ["--link", FAR]


def test_endpoints_that_can_not_be_used_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"--link: '192\.168\.1\.10' must be an endpoint"):
        HostOptions(link=["192.168.1.10"]).linked(Launch("panda"))
    with pytest.raises(ConfigError, match="with --connect none is started"):
        HostOptions(link=[FAR]).linked(Launch("panda", connect=FAR))
    monkeypatch.setenv(SECURE_VARIABLE, "/certificates")
    with pytest.raises(ConfigError, match="must be tls/HOST:PORT"):
        HostOptions(listen=[FAR]).linked(Launch("panda"))


def test_hosts_of_a_fast_cell_need_one_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    assert HostOptions(only=["viewer"]).epoch(1.0) is None and HostOptions().epoch(3.0) is None
    with pytest.raises(ConfigError, match=r"--speed: 3.0 needs ZENCELL_EPOCH on several hosts"):
        HostOptions(only=["viewer"]).epoch(3.0)
    monkeypatch.setenv(EPOCH_VARIABLE, "1700000000000000000")
    assert HostOptions(only=["viewer"]).epoch(3.0) == 1_700_000_000_000_000_000
    monkeypatch.setenv(EPOCH_VARIABLE, "yesterday")
    with pytest.raises(ConfigError, match="nanoseconds"):
        HostOptions().epoch(1.0)
