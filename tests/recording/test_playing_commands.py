"""Recorded commands of motion: a running cell does not receive them, unless an operator says so for each key."""

from pathlib import Path

import pytest

from common.messages import JogCommand
from common.transport.endpoint import endpoint_of
from common.transport.local import LocalNetwork
from common.transport.router import open_router
from recording.player import Player
from recording.reader import Recording
from tests.harness import ask, free_domain
from tests.recording.samples import START, STEP, joints, packed, write


def jog(number: int, key: str = "panda/motion/jog"):
    payload = packed(JogCommand(owner="ann", joints={"a": 0.3}))
    return joints(number, key=key, payload=payload, message="JogCommand", log_time=START + number * STEP)


@pytest.mark.parametrize(("key", "is_live", "into_live", "played"), [
    ("motion/jog", True, (), 0),
    ("test/jog", True, (), 0),  # played as motion/jog
    ("left/jog", True, (), 0),  # as a cell may have remapped it
    ("motion/jog", True, ("motion/jog",), 3),
    ("motion/jog", False, (), 3),
])
async def test_commands_reach_no_running_cell(tmp_path: Path, key, is_live, into_live, played) -> None:
    path = write(tmp_path / "a.mcap", [joints(0), *(jog(number, f"panda/{key}") for number in (1, 2, 3))])
    net = LocalNetwork()
    bus, listener = net.bus("player", cell="panda"), net.bus("listener", cell="panda")
    jogs, states = [], []
    for name in ("motion/jog", "left/jog"):
        listener.raw_subscriber(f"panda/{name}", jogs.append)
    listener.raw_subscriber("panda/joint_states", states.append)
    with Recording(path) as recording:
        player = Player(recording, lambda topic: True, lambda topic: topic.replace("test/jog", "motion/jog"),
                        into_live=into_live, rate=100)
        player.is_live = lambda: is_live
        player.declare(bus, recording.topics())
        await player.run()
    await bus.close()
    await listener.close()
    assert (len(jogs), len(states), player.left_out.total()) == (played, 1, 3 - played)


def test_play_says_what_it_leaves_out_where_a_router_runs_and_asks_before_it_publishes_that(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", [joints(0), jog(1)])
    domain = free_domain()
    play = ("play", "a.mcap", "--domain", str(domain))
    session = open_router([endpoint_of(str(domain), None)])
    try:
        done = ask(tmp_path, *play, "--stamp-now")
        assert (done.returncode, done.stderr.count("\n")) == (0, 1)
        assert done.stderr.startswith("left out 1 of motion/jog: ") and "played 1 messages" in done.stdout
    finally:
        session.close()
    for key, error in (("motion/jog", "needs a terminal"), ("joint_states", "is no command that is played; played "
                                                            "commands: motion/jog")):
        done = ask(tmp_path, *play, "--into-live", key)
        assert done.returncode == 2 and error in done.stderr and done.stderr.count("\n") == 1
