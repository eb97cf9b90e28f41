"""Command lines, environment and location of the router that a cell is launched with."""

import json
import os
import socket
import sys
from pathlib import Path

import pytest

from common.clock import Clock
from common.config import ServiceEntry, load_cell
from common.errors import ConfigError, ZencellError
from common.supervision.launch import (
    OWN_MODULE,
    Launch,
    clock_at_speed,
    require_free_port,
    require_modules,
    router_location,
)
from common.transport.endpoint import remapped_small_keys

ENTRY = ServiceEntry(name="it", module="own.package.it")


def test_service_gets_all_options_of_the_launch_and_no_command_line_shows_an_override() -> None:
    launch = Launch("my.yaml", ("services.viewer.token=secret", "c=[2, 3]"), "w2", 5, 77)
    assert launch.service_command(ENTRY)[1:] == [
        "-P", str(OWN_MODULE), "-m", "own.package.it", "--cell", "my.yaml", "--world", "w2", "--seed", "5",
        "--domain", "77", "--gate"]
    assert json.loads(launch.environment({})["ZENCELL_SET"]) == ["services.viewer.token=secret", "c=[2, 3]"]
    assert "--set" in launch.service_command(ENTRY, gate=False), "for someone who starts it by hand"
    assert launch.router_command()[-3:] == ["--domain", "77", "--gate"]
    connected = Launch("panda", connect="tcp/10.0.0.1:7447", log_json=True).service_command(ENTRY)
    assert connected[-4:] == ["--connect", "tcp/10.0.0.1:7447", "--gate", "--log-json"]


def test_router_gets_the_small_keys_that_a_cell_renames() -> None:
    cell = load_cell(str(Path(__file__).parents[2] / "data" / "two_cameras.yaml"))
    small = remapped_small_keys(entry.topics for entry in cell.services.values())
    sides = [f"{side}/{key}" for side in ("left", "right") for key in ("camera/camera_info", "detected_objects")]
    assert set(sides) <= set(small) and not any("image" in key for key in small)
    assert Launch("my.yaml").router_command(small[:1])[-3:] == ["--small", small[0], "--gate"]
    assert remapped_small_keys(entry.topics for entry in load_cell("panda").services.values()) == []


def test_environment_passes_on_clock_and_module_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    clock = Clock(5.0)
    environment = Launch("panda", clock=clock).environment({"PYTHONPATH": "/opt/mine", "HOME": "/"})
    assert environment["HOME"] == "/"
    received = Clock.from_environment(environment)
    assert (received.speed, received.epoch_ns) == (5.0, clock.epoch_ns)
    project, *rest = environment["PYTHONPATH"].split(os.pathsep)
    assert (Path(project) / "common").is_dir()
    assert rest == ["/opt/mine"], "a stranger's sitecustomize.py in the working directory is not imported"


def test_options_for_the_router_take_precedence_over_the_environment() -> None:
    both = {"ZENCELL_DOMAIN": "7", "ZENCELL_CONNECT": "tcp/h:1"}
    given = ((None, None, {}), (None, None, {"ZENCELL_DOMAIN": "7"}), (None, None, both), ("9", None, both),
             ("9", "tcp/h:2", {}))
    assert [router_location(*each) for each in given] == [
        (42, None), (7, None), (42, "tcp/h:1"), (9, None), (42, "tcp/h:2")]
    with pytest.raises(ConfigError):
        router_location("233", None, {})


@pytest.mark.parametrize("speed", [0.0, 0.09, 10.1, -1.0, float("nan")])
def test_speed_out_of_bounds_is_refused(speed: float) -> None:
    with pytest.raises(ConfigError, match=r"--speed: .* must be 0.1 to 10"):
        clock_at_speed(speed)


def test_used_port_is_reported_with_its_process() -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        with pytest.raises(ZencellError, match=rf"port {port} .* in use by process {os.getpid()}"):
            require_free_port(f"tcp/127.0.0.1:{port}")
    require_free_port(f"tcp/127.0.0.1:{port}")


def test_missing_module_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    cell = load_cell("panda")
    require_modules(cell)
    wrong = cell.model_copy(update={"services": {"missing.it": ServiceEntry(name="it", module="missing.it")}})
    with pytest.raises(ConfigError, match=r"services\.missing\.it: 'missing\.it' is not a module"):
        require_modules(wrong)
