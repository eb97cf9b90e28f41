"""An Intel RealSense of the D400 series, or a recording of one, with the maker's package `pyrealsense2`."""

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

PATIENCE = 1000  # [ms] without a frame after which the camera is gone
REWIND = 10_000  # [ms] without one in which a recording was begun again and again after which it is
LOOK = 50  # [ms] without one after which a recording is asked whether it ended


class Options(Parameters):
    """Which camera it is, and how its pictures are made."""

    serial: str = Field("", description="of the camera, as `rs-enumerate-devices -s` prints it; empty: the first")
    file: str = Field("", description="recording of the maker's tools (.db3; before 2.58 .bag), played over and over "
                                      "in the place of a camera, as fast as it was made and of the size it has")
    fps: int = Field(30, ge=1, le=90, description="frames per second it makes: it knows 6, 15, 30, 60 and 90 [Hz]")
    align: Literal["color", "depth"] = Field("color", description="the picture that the other one is made to fit")


class RealSense:
    """A camera whose pipeline runs."""

    def __init__(self, rs: Any, pipeline: Any, config: Any, profile: Any, align: str) -> None:
        """Take a pipeline that was started with a config, which gave the profile.

        Raises:
            ConfigError: the lens of the picture that is kept as it is has distortion, or a recording is of colours
                that are not read.
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
                              f"has distortion {list(i.coeffs)}, which depth cannot have: depth")
        self.lens = Intrinsics(i.width, i.height, i.fx, i.fy, i.ppx, i.ppy)
        colours = profile.get_stream(rs.stream.color).format()
        if colours not in (rs.format.bgr8, rs.format.rgb8):  # a camera gives what it is asked for
            raise ConfigError("options.file", str(colours), "of its colours cannot be read: bgr8 and rgb8 can")
        self._red_first = colours == rs.format.rgb8

    def read(self) -> RgbdFrame:
        """The next shot, depth and colour of the same instant."""
        while True:
            try:
                frames = self._align.process(
                    self._pipeline.wait_for_frames(PATIENCE) if self._playback is None else self._played())
            except RuntimeError as error:  # unplugged, or it hangs
                raise CameraLost(str(error)) from None
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if not depth or not color:
                continue  # the first frames may lack one of them
            steps = np.asanyarray(depth.get_data())
            metres = np.where(steps > 0, steps * np.float32(self._scale), np.float32(np.nan)).astype(np.float32)
            pixels = np.array(color.get_data())  # a copy: what it gives is its own memory
            if self._red_first:
                pixels = np.ascontiguousarray(pixels[:, :, ::-1])
            age = 0.0
            ours = color.get_frame_timestamp_domain() == self._rs.timestamp_domain.global_time  # of this machine
            if ours and self._playback is None:
                age = max(0.0, time.time() - color.get_timestamp() * 1e-3)  # [ms]
            return RgbdFrame(pixels, metres, age)

    def _played(self) -> Any:
        """The next frames of the recording, which begins again when it has ended.

        The maker's own `repeat_playback` stands still for good after some of the ends (2.59.1, recordings of three
        frames).

        Raises:
            RuntimeError: none came for `REWIND`, or it cannot be begun again.
        """
        until = time.monotonic() + REWIND * 1e-3
        while time.monotonic() < until:
            there, frames = self._pipeline.try_wait_for_frames(LOOK)
            if there:
                return frames
            if self._playback.current_status() == self._rs.playback_status.stopped:
                self._pipeline.stop()
                self._playback = self._pipeline.start(self._config).get_device().as_playback()
        raise RuntimeError(f"no frame of the recording for {REWIND * 1e-3:g} s")

    def close(self) -> None:
        """Stop it."""
        with contextlib.suppress(RuntimeError):  # it is gone already
            self._pipeline.stop()


def open_camera(options: Options, size: tuple[int, int], rate: float) -> RealSense:
    """The camera: see `common.perception.depth_drivers`."""
    rs = import_sdk("realsense", "pyrealsense2")
    config = _recording(rs, options) if options.file else _camera(rs, options, size)
    pipeline = rs.pipeline()
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:  # no such mode, or somebody else has it
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
    """What asks for a camera that is plugged in, and its streams.

    Raises:
        CameraLost: it is not there.
    """
    there = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
    if not there:
        raise CameraLost("no RealSense is plugged in")
    if options.serial and options.serial not in there:
        raise CameraLost(f"RealSense {options.serial} is not plugged in; there are: {', '.join(there)}")
    config = rs.config()  # a new one each time: one that lost its camera stays without
    config.enable_device(options.serial or there[0])
    config.enable_stream(rs.stream.depth, *size, rs.format.z16, options.fps)
    config.enable_stream(rs.stream.color, *size, rs.format.bgr8, options.fps)
    return config


def _recording(rs: Any, options: Options) -> Any:
    """What asks for a recording, of which nothing can be chosen.

    Raises:
        ConfigError: there is none, or a camera is asked for as well.
    """
    file = Path(options.file).expanduser()
    if not file.is_file():
        raise ConfigError("options.file", options.file, "is no file")
    if options.serial:
        raise ConfigError("options.serial", options.serial, f"is of a camera; there is a recording too: {options.file}")
    config = rs.config()
    config.enable_device_from_file(str(file), repeat_playback=False)  # see RealSense._played
    return config
