"""Paired test of scorers: each chooses a grasp in the same scenes, which is tried under the same conditions."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from applications.sorting.grasps.candidates import Candidates
from applications.sorting.learning.data import grasps_of
from applications.sorting.learning.floating import Outcome, PhysicalObject
from applications.sorting.learning.learned import NUMBERS, learned_score
from applications.sorting.learning.network import SHIPPED, Network
from applications.sorting.learning.scenes import Rig, Seen, draw_conditions, fallen, perceive, rig_of
from applications.sorting.objects.kinds import TEST_KINDS, draw
from applications.sorting.objects.others import from_file, mesh_files
from common.errors import ConfigError

Array = npt.NDArray[np.float64]
Choice = Callable[[Rig, Seen, Candidates, np.random.Generator], Array]
ObjectSource = Callable[[np.random.Generator, int, int], Sequence[PhysicalObject]]

PROCESSES = 2
FIRST_SCENE = 1_000_000  # numbers of scenes that no data is made of
Z95 = 1.959964  # quantile of the normal distribution for 95 %


@dataclass(frozen=True)
class Job:
    """What is evaluated.

    Attributes:
        cell, overrides: whose tray, camera and gripper.
        network: file of the learned scorer; None: the included one, if there is one.
        force: of each finger [N].
        error: of the pose, in multiples of the cell's.
        count: objects in a scene.
        seed: of the scenes.
        meshes: folder of the objects; None: test kinds.
    """

    cell: str
    overrides: tuple[str, ...]
    network: str | None
    force: float
    error: float
    count: int
    seed: int
    meshes: str | None = None


@dataclass(frozen=True)
class Trial:
    """The outcome of each scorer in a scene; empty: no candidates."""

    scene: int
    kind: str
    results: Mapping[str, str]


def scorers(network: Network | None) -> dict[str, Choice]:
    """Return the scorers by name; each gives (n,) scores."""
    found: dict[str, Choice] = {
        "random": lambda rig, seen, grasps, rng: rng.random(len(grasps)),
        "geometric": lambda rig, seen, grasps, rng: grasps.score,
    }
    if network is not None:
        found["learned"] = lambda rig, seen, grasps, rng: learned_score(
            network, grasps, seen.surface, rig.shape.T_tcp_closing)
    return found


def trial(rig: Rig, choices: Mapping[str, Choice], job: Job, number: int, source: ObjectSource) -> Trial | None:
    """Let each scorer choose a grasp in a scene and try it; None if the objects do not come to rest in the tray."""
    rng = np.random.default_rng((job.seed, FIRST_SCENE + number))
    objects = source(rng, number, job.count)
    bench = fallen(rig, objects, rng) if objects else None
    if bench is None:
        return None
    seen = perceive(rig, bench, rng)
    found = grasps_of(rig, seen, rng)
    conditions = draw_conditions(rng, job.force, error=job.error)
    own = np.random.default_rng((job.seed, number, 1))
    results = dict.fromkeys(choices, "no candidate")
    if len(found):
        tried: dict[int, Outcome] = {}  # scorers often agree
        for name, choice in choices.items():
            best = int(np.argmax(choice(rig, seen, found, own)))
            if best not in tried:
                tried[best] = bench.attempt(found.T[best], float(found.opening[best]), conditions)
            results[name] = tried[best].result
    return Trial(number, str(getattr(objects[0], "kind", "")), results)





def source_of(meshes: str | None) -> ObjectSource:
    """Return what draws the objects of a scene: test kinds in turn, or the meshes of a folder in turn.

    Raises:
        ConfigError: the folder has no usable mesh.
    """
    if meshes is not None:
        return _of_meshes(Path(meshes))
    names = list(TEST_KINDS)
    return lambda rng, number, count: [draw(names[(number + k) % len(names)], rng) for k in range(count)]


def _of_meshes(folder: Path) -> ObjectSource:
    """Return what reads the meshes of a folder in turn; those that cannot be simulated are left out."""
    try:
        files = mesh_files(folder)
    except ConfigError as error:
        raise ConfigError("--meshes", error.value, error.expected) from None

    def read(rng: np.random.Generator, number: int, count: int) -> Sequence[PhysicalObject]:
        found: list[PhysicalObject] = []
        for path in (files[(number * count + k) % len(files)] for k in range(count)):
            with suppress(ConfigError):
                found.append(from_file(path, rng))
        return found

    return read


def evaluate(job: Job, scenes: int, processes: int = PROCESSES) -> Iterator[Trial]:
    """Yield the trials of a number of scenes; the same for any number of processes.

    Raises:
        ConfigError: the cell, the network or the meshes cannot be used.
    """
    rig_of(job.cell, job.overrides)
    _network_of(job)
    source_of(job.meshes)
    with multiprocessing.get_context("spawn").Pool(processes, _start, (job,)) as pool:
        for found in pool.imap(_trial, range(scenes), chunksize=4):
            if found is not None:
                yield found


_state: tuple[Rig, dict[str, Choice], Job, ObjectSource] | None = None  # of a process of the pool


def _start(job: Job) -> None:
    global _state  # noqa: PLW0603
    import cv2

    cv2.setNumThreads(1)
    _state = rig_of(job.cell, job.overrides), scorers(_network_of(job)), job, source_of(job.meshes)


def _network_of(job: Job) -> Network | None:
    if job.network is not None:
        return Network.load(Path(job.network), NUMBERS)
    return Network.load(SHIPPED, NUMBERS) if SHIPPED.exists() else None


def _trial(number: int) -> Trial | None:
    assert _state is not None
    rig, choices, job, source = _state
    return trial(rig, choices, job, number, source)


def wilson(held: int, count: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a fraction; (0, 1) without tries."""
    if count == 0:
        return 0.0, 1.0
    p, z = held / count, Z95
    middle, half = p + z * z / (2 * count), z * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    scale = 1 + z * z / count
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def mcnemar(only_first: int, only_second: int) -> float:
    """Return the exact two-sided p of McNemar's test: that discordant pairs are as likely either way."""
    count, least = only_first + only_second, min(only_first, only_second)
    if count == 0:
        return 1.0
    tail = sum(math.comb(count, k) for k in range(least + 1))
    return float(min(1.0, 2 * tail / 2**count))


def table(trials: Sequence[Trial]) -> str:
    """Return a table of the scorers, and the paired tests of each against the geometric one."""
    if not trials:
        return "no scene came to rest"
    names = list(trials[0].results)
    held = {name: np.array([each.results[name] == "held" for each in trials]) for name in names}
    lines = [f"{'scorer':<12}{'held':>12}{'%':>8}   95 % interval"]
    for name in names:
        count, total = int(held[name].sum()), len(trials)
        low, high = (100 * limit for limit in wilson(count, total))
        lines.append(f"{name:<12}{f'{count} of {total}':>12}{100 * count / total:8.1f}   {low:.1f} to {high:.1f}")
    for name in names:
        if name != "geometric":
            more = int((held[name] & ~held["geometric"]).sum())
            fewer = int((~held[name] & held["geometric"]).sum())
            lines.append(f"{name} held {more} that geometric did not, geometric {fewer} that {name} did not: "
                         f"McNemar p = {mcnemar(more, fewer):.3g}")
    failures: dict[str, dict[str, int]] = {}
    for each in trials:
        for name, result in each.results.items():
            counts = failures.setdefault(name, {})
            counts[result] = counts.get(result, 0) + 1
    lines += [f"{name}: " + ", ".join(f"{count} {result}" for result, count in sorted(counts.items()))
              for name, counts in failures.items()]
    return "\n".join(lines)
