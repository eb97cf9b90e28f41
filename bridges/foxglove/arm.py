"""The arm's meshes as a scene of Foxglove, each in the frame of its link, so that transforms move it."""

from __future__ import annotations

import json

from common.config import RobotConfig
from recording.foxglove import entity, update

KEY = "robot/meshes"  # of the channel; no service publishes it
SCHEMA = "foxglove.SceneUpdate"
TRIANGLES = 12_000  # in all
DECIMALS = 4  # of a coordinate [m]


def arm_scene(robot: RobotConfig, stamp: int) -> bytes:
    """Return all visible pieces of the arm as one SceneUpdate in JSON; takes seconds.

    Raises:
        ConfigError: a mesh is missing or cannot be read.
    """
    from common.messages import Pose  # these imports take a second, and most clients never ask
    from common.robot.model import RobotModel
    from common.robot.visual_meshes import visual_pieces

    entities = []
    for number, piece in enumerate(visual_pieces(RobotModel.load(robot), TRIANGLES)):
        points = [{"x": x, "y": y, "z": z} for x, y, z in piece.vertices.astype(float).round(DECIMALS).tolist()]
        red, green, blue = (value / 255 for value in piece.color)
        entities.append(entity(f"{piece.link} {number}", piece.link, stamp, triangles=[{
            "pose": Pose().model_dump(), "points": points, "indices": piece.faces.ravel().tolist(),
            "color": {"r": red, "g": green, "b": blue, "a": 1.0}, "colors": [],
        }]))
    return json.dumps(update(stamp, entities), separators=(",", ":")).encode()
