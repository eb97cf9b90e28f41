"""Read the intrinsics of cameras calibrated elsewhere: camera_info of ROS (YAML), and FileStorage of OpenCV."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

import yaml

from common.config import parse_yaml
from common.errors import ConfigError

LONGEST = 2**20  # [characters] of a file
_FOREIGN = re.compile(r"\A\s*<|\A%YAML|^\s*\"camera_matrix\"|"
                      r"^(camera_?matrix|projection_matrix|distortion_model|k)\s*:", re.IGNORECASE | re.MULTILINE)
_MODELS = ("", "plumb_bob", "rational_polynomial")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4", "kannala_brandt")
_COEFFICIENTS = 8  # of the rational model
_NAMES = {
    "width": ("imagewidth", "width"), "height": ("imageheight", "height"), "size": ("imagesize", "resolution"),
    "k": ("cameramatrix", "k", "intrinsicmatrix", "mtx"), "p": ("projectionmatrix", "p"),
    "d": ("distortioncoefficients", "distcoeffs", "distcoeff", "dist", "d"),
    "model": ("distortionmodel",), "fisheye": ("fisheyemodel", "fisheye"),
    "binning": ("binningx", "binningy")}


def read_foreign(path: Path) -> dict[str, Any] | None:
    """Return the fields of a `CameraFile` with the intrinsics of another program's file; None if it is none.

    Raises:
        ConfigError: names what in the file is missing, or not supported.
    """
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(LONGEST)
    except (OSError, UnicodeDecodeError):
        return None  # the reader of our own files names it
    if not _FOREIGN.search(text):
        return None
    try:
        values = _of_xml(text) if text.lstrip().startswith("<") else _of_yaml(text)
    except (yaml.YAMLError, ElementTree.ParseError, ValueError) as error:
        raise ConfigError("file", str(path), f"does not parse: {str(error).splitlines()[0]}") from None
    plain = {re.sub(r"[^a-z]", "", str(name).lower()): value for name, value in values.items()}
    return _fields(path, {field: next((plain[name] for name in names if plain.get(name) is not None), None)
                          for field, names in _NAMES.items()})


def _fields(path: Path, found: dict[str, Any]) -> dict[str, Any]:
    def reject(field: str, value: object, why: str) -> NoReturn:
        raise ConfigError(f"{path}: {field}", value, why)

    def numbers(field: str) -> list[float]:
        try:
            return _numbers(found[field])
        except (TypeError, ValueError):
            reject(_NAMES[field][0], str(found[field])[:60], "must be numbers")

    size = numbers("size")[:2] if found["size"] is not None else [*numbers("width"), *numbers("height")]
    k, p, d, model = numbers("k"), numbers("p"), numbers("d"), str(found["model"] or "").lower()
    if model in _FISHEYE or str(found["fisheye"] or 0).lower() not in ("0", "false"):
        reject("distortion_model", model or "fisheye", f"is a fisheye model; choices: {', '.join(_MODELS[1:])}")
    if model not in _MODELS:
        reject("distortion_model", model, f"is unknown; choices: {', '.join(_MODELS[1:])}")
    if len(k) != 9 and len(p) == 12:
        reject("camera_matrix", "missing", "is needed: projection_matrix is that of rectified images")
    if len(k) != 9 or k[0] <= 0:
        reject("camera_matrix", k, "must be 9 numbers of a calibrated camera")
    if len(size) != 2 or min(size) <= 0:
        reject("image_width, image_height", size, "must be the size of the images: add these fields")
    width, height = size
    if not (0 < k[2] < width and 0 < k[5] < height):
        reject("camera_matrix", k, f"has its centre outside of {width:g}x{height:g}: intrinsics of another image size?")
    if abs(k[1]) > 1e-6 * k[0]:
        reject("camera_matrix", k[1], "is a skew, which is not supported")
    if any(d[_COEFFICIENTS:]):
        reject("distortion_coefficients", d, f"must be at most {_COEFFICIENTS}: thin prisms and tilt are not supported")
    if len(p) == 12 and not any(d) and max(abs(p[i] - k[j]) for i, j in ((0, 0), (2, 2), (5, 4), (6, 5))) > 1:
        reject("projection_matrix", p, "differs from camera_matrix without distortion: of raw or of rectified images?")
    if any(value > 1 for value in numbers("binning")):
        reject("binning", found["binning"], "makes images smaller than the intrinsics: calibrate at the size in use")
    return {"width": int(width), "height": int(height), "fx": k[0], "fy": k[4], "cx": k[2], "cy": k[5],
            "d": d[:_COEFFICIENTS] if any(d) else []}


def _of_yaml(text: str) -> dict[str, Any]:
    """Return the first mapping: `ros2 topic echo` writes several, OpenCV a tag for matrices and its own first line."""
    text = re.sub(r"^%YAML.*\n", "", text).replace("!!opencv-matrix", "")
    document = next((part for part in re.split(r"^---.*$", text, flags=re.MULTILINE) if part.strip()), "")
    values = parse_yaml(document)
    if not isinstance(values, dict):
        raise ValueError("must hold a mapping")
    return values


def _of_xml(text: str) -> dict[str, Any]:
    return {node.tag: {child.tag: child.text for child in node} if len(node) else node.text
            for node in ElementTree.fromstring(text)}


def _numbers(value: Any) -> list[float]:
    """Return numbers of a matrix as a mapping with `data`, nested lists, a text or a single number."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, str):
        value = value.split()
    if isinstance(value, list):
        return list(chain.from_iterable(map(_numbers, value))) if value[:1] and isinstance(value[0], list) else [
            float(item) for item in value]
    return [] if value is None else [float(value)]
