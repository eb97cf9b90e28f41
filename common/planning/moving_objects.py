"""Objects of a planning scene that move evenly: the scene without them, and with them where they will be."""

from __future__ import annotations

from common.messages import CollisionObject, MovingGoal, PlanningScene, PlanRequest, Vector3


def scene_for(request: PlanRequest, scene: PlanningScene) -> PlanningScene:
    """Return the scene in which a request is planned: for a moving goal without the objects that move."""
    if not isinstance(request.goal, MovingGoal) or not any(item.moves for item in scene.objects):
        return scene
    return scene.model_copy(update={"objects": [item for item in scene.objects if not item.moves]})


def scene_at(scene: PlanningScene, time: float) -> PlanningScene:
    """Return the scene with its moving objects alone, where they will be at a cell time [s]."""
    passed = time - scene.header.stamp * 1e-9
    return scene.model_copy(update={"objects": [displaced(item, passed) for item in scene.objects if item.moves]})


def displaced(item: CollisionObject, seconds: float) -> CollisionObject:
    """Return a moving object after a time [s]."""
    p, v = item.pose.position, item.velocity
    moved = Vector3(x=p.x + seconds * v.x, y=p.y + seconds * v.y, z=p.z + seconds * v.z)
    return item.model_copy(update={"pose": item.pose.model_copy(update={"position": moved})})
