"""The first view of the 3D scene: lights, camera, and a field of view that also fits a narrow screen."""

from __future__ import annotations

import asyncio
import math

import viser

from page.layout import Layout

FOV = 0.9  # [rad] vertical field of view where the scene is at least
ASPECT = 1.0  # times as wide as high: a narrower one gets a larger field of view, which is as wide as this one
MAX_FOV = 1.6  # [rad]
LAYOUT_CHECKS, LAYOUT_PERIOD = 4, 1.0  # number and [s]: the size of the scene changes while the panels arrive
NUDGE = 1e-3  # [rad]


def field_of_view(width: float, height: float) -> float:
    """Return the vertical field of view [rad] in which robot and table fit into a scene of this size."""
    aspect = width / height if width > 0 and height > 0 else ASPECT
    return FOV if aspect >= ASPECT else min(2 * math.atan(math.tan(FOV / 2) * ASPECT / aspect), MAX_FOV)


async def keep_framed(client: viser.ClientHandle) -> None:
    """Adapt the field of view of a browser to the size of its scene, now and whenever that changes."""
    size = (0, 0)

    async def update(camera: viser.CameraHandle) -> None:
        nonlocal size
        before, size = size, (camera.image_width, camera.image_height)
        if size != before:
            camera.fov = field_of_view(*size)

    client.camera.on_update(update)
    await update(client.camera)
    for _ in range(LAYOUT_CHECKS):  # a browser reports its size with its camera only: a tiny change makes it do so
        await asyncio.sleep(LAYOUT_PERIOD)
        client.camera.fov += NUDGE


def prepare_scene(server: viser.ViserServer, layout: Layout, cell: str) -> None:
    """Set lights and camera before anything else is sent: later changes of the lights would recompile all shaders."""
    scene, camera, viewpoint = server.scene, server.initial_camera, layout.viewpoint(cell)
    scene.set_up_direction("+z")
    scene.configure_default_lights(cast_shadow=layout.shadows)
    scene.configure_environment_map(hdri=None)  # a browser without a GPU needs seconds to prepare one
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(120, 115, 110), intensity=2.0)
    scene.world_axes.visible = False
    camera.up = (0.0, 0.0, 1.0)
    camera.fov = FOV
    camera.position = viewpoint.position
    camera.look_at = viewpoint.look_at
