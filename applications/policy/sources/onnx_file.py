"""A policy that is an ONNX file with a card, run by onnxruntime (extra `policy`) or by OpenCV, on one thread."""

from __future__ import annotations

import hashlib
import importlib.util
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from applications.policy.interface import Chunk, Observation, PolicyFailed
from applications.policy.sources.actions import one_line
from applications.policy.sources.card import FIELD, Values, read_card
from applications.policy.sources.computing import Computation
from applications.policy.sources.settings import PolicyCell, SourceConfig
from common.config.files import read_file
from common.errors import ConfigError

EXTRA = "needs the extra `policy`: pip install 'zencell[policy]'"
MAX_BYTES = 1_000_000_000  # of a file
_TRIAL = "import cv2, sys, numpy; cv2.dnn.readNetFromONNX(numpy.frombuffer(sys.stdin.buffer.read(), numpy.uint8))"
_TRIED: set[bytes] = set()  # digests of files that OpenCV reads without a crash


class _Network(Protocol):
    def run(self, inputs: Mapping[str, Values]) -> Any:
        """Return the output."""


class _OpenCV:
    def __init__(self, data: bytes, output: str) -> None:
        before = cv2.utils.logging.setLogLevel(0)  # errors are raised
        try:
            self._net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        finally:
            cv2.utils.logging.setLogLevel(before)
        self._output = output

    def run(self, inputs: Mapping[str, Values]) -> Any:
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            for name, values in inputs.items():
                self._net.setInput(values, name)
            return self._net.forward(self._output)
        finally:
            cv2.setNumThreads(threads)


class _OnnxRuntime:
    def __init__(self, data: bytes, output: str) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # errors are raised
        self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        self._output = output

    def run(self, inputs: Mapping[str, Values]) -> Any:
        return self._session.run([self._output], dict(inputs))[0]


class OnnxPolicy:
    """Runs a network with each observation, in a thread."""

    def __init__(self, config: SourceConfig, cell: PolicyCell) -> None:
        """Read the file and its card, and run the network once.

        Raises:
            ConfigError: a file is missing or unreadable, or the network is not what the card says or does not fit the
                cell; says why.
        """
        path = _find(config.onnx)
        data = read_file(path, FIELD, MAX_BYTES)
        self._card = read_card(path)
        self._card.require(cell, path)
        self._name = f"network {path.name}"
        self._computation = Computation(self._name, config.timeout)
        self._network = _load(data, config.runtime, self._card.output, path)
        try:
            output = self._network.run(self._card.blank())
        except Exception as error:  # each runtime has its own
            raise ConfigError(FIELD, str(path), f"does not run as its card says: {one_line(error)}") from None
        if problem := self._problem(output):
            raise ConfigError(FIELD, str(path), f"is not what its card says: {problem}")

    async def infer(self, observation: Observation) -> Chunk:
        """Return the next actions; see `PolicySource`."""
        inputs = self._card.inputs(observation)
        try:
            output = await self._computation.call(self._network.run, inputs)
        except PolicyFailed:
            raise
        except Exception as error:
            raise PolicyFailed(f"{self._name} failed: {one_line(error)}") from None
        if problem := self._problem(output):
            raise PolicyFailed(f"{self._name}: {problem}")
        return self._card.chunk(output, observation.stamp)

    def _problem(self, output: Any) -> str:
        """Return what is wrong with an output; empty if nothing is."""
        size = self._card.rows * self._card.columns
        if not isinstance(output, np.ndarray) or output.dtype.kind != "f":
            return f"output {self._card.output} is no array of floats"
        if output.size != size:
            return (f"output {self._card.output} must be of shape (1, {self._card.rows}, {self._card.columns}), not "
                    f"{output.shape}")
        return ""

    async def close(self) -> None:
        """Do nothing: a network that still computes is abandoned."""


def _find(name: str) -> Path:
    """Return the path of a file; a relative one is searched in the working directory, then in the project's folder."""
    path = Path(name).expanduser()
    included = Path(__file__).resolve().parents[3] / path
    return included if not path.exists() and included.exists() else path


def require_file(name: str, cell: PolicyCell) -> None:
    """Return if a file is there and its card fits the cell.

    Raises:
        ConfigError: says why it is or does not.
    """
    path = _find(name)
    if not path.is_file():
        raise ConfigError(FIELD, str(path), "is not a file")
    read_card(path).require(cell, path)


def _require_no_crash(data: bytes) -> None:
    """Return if OpenCV can read a file, or raises an error, in another process; once for each file.

    OpenCV 5.0 crashes while it reports an error in a file with texts that are not UTF-8.

    Raises:
        ValueError: it crashes.
    """
    digest = hashlib.sha256(data).digest()
    if digest not in _TRIED:
        trial = subprocess.run([sys.executable, "-c", _TRIAL], input=data, capture_output=True, check=False)
        if trial.returncode < 0:
            raise ValueError("OpenCV crashes while it reads the file")
        _TRIED.add(digest)


def _load(data: bytes, runtime: str, output: str, path: Path) -> _Network:
    installed = importlib.util.find_spec("onnxruntime") is not None
    if runtime == "onnxruntime" and not installed:
        raise ConfigError("source.runtime", runtime, EXTRA)
    try:
        if runtime == "onnxruntime" or (runtime == "auto" and installed):
            return _OnnxRuntime(data, output)
        _require_no_crash(data)
        return _OpenCV(data, output)
    except Exception as error:  # each runtime has its own
        raise ConfigError(FIELD, str(path), f"is no usable ONNX file: {one_line(error)}") from None
