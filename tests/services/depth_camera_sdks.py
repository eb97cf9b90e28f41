"""Stand-ins for the Python packages of depth cameras, with as much of their interfaces as the drivers use."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta
from types import MappingProxyType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from common.perception.depth_drivers import RgbdFrame

WIDTH, HEIGHT = 64, 48
SCALE = 0.00025  # [m] of one step of the RealSense: other than the usual one
STEPS = 4000
LENS = (40.0, 40.0, 31.5, 23.5)  # fx, fy, cx, cy of the OAK [px]


def module_of(name: str, **members: Any) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(members)
    return module


class FakeRealSense:
    """A RealSense, which may be unplugged; its color lens is not its depth lens.

    Depth lacks one column; the first frames lack color. `shot` replaces both images.
    """

    def __init__(self) -> None:
        self.plugged, self.coeffs, self.opened, self.stopped = True, [0.0] * 5, 0, 0
        self.streams: dict[str, tuple[Any, ...]] = {}
        self.shot: RgbdFrame | None = None
        self.lenses = {"color": (40.0, 41.0, 31.0, 23.0), "depth": (35.0, 35.0, 30.0, 22.0)}

    def require_plugged(self) -> None:
        if not self.plugged:
            raise RuntimeError("Frame didn't arrive within 1000")

    def depth(self, aligned: bool) -> np.ndarray:
        if self.shot is not None and aligned:
            return np.rint(np.nan_to_num(self.shot.depth) / SCALE).astype(np.uint16)
        steps = np.full((HEIGHT, WIDTH), STEPS if aligned else 1, np.uint16)
        steps[:, 5] = 0
        return steps

    def color(self) -> np.ndarray:
        return np.full((HEIGHT, WIDTH, 3), (10, 20, 200), np.uint8) if self.shot is None else self.shot.colour

    def frames(self, number: int, aligned: bool = False) -> Any:
        def frame(pixels: np.ndarray) -> Any:
            return SimpleNamespace(get_data=lambda: pixels, get_timestamp=lambda: 1e3 * (time.time() - 0.2),
                                   get_frame_timestamp_domain=lambda: "global")

        return SimpleNamespace(number=number, get_depth_frame=lambda: frame(self.depth(aligned)),
                               get_color_frame=lambda: frame(self.color()) if number > 1 else None)

    def profile(self) -> Any:
        def stream(name: str) -> Any:
            fx, fy, ppx, ppy = self.lenses[name]
            intrinsics = SimpleNamespace(width=WIDTH, height=HEIGHT, fx=fx, fy=fy, ppx=ppx, ppy=ppy,
                                         coeffs=self.coeffs if name == "color" else [0.0] * 5)
            video = SimpleNamespace(get_intrinsics=lambda: intrinsics)
            return SimpleNamespace(as_video_stream_profile=lambda: video, format=lambda: "bgr8")

        sensor = SimpleNamespace(get_depth_scale=lambda: SCALE)
        device = SimpleNamespace(first_depth_sensor=lambda: sensor, is_playback=lambda: False)
        return SimpleNamespace(get_device=lambda: device, get_stream=stream)

    def module(self) -> ModuleType:
        """Return pyrealsense2."""
        fake = self

        class Config(dict[str, tuple[Any, ...]]):
            def enable_device(self, serial: str) -> None:
                self["device"] = (serial,)

            def enable_stream(self, stream: str, *mode: Any) -> None:
                self[stream] = mode

        class Pipeline:
            count = 0

            def start(self, config: Config) -> Any:
                if config["color"][0] != WIDTH:
                    raise RuntimeError("Couldn't resolve requests")
                fake.opened, fake.streams = fake.opened + 1, config
                return fake.profile()

            def wait_for_frames(self, timeout: int) -> Any:
                fake.require_plugged()
                time.sleep(0.002)
                self.count += 1
                return fake.frames(self.count)

            def stop(self) -> None:
                fake.stopped += 1
                fake.require_plugged()

        device = SimpleNamespace(get_info={"serial": "0123"}.get)
        return module_of(
            "pyrealsense2", config=Config, pipeline=Pipeline,
            align=lambda stream: SimpleNamespace(process=lambda frames: fake.frames(frames.number, aligned=True)),
            stream=SimpleNamespace(color="color", depth="depth"),
            format=SimpleNamespace(z16="z16", bgr8="bgr8", rgb8="rgb8"),
            camera_info=SimpleNamespace(serial_number="serial"),
            timestamp_domain=SimpleNamespace(global_time="global"),
            context=lambda: SimpleNamespace(query_devices=lambda: [device] if fake.plugged else []))


class FakeOak:
    """An OAK, which may be unplugged, and whose images are a shot."""

    def __init__(self, shot: RgbdFrame, platform: str = "RVC2") -> None:
        self.shot, self.platform, self.plugged, self.closed, self.aligned_by = shot, platform, True, 0, ""
        self.outputs: dict[str, Any] = {}

    def output(self, name: str) -> Any:
        def link(to: Any) -> None:
            if to in ("stereo.align", "align.align"):
                self.aligned_by = to.partition(".")[0]

        return SimpleNamespace(link=link, name=name)

    def camera(self) -> Any:
        def build(socket: str) -> Any:
            def request(size: tuple[int, int], **how: Any) -> Any:
                self.outputs[socket] = (size, how)
                return self.output(socket)

            return SimpleNamespace(requestOutput=request)

        return SimpleNamespace(build=build)

    def stereo(self) -> Any:
        def build(left: Any, right: Any, presetMode: str) -> Any:  # noqa: N803
            assert (left.name, right.name) == ("left", "right")
            return SimpleNamespace(setLeftRightCheck=lambda on: None, setSubpixel=lambda on: None,
                                   inputAlignTo="stereo.align", depth=self.output("depth"))

        return SimpleNamespace(build=build)

    def device(self, *which: Any) -> Any:
        if not self.plugged:
            raise RuntimeError("No available devices")
        return SimpleNamespace(getPlatform=lambda: self.platform, close=lambda: None)

    def get(self, timeout: timedelta) -> Any:
        if not self.plugged:
            raise RuntimeError("queue was closed")
        time.sleep(0.002)
        k = [[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]]
        transformation = SimpleNamespace(getIntrinsicMatrix=lambda: k)
        color = SimpleNamespace(getTransformation=lambda: transformation, getWidth=lambda: WIDTH,
                                getHeight=lambda: HEIGHT, getCvFrame=lambda: self.shot.colour,
                                getTimestamp=lambda: timedelta(seconds=10.0))
        steps = np.rint(np.nan_to_num(self.shot.depth) * 1000).astype(np.uint16)
        return {"rgb": color, "depth": SimpleNamespace(getFrame=lambda: steps)}

    def stop(self) -> None:
        self.closed += 1

    def module(self) -> ModuleType:
        """Return depthai."""
        def stereo() -> Any:
            return self.stereo()

        stereo.PresetMode = SimpleNamespace(DEFAULT="default")  # type: ignore[attr-defined]
        sync = SimpleNamespace(
            inputs=MappingProxyType({"rgb": "sync.rgb", "depth": "sync.depth"}),
            setSyncThreshold=lambda threshold: None,
            out=SimpleNamespace(createOutputQueue=lambda maxSize, blocking: SimpleNamespace(get=self.get)))
        align = SimpleNamespace(input="align.in", inputAlignTo="align.align", outputAligned=self.output("aligned"))

        def create(node: Callable[[], Any]) -> Any:
            return node()

        return module_of(
            "depthai", Device=self.device, DeviceInfo=lambda name: name,
            Pipeline=lambda device: SimpleNamespace(create=create, start=lambda: None, stop=self.stop),
            CameraBoardSocket=SimpleNamespace(CAM_A="color", CAM_B="left", CAM_C="right"),
            Platform=SimpleNamespace(RVC4="RVC4"), Clock=SimpleNamespace(now=lambda: timedelta(seconds=10.1)),
            ImgFrame=SimpleNamespace(Type=SimpleNamespace(BGR888i="bgr")),
            node=SimpleNamespace(Camera=self.camera, StereoDepth=stereo, ImageAlign=lambda: align, Sync=lambda: sync))
