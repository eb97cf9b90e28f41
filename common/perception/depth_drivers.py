"""Where the pictures of a real depth camera come from: a driver, which may be one's own. All calls may block."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from common.config import Parameters, check
from common.errors import ConfigError, ZencellError
from common.plugins import find_plugin, plugin_names

GROUP = "zencell.cameras"

Picture = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]


class CameraLost(ZencellError):
    """The camera is not there, or gives nothing any more: the message says why. It is opened again after a while."""


@dataclass(frozen=True)
class Intrinsics:
    """The pinhole that took colour and depth, without distortion: size, focal lengths and principal point [px]."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class RgbdFrame:
    """What a depth camera sees at one instant, colour and depth pixel by pixel through the same lens.

    Attributes:
        colour: (height, width, 3) blue green red, 0 to 255.
        depth: (height, width) along the optical axis [m], NaN where nothing was measured.
        age: how long ago it was exposed [s].
    """

    colour: Picture
    depth: Depth
    age: float = 0.0


class DepthSource(Protocol):
    """A depth camera that is open."""

    lens: Intrinsics

    def read(self) -> RgbdFrame:
        """The next shot.

        Raises:
            CameraLost: there is none.
        """

    def close(self) -> None:
        """Let go of it, also when it is gone."""


class Driver(Protocol):
    """A module that opens depth cameras."""

    Options: type[Parameters]

    def open_camera(self, options: Any, size: tuple[int, int], rate: float, /) -> DepthSource:
        """The camera, asked for pictures of that width and height [px], so many a second [Hz].

        Raises:
            CameraLost: it is not there.
            ConfigError: it is no such camera.
        """


def find_camera_driver(name: str, given: dict[str, Any], field: str) -> tuple[Driver, Parameters]:
    """A driver by its name, or by the dotted name of its module, and its options.

    Args:
        name: of the driver.
        given: options as they stand in the cell.
        field: of the cell in which the driver is named: for what is told.

    Raises:
        ConfigError: no such module, or not one that opens cameras; or an option that does not fit.
    """
    if "." not in name and name not in (choices := plugin_names(GROUP, "open_camera")):
        raise ConfigError(field, name, f"must be one of {', '.join(choices)}, or the dotted name of a module of yours")
    module = find_plugin(GROUP, name, field=field, noun="camera driver", marker="open_camera")
    missing = [part for part in ("Options", "open_camera") if not hasattr(module, part)]
    if missing:
        raise ConfigError(field, name, f"opens no cameras: it has no {', '.join(missing)}")
    driver = cast(Driver, module)
    return driver, check(driver.Options, given, f"{field.rpartition('.')[0]}.options")


def import_sdk(driver: str, package: str) -> Any:
    """The package of a camera's maker, which is imported only now.

    Raises:
        ConfigError: it is not installed, or a library that it needs is not there.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ConfigError("driver", driver, f"needs the extra `{driver}`: pip install 'zencell[{driver}]' ({error})"
                          ) from None


def require_frame_shape(shot: RgbdFrame, lens: Intrinsics, field: str, name: str) -> None:
    """Return when the pictures are as the lens says.

    Raises:
        ConfigError: they are not; names the driver, as it stands in a field of the cell.
    """
    for what, array, shape, dtype in (
        ("colour", shot.colour, (lens.height, lens.width, 3), np.uint8),
        ("depth", shot.depth, (lens.height, lens.width), np.float32),
    ):
        if array.shape != shape or array.dtype != dtype:
            raise ConfigError(field, name, f"gives {what} of shape {array.shape} and type {array.dtype}; its lens is "
                                           f"for {shape} and {np.dtype(dtype)}")
