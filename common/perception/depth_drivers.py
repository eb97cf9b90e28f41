"""Interface to drivers of real depth cameras, built-in or from a user's module. All calls may block."""

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

Pixels = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]


class CameraLost(ZencellError):
    """The camera is missing or stopped delivering; the message says why. The service reopens it later."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole model shared by color and depth, without distortion: size, focal lengths and principal point [px]."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class RgbdFrame:
    """One frame of a depth camera; color and depth are registered pixel by pixel.

    Attributes:
        colour: (height, width, 3) blue, green, red, 0 to 255.
        depth: (height, width) along the optical axis [m]; NaN without a measurement.
        age: time since exposure [s].
    """

    colour: Pixels
    depth: Depth
    age: float = 0.0


class DepthSource(Protocol):
    """An open depth camera."""

    lens: Intrinsics

    def read(self) -> RgbdFrame:
        """Return the next frame.

        Raises:
            CameraLost: there is none.
        """

    def close(self) -> None:
        """Release the camera, also after it was lost."""


class Driver(Protocol):
    """A module that opens depth cameras."""

    Options: type[Parameters]

    def open_camera(self, options: Any, size: tuple[int, int], rate: float, /) -> DepthSource:
        """Open the camera; request frames of width and height [px] at a rate [Hz].

        Raises:
            CameraLost: no camera is connected.
            ConfigError: the device is not supported.
        """


def find_camera_driver(name: str, options: dict[str, Any], field: str) -> tuple[Driver, Parameters]:
    """Find a driver by plain name or dotted module name and validate its options.

    Args:
        name: of the driver.
        options: as written in the cell.
        field: of the cell that names the driver, for errors.

    Raises:
        ConfigError: the module does not exist or is no camera driver, or an option is invalid.
    """
    if "." not in name and name not in (choices := plugin_names(GROUP, "open_camera")):
        raise ConfigError(field, name, f"must be one of {', '.join(choices)}, or the dotted name of a module")
    module = find_plugin(GROUP, name, field=field, noun="camera driver", marker="open_camera")
    missing = [part for part in ("Options", "open_camera") if not hasattr(module, part)]
    if missing:
        raise ConfigError(field, name, f"is no camera driver: it lacks {', '.join(missing)}")
    driver = cast(Driver, module)
    return driver, check(driver.Options, options, f"{field.rpartition('.')[0]}.options")


def import_sdk(driver: str, package: str) -> Any:
    """Import the vendor's package when the driver is used.

    Raises:
        ConfigError: it is not installed, or a library that it needs is missing.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ConfigError("driver", driver, f"needs the extra `{driver}`: pip install 'zencell[{driver}]' ({error})"
                          ) from None


def require_frame_shape(frame: RgbdFrame, lens: Intrinsics, field: str, name: str) -> None:
    """Check that the frame has the shape and type that the intrinsics declare.

    Raises:
        ConfigError: it does not; names the driver and its field in the cell.
    """
    for what, array, shape, dtype in (
        ("colour", frame.colour, (lens.height, lens.width, 3), np.uint8),
        ("depth", frame.depth, (lens.height, lens.width), np.float32),
    ):
        if array.shape != shape or array.dtype != dtype:
            raise ConfigError(field, name, f"gives {what} of shape {array.shape} and type {array.dtype}; the lens "
                                           f"needs {shape} and {np.dtype(dtype)}")
