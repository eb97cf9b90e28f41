"""Measure a policy in the complete cell policy_panda: all its services, on the virtual clock.

    python -m examples.policy.evaluate_cell pick_ball.onnx --layouts 100

The layouts and the success are those of `examples.policy.evaluate`: a ball that is held and 0.1 m higher within 20 s of
cell time after the task has started. The clock stops while a service computes, so inference and proof take no time.
"""

import argparse
import json
from pathlib import Path

from common import topics
from common.config import Cell, load_cell
from common.transport.bus import Bus
from examples.policy.evaluate import LIMIT, interval, write_figures
from examples.policy.simulated_pick import LIFTED
from lab.simulation import Simulation

CELL = "policy_panda"
TOOL = 0.15  # [m] height of the tool at which the task is done: the ball is 0.12 m above where it was
START = 10.0  # [s] for the services


def cell_of(policy: str, seed: int) -> Cell:
    """Return the cell with a layout of the ball and a policy: `scripted`, or a network by its file."""
    source = '{callable: "examples.policy.scripted:policy"}' if policy == "scripted" else (
        f"{{onnx: {json.dumps(str(Path(policy).resolve()))}}}")
    return load_cell(CELL, [f"services.policy_runner.source={source}", f"services.policy_runner.seconds={LIMIT}",
                            f"services.policy_runner.until={{holding: true, height: {TOOL}}}"], seed=seed)


def attempt(policy: str, seed: int) -> dict:
    """Return the result of one layout."""
    lifted: list[float] = []  # [s] cell time at which the ball was high enough

    async def watch(bus: Bus) -> None:
        began, truth = bus.clock.now(), bus.reader(topics.SCENE_OBJECTS)
        height = None
        async for state in truth:
            ball = state.objects[0]
            height = ball.pose.position.z if height is None else height
            now = state.header.stamp * 1e-9 - began
            if ball.state == "held" and ball.pose.position.z - height >= LIFTED and now <= LIMIT:
                lifted.append(now)
            if lifted or now > LIMIT:
                return

    simulation = Simulation(cell_of(policy, seed), seed, limit=START + LIMIT, visit=watch)
    outcome = simulation.run()
    return {"seed": seed, "success": bool(lifted), "seconds": round(lifted[0], 2) if lifted else None,
            "state": outcome.state, "message": outcome.message, "broken": outcome.broken, "crashes": outcome.crashes}


def main() -> None:
    """Evaluate, and print the failures and the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="scripted, or an .onnx file with its card")
    parser.add_argument("--layouts", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="seed of the first layout; demonstrations begin at 100000")
    parser.add_argument("--card", action="store_true", help="write the figures to the card of the network")
    given = parser.parse_args()
    results = []
    for seed in range(given.first, given.first + given.layouts):
        results.append(attempt(given.policy, seed))
        if not results[-1]["success"] or results[-1]["broken"] or results[-1]["crashes"]:
            print(json.dumps(results[-1]), flush=True)
        if len(results) % 10 == 0:
            print(f"{sum(each['success'] for each in results)} of {len(results)}", flush=True)
    done = [each for each in results if each["success"]]
    low, high = interval(len(done), len(results))
    figures = {"layouts": len(results), "successes": len(done), "interval": [round(low, 3), round(high, 3)],
               "median_seconds": sorted(each["seconds"] for each in done)[len(done) // 2] if done else None,
               "runs_with_broken_invariants": sum(bool(each["broken"]) for each in results)}
    print(json.dumps(figures))
    if given.card:
        last = given.first + given.layouts - 1
        write_figures(given.policy, f"layouts {given.first} to {last}, complete cell", figures)


if __name__ == "__main__":
    main()
