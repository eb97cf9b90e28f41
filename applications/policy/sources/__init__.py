"""Sources of a policy's actions: a Python function, an ONNX file, a server of openpi."""

from __future__ import annotations

from applications.policy.interface import PolicySource
from applications.policy.sources.settings import PolicyCell, SourceConfig


def source(config: SourceConfig, cell: PolicyCell) -> PolicySource:
    """Return the source that a configuration names. Imports and loads what it needs, which may take seconds.

    Raises:
        ConfigError: it does not exist or does not fit the cell; names the field, the value and what is expected.
    """
    if config.callable:
        from applications.policy.sources.function import FunctionPolicy

        return FunctionPolicy(config, cell)
    if config.onnx:
        from applications.policy.sources.onnx_file import OnnxPolicy

        return OnnxPolicy(config, cell)
    from applications.policy.sources.openpi import OpenpiPolicy

    return OpenpiPolicy(config, cell)


def require_source(config: SourceConfig, cell: PolicyCell) -> None:
    """Check as much of a source as can be checked without running what it names.

    Raises:
        ConfigError: a module, file or card is missing or does not fit the cell, or an address is none.
    """
    if config.callable:
        from applications.policy.sources.function import require_module

        require_module(config.callable)
    elif config.onnx:
        from applications.policy.sources.onnx_file import require_file

        require_file(config.onnx, cell)
    else:
        source(config, cell)
