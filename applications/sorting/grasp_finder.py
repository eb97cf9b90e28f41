"""From a surface with labeled objects to proved grasps, and reasons for objects without one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from applications.sorting.clusters import Labels
from applications.sorting.grasps.candidates import Candidates, Options, candidates
from applications.sorting.grasps.gripper_shape import GripperShape
from applications.sorting.grasps.height_map import Walls
from applications.sorting.grasps.proof import ProofOptions, Prover
from applications.sorting.learning.learned import learned_score
from applications.sorting.learning.network import Network
from applications.sorting.seeing import crop
from applications.sorting.surface import Surface
from applications.sorting.topics import MAX_OBJECTS, GraspCandidate, Left, SeenObject
from common.config import RobotConfig, Surroundings

MARGIN = 0.04  # [m] of the surface around the tray
REASON = 200  # longest reason
GEOMETRIC, LEARNED = "geometric", "learned"  # scorers


@dataclass(frozen=True)
class Found:
    """Grasps, proved ones first, and objects in the tray without a proved one."""

    grasps: list[GraspCandidate]
    left: list[Left]
    scorer: str


class GraspFinder:
    """Finds and proves grasps of one robot in one tray. Not thread-safe."""

    def __init__(
        self, world: Surroundings, robot: RobotConfig, tray: str, *, options: Options | None = None,
        proof: ProofOptions | None = None, network: Network | None = None,
    ) -> None:
        """Load the robot; with a network, candidates are ranked by it.

        Raises:
            ConfigError: the robot has no gripper with fingers, or a file of it is missing.
        """
        self.options, self._network = options or Options(), network
        self._tray, self._place = tray, world.containers[tray]
        self._walls = [Walls.of(self._place, world.table_height)]
        self._prover = Prover(robot, world, proof)
        self.gripper = GripperShape.of(self._prover.geometry)

    def find(self, surface: Surface, labels: Labels, objects: Sequence[SeenObject]) -> Found:
        """Return grasps of the objects in the tray.

        Args:
            surface: of the tray and around.
            labels: (rows, columns) k + 1 at the cells of objects[k].
            objects: all that are seen.
        """
        inside = [index for index, seen in enumerate(objects) if seen.place == self._tray]
        if not inside:
            return Found([], [], self.scorer)
        r, box = self._place.half_side + MARGIN, self._place
        piece, part = crop(surface, (box.x - r, box.y - r, box.x + r, box.y + r))
        in_tray = np.zeros(len(objects) + 1, np.int32)
        in_tray[np.array(inside) + 1] = np.array(inside) + 1
        found = candidates(piece, in_tray[labels[part]], self.gripper, self.options, np.random.default_rng(0),
                           self._walls)
        if self._network is not None:
            found = self._ranked(found, piece, self._network)
        names = [seen.id for seen in objects]
        proof = self._prover.prove(found, names)
        proved = {grasp.object for grasp in proof.grasps if grasp.proved}
        left = [Left(object=names[index], reason=proof.reasons.get(index, "no free edge")[:REASON])
                for index in inside if names[index] not in proved]
        return Found(proof.grasps, left[:MAX_OBJECTS], self.scorer)

    @property
    def scorer(self) -> str:
        """Name of what ranks the grasps."""
        return GEOMETRIC if self._network is None else LEARNED

    def _ranked(self, found: Candidates, surface: Surface, network: Network) -> Candidates:
        """Return candidates in the order of the network, whose estimate becomes their score."""
        if not len(found):
            return found
        score = learned_score(network, found, surface, self.gripper.T_tcp_closing)
        scored = replace(found, score=score, parts={**found.parts, LEARNED: score})
        return scored.select(np.argsort(-score, kind="stable"))

    @property
    def closing(self) -> npt.NDArray[np.float64]:
        """(3,) axis along which the fingers close, in the frame of the tool."""
        return np.asarray(self.gripper.T_tcp_closing[:3, 1])
