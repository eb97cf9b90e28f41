"""How the scene looks before any message: light, which way is up, no axes in the middle."""

from __future__ import annotations

import viser


def furnish(server: viser.ViserServer) -> None:
    """Set light and lens. Before anything else is sent: what was drawn in another light has to get new shaders."""
    scene, view = server.scene, server.initial_camera
    scene.set_up_direction("+z")
    scene.configure_default_lights(cast_shadow=False)
    scene.configure_environment_map(hdri=None)  # a browser without a graphics card needs seconds to prepare one
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(120, 115, 110), intensity=2.0)
    scene.world_axes.visible = False
    view.up = (0.0, 0.0, 1.0)
    view.fov = 0.9
