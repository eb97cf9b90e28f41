"""Tries grasps on random scenes and stores what was seen and whether they held.

A scene depends on the seed and its number alone. Scenes are stored in groups as they are finished, so that an
interrupted run continues, and several processes share the work.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from applications.sorting.grasps.candidates import Candidates, Options, candidates
from applications.sorting.grasps.height_map import Walls
from applications.sorting.learning.learned import NUMBERS, numbers_of
from applications.sorting.learning.patches import patches_of
from applications.sorting.learning.scenes import Rig, Seen, draw_conditions, fallen, perceive, rig_of
from applications.sorting.learning.tries import Tries
from applications.sorting.objects.kinds import TRAIN_KINDS, draw
from common.errors import ConfigError

HEAPS = (1, 1, 1, 5, 10)  # numbers of objects, drawn with equal probability
TRIES = {1: 10, 5: 12, 10: 12}  # of a scene
GROUP = 20  # scenes of a file
PROCESSES = 2
FORCE = 20.0  # [N]
# Harder than the cell: where almost all candidates hold, nothing can be learned about their order.
FRICTIONS = (0.08, 0.6)
MASSES = (0.1, 0.8)  # [kg]
ERRORS = (0.0, 3.0)  # of the pose, in multiples of the cell's
LOOSE = Options(alignment=0.6, purity=0.75, engagement=0.004)  # of candidates in every other scene


def grasps_of(rig: Rig, seen: Seen, rng: np.random.Generator, options: Options | None = None) -> Candidates:
    """Return the candidates for the objects in the tray, the best first; by default those of the cell."""
    walls = Walls.of(rig.tray, rig.around.table_height)
    return candidates(seen.surface, seen.labels, rig.shape, options or Options(), rng, [walls])


def tries_of_scene(rig: Rig, seed: int, number: int) -> Tries | None:
    """Try random candidates of one scene; None without objects at rest or candidates."""
    rng = np.random.default_rng((seed, number))
    count = int(rng.choice(HEAPS))
    objects = [draw(str(rng.choice(list(TRAIN_KINDS))), rng, MASSES) for _ in range(count)]
    bench = fallen(rig, objects, rng)
    if bench is None:
        return None
    seen = perceive(rig, bench, rng)
    found = grasps_of(rig, seen, rng, LOOSE if number % 2 else None)
    if len(found) == 0:
        return None
    found = found.select(_chosen(len(found), TRIES[count], rng))
    results, frictions = [], []
    for T, opening in zip(found.T, found.opening, strict=True):
        conditions = draw_conditions(rng, FORCE, error=float(rng.uniform(*ERRORS)), frictions=FRICTIONS)
        results.append(bench.attempt(T, float(opening), conditions))
        frictions.append(conditions.friction)
    n = len(found)
    return Tries(
        patches=patches_of(seen.surface, np.asarray(found.T @ rig.shape.T_tcp_closing)).astype(np.float16),
        numbers=numbers_of(found, seen.surface.floor),
        parts=np.column_stack(list(found.parts.values())).astype(np.float32), score=found.score.astype(np.float32),
        held=np.array([each.held for each in results]), result=np.array([each.result for each in results]),
        scene=np.full(n, number), count=np.full(n, count), friction=np.array(frictions, np.float32),
        mass=np.full(n, objects[0].mass if count == 1 else np.nan, np.float32),
        names=np.array(NUMBERS), part_names=np.array(list(found.parts)))


def _chosen(count: int, tries: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Return indices of candidates: half of them among the best third, the others among all."""
    best = rng.permutation(max(1, count // 3))[: tries // 2]
    others = np.setdiff1d(np.arange(count), best)
    return np.concatenate([best, rng.permutation(others)[: tries - len(best)]])


def collect(
    cell: str, overrides: Sequence[str], path: Path, tries: int, seed: int, processes: int = PROCESSES
) -> Iterator[int]:
    """Try grasps until there are enough; yield the number of tries after each group of scenes.

    Args:
        cell, overrides: whose tray, camera and gripper.
        path: file to write; its groups are in the folder `PATH.parts`, and are used again.
        tries: number of tries, at least; whole groups are stored.
        seed: of the scenes.
        processes: number of processes.

    Raises:
        ConfigError: the file cannot be written, or the cell cannot be used.
    """
    folder = path.with_name(path.name + ".parts")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("--out", str(path), f"cannot be written: {error.strerror}") from None
    rig_of(cell, overrides)
    done, group = 0, 0
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes, _start, (cell, tuple(overrides))) as pool:
        while done < tries:
            jobs = [(folder, seed, group + k) for k in range(processes)]
            group += processes
            for count in pool.imap(_store_group, jobs):
                done += count
                yield done
    parts = [Tries.read(_part(folder, seed, k)) for k in range(group) if _part(folder, seed, k).exists()]
    Tries.joined(parts).save(path)


_rig: Rig | None = None  # of a process of the pool


def _start(cell: str, overrides: Sequence[str]) -> None:
    global _rig  # noqa: PLW0603
    import cv2

    cv2.setNumThreads(1)
    _rig = rig_of(cell, overrides)


def _part(folder: Path, seed: int, group: int) -> Path:
    return folder / f"{seed}-{group:05d}.npz"


def _store_group(job: tuple[Path, int, int]) -> int:
    """Store the tries of a group of scenes unless it is stored; return their number."""
    path = _part(*job)
    if path.exists():
        return len(Tries.read(path))
    assert _rig is not None
    _, seed, group = job
    scenes = [tries_of_scene(_rig, seed, number) for number in range(group * GROUP, (group + 1) * GROUP)]
    found = [each for each in scenes if each is not None]
    if not found:
        return 0
    made = Tries.joined(found)
    made.save(path)
    return len(made)
