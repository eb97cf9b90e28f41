"""How the kernel is compiled: by `setup.py` with ziglang, and by hand with `python -m common.planning.kernel.build`.

Two libraries come of the same source on x86-64: one for every processor, one for those with AVX2 and FMA.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
SOURCE = "kernel.c"
NAME = "planning_kernel"
_FLAGS = ("-std=gnu11", "-O3", "-shared", "-fPIC", "-fvisibility=hidden")
# No -ffast-math: bounds have to hold, and a comparison with a number that is none has to say no.
_LEVELS = {"": (), "_avx2": ("-mavx2", "-mfma")}


def levels(machine: str = "") -> dict[str, tuple[str, ...]]:
    """Suffix of each library for a kind of processor, and the compiler's flags for it."""
    if (machine or platform.machine()).lower() in ("x86_64", "amd64"):
        return _LEVELS
    return {"": ()}


def compilers() -> list[list[str]]:
    """Commands that may compile C here, the preferred one first."""
    found = []
    if (own := os.environ.get("CC")):
        found.append(own.split())
    try:
        import ziglang  # type: ignore[import-not-found]  # noqa: F401 - in the build's own environment, or not at all
    except ImportError:
        pass
    else:
        found.append([sys.executable, "-m", "ziglang", "cc"])
    return found + [[path] for name in ("cc", "gcc", "clang") if (path := shutil.which(name))]


def build(into: Path, cache: Path | None = None) -> list[Path]:
    """Compile the kernel into a folder; the libraries, or none where no compiler does it.

    Args:
        into: a folder that is there.
        cache: where ziglang may keep what it makes; else in the user's cache.
    """
    environment = dict(os.environ)
    if cache is not None:
        environment["ZIG_GLOBAL_CACHE_DIR"] = environment["ZIG_LOCAL_CACHE_DIR"] = str(cache)
    for compiler in compilers():
        libraries = []
        for suffix, flags in levels().items():
            target = into / f"{NAME}{suffix}.so"
            if "ziglang" in compiler and suffix == "" and levels() is _LEVELS:
                flags = ("-mcpu=x86_64",)  # ziglang compiles for the machine at hand unless told
            command = [*compiler, *_FLAGS, *flags, "-o", str(target), str(FOLDER / "src" / SOURCE), "-lm"]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                sys.stderr.write(f"{' '.join(command)}\n{done.stderr}")
                break
            libraries.append(target)
        else:
            return libraries
    return []


if __name__ == "__main__":
    built = build(FOLDER)
    sys.stdout.write("".join(f"{path}\n" for path in built) or "nothing was built: no C compiler\n")
    sys.exit(not built)
