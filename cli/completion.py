"""Shell completion: install or show the completion script of a shell."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from common.errors import UnknownName

SHELLS = ("bash", "zsh", "fish")
COMPLETE_VARIABLE = "_ZENCELL_COMPLETE"  # set by a shell that requests completions


def prepare(environ: Mapping[str, str] = os.environ) -> None:
    """Register the shells if a shell requests completions."""
    if COMPLETE_VARIABLE in environ:
        _register_shells()


def _register_shells() -> None:
    # Typer does this only for its built-in options, which do not accept the name of a shell.
    from typer._completion_classes import completion_init

    completion_init()


def _checked(shell: str) -> str:
    if shell not in SHELLS:
        raise UnknownName("shell", shell, SHELLS)
    return shell


def _install(ctx: typer.Context, param: Any, shell: str | None) -> None:
    if shell is not None and not ctx.resilient_parsing:
        from typer.completion import install_callback

        _register_shells()
        install_callback(ctx, param, _checked(shell))


def _show(ctx: typer.Context, param: Any, shell: str | None) -> None:
    if shell is not None and not ctx.resilient_parsing:
        from typer.completion import show_callback

        _register_shells()
        show_callback(ctx, param, _checked(shell))


def _shells(incomplete: str) -> list[str]:
    return [shell for shell in SHELLS if shell.startswith(incomplete)]


def root(
    install_completion: Annotated[
        str | None,
        typer.Option("--install-completion", metavar="SHELL", help="install completion for bash, zsh or fish",
                     callback=_install, is_eager=True, expose_value=False, autocompletion=_shells),
    ] = None,
    show_completion: Annotated[
        str | None,
        typer.Option("--show-completion", metavar="SHELL", help="show the completion script", callback=_show,
                     is_eager=True, expose_value=False, autocompletion=_shells),
    ] = None,
) -> None:
    """Robot work cells as a mesh of processes over Zenoh."""
