"""An Intel RealSense of the D400 series, or a recording of one, by the maker's package `pyrealsense2`."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from common.config import Parameters
from common.errors import ConfigError
from common.perception.depth_drivers import CameraLost, Intrinsics, RgbdFrame, import_sdk

TIMEOUT = 1000  # [ms] without a frame, after which the camera is lost
PLAYBACK_TIMEOUT = 10_000  # [ms] without a frame of a recording, which is restarted meanwhile
CHECK_PERIOD = 50  # [ms] between checks whether a recording has ended


class Options(Parameters):
    """Identity of the camera, and how its images are made."""

    serial: str = Field("", description="of the camera, as `rs-enumerate-devices -s` prints it; empty: the first")
    file: str = Field("", description="recording of the maker's tools (.db3; before 2.58 .bag), played in a loop "
                                      "instead of a camera, at its own rate and image size")
    fps: int = Field(30, ge=1, le=90, description="frame rate: 6, 15, 30, 60 or 90 [Hz]")
    align: Literal["color", "depth"] = Field("color", description="image to which the other one is aligned")


class RealSense:
    """A camera whose pipeline runs."""

    def __init__(self, rs: Any, pipeline: Any, config: Any, profile: Any, align: str) -> None:
        """Use a pipeline that was started with a config, which returned the profile.

        Raises:
            ConfigError: the image that is not aligned is distorted, or a recording has an unsupported colour format.
        """
        self._rs, self._pipeline, self._config = rs, pipeline, config
        device = profile.get_device()
        self._playback: Any = device.as_playback() if device.is_playback() else None
        self._scale = float(device.first_depth_sensor().get_depth_scale())  # [m] of one step of z16
        stream = getattr(rs.stream, align)
        self._align = rs.align(stream)
        i = profile.get_stream(stream).as_video_stream_profile().get_intrinsics()
        if any(i.coeffs):
            raise ConfigError("options.align", align,
                              f"has distortion {list(i.coeffs)}, which cannot be corrected: choose depth")
        self.lens = Intrinsics(i.width, i.height, i.fx, i.fy, i.ppx, i.ppy)
        colours = profile.get_stream(rs.stream.color).format()
        if colours not in (rs.format.bgr8, rs.format.rgb8):  # a camera has the requested format
            raise ConfigError("options.file", str(colours), "is no colour format that can be read: bgr8, rgb8")
        self._red_first = colours == rs.format.rgb8

    def read(self) -> RgbdFrame:
        """Wait for the next frame, with depth and colour of the same instant."""
        while True:
            try:
                frames = self._align.process(
                    self._pipeline.wait_for_frames(TIMEOUT) if self._playback is None else self._next_played())
            except RuntimeError as error:  # unplugged, or it hangs
                raise CameraLost(str(error)) from None
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if not depth or not color:
                continue  # the first frames may lack one of them
            steps = np.asanyarray(depth.get_data())
            metres = np.where(steps > 0, steps * np.float32(self._scale), np.float32(np.nan)).astype(np.float32)
            pixels = np.array(color.get_data())  # a copy: the library reuses its memory
            if self._red_first:
                pixels = np.ascontiguousarray(pixels[:, :, ::-1])
            age = 0.0
            ours = color.get_frame_timestamp_domain() == self._rs.timestamp_domain.global_time  # of this host
            if ours and self._playback is None:
                age = max(0.0, time.time() - color.get_timestamp() * 1e-3)  # [ms]
            return RgbdFrame(pixels, metres, age)

    def _next_played(self) -> Any:
        """Return the next frames of the recording, which restarts at its end.

        The library's `repeat_playback` hangs after some of the ends (2.59.1, recordings of three frames).

        Raises:
            RuntimeError: no frame for `PLAYBACK_TIMEOUT`, or it cannot be restarted.
        """
        until = time.monotonic() + PLAYBACK_TIMEOUT * 1e-3
        while time.monotonic() < until:
            found, frames = self._pipeline.try_wait_for_frames(CHECK_PERIOD)
            if found:
                return frames
            if self._playback.current_status() == self._rs.playback_status.stopped:
                self._pipeline.stop()
                self._playback = self._pipeline.start(self._config).get_device().as_playback()
        raise RuntimeError(f"no frame of the recording for {PLAYBACK_TIMEOUT * 1e-3:g} s")

    def close(self) -> None:
        """Stop the pipeline."""
        with contextlib.suppress(RuntimeError):  # it is lost already
            self._pipeline.stop()


def open_camera(options: Options, size: tuple[int, int], rate: float) -> RealSense:
    """Open the camera or recording: see `common.perception.depth_drivers`."""
    rs = import_sdk("realsense", "pyrealsense2")
    config = _recording(rs, options) if options.file else _camera(rs, options, size)
    pipeline = rs.pipeline()
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:  # no such mode, or another process has it
        what = options.file or f"{size[0]}x{size[1]} at {options.fps} Hz"
        raise CameraLost(f"{what}: {error}") from None
    try:
        return RealSense(rs, pipeline, config, profile, options.align)
    except RuntimeError as error:  # a recording without one of the two
        pipeline.stop()
        raise CameraLost(f"{options.file}: {error}") from None
    except ConfigError:
        pipeline.stop()
        raise


def _camera(rs: Any, options: Options, size: tuple[int, int]) -> Any:
    """Return the configuration of a camera that is plugged in, with its streams.

    Raises:
        CameraLost: it is not plugged in.
    """
    serials = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
    if not serials:
        raise CameraLost("no RealSense is plugged in")
    if options.serial and options.serial not in serials:
        raise CameraLost(f"RealSense {options.serial} is not plugged in; choices: {', '.join(serials)}")
    config = rs.config()  # a new one each time: one that lost its camera does not find it again
    config.enable_device(options.serial or serials[0])
    config.enable_stream(rs.stream.depth, *size, rs.format.z16, options.fps)
    config.enable_stream(rs.stream.color, *size, rs.format.bgr8, options.fps)
    return config


def _recording(rs: Any, options: Options) -> Any:
    """Return the configuration of a recording, whose streams are fixed.

    Raises:
        ConfigError: it does not exist, or a camera is selected as well.
    """
    file = Path(options.file).expanduser()
    if not file.is_file():
        raise ConfigError("options.file", options.file, "is no file")
    if options.serial:
        raise ConfigError("options.serial", options.serial,
                          f"selects a camera, but options.file selects a recording: {options.file}")
    config = rs.config()
    config.enable_device_from_file(str(file), repeat_playback=False)  # see RealSense._next_played
    return config
