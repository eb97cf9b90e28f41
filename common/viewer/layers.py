"""What the 3D scene is made of: layers that can be shown and hidden one by one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from common.errors import UnknownName


@dataclass(frozen=True)
class Layer:
    """A tick box of the page: its text, and whether it is on when the page opens for the first time."""

    label: str
    on: bool = True


LAYERS: Mapping[str, Layer] = {
    "robot": Layer("Robot"),
    "fixtures": Layer("Fixtures"),
    "objects": Layer("Perceived objects"),
    "targets": Layer("Targets"),
    "rejected": Layer("Rejected, with the reason"),
    "workspace": Layer("Workspace"),
    "plan": Layer("Planned: where the arm will be"),
    "tool_path": Layer("Planned: path of the tool"),
    "outline": Layer("Outline"),
    "contours": Layer("Contours to choose from"),
    "camera": Layer("Camera"),
    "frames": Layer("Frames", on=False),
    "truth": Layer("Truth (simulated hardware)", on=False),
    "grid": Layer("Grid"),
}


def layers_shown(wanted: Mapping[str, bool]) -> dict[str, bool]:
    """Whether each layer is shown: as wanted, else as `LAYERS` says.

    Raises:
        UnknownName: a wanted layer does not exist; with the choices.
    """
    for name in wanted:
        if name not in LAYERS:
            raise UnknownName("layer", name, list(LAYERS))
    return {name: wanted.get(name, layer.on) for name, layer in LAYERS.items()}
