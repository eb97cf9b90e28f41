"""The target `physics` of the image, for cells with `simulator: mujoco`: OpenGL draws pictures without a screen."""

import pytest

from tests.deploy.engine import require_engine, run

pytestmark = [pytest.mark.container, pytest.mark.timeout(900)]

DRAWS = "from drivers.mujoco.gl import select_gl, gl_context; print(select_gl()); gl_context('egl', 64, 48).free()"


def test_pictures_are_drawn_by_opengl_in_the_image_with_physics():
    require_engine()
    image = "zencell-test-physics"
    run("docker", "build", "-q", "--target", "physics", "-t", image, ".", timeout=800)
    assert run("docker", "run", "--rm", image, "python", "-c", DRAWS, timeout=120).split() == ["egl"]
