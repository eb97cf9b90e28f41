"""Compile the kernel: from `setup.py` with ziglang, and by hand with `python -m common.planning.kernel.build`.

On x86-64 two libraries are built from the same source: one for every processor, one for those with AVX2 and FMA. This
file imports the standard library only: `setup.py` runs it before anything is installed.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
NAME = "planning_kernel"
# No -ffast-math: bounds must hold, and comparisons with NaN must be false.
_FLAGS = ("-std=gnu11", "-O3", "-s", "-shared", "-fPIC", "-fvisibility=hidden")
_ZIG = "ziglang"


def _levels(zig: bool) -> dict[str, list[str]]:
    """Return the suffix of each library and the compiler flags of its processors."""
    machine = platform.machine().lower()
    if machine in ("x86_64", "amd64"):
        if zig:  # compiles for this processor by default
            return {"": ["-mcpu=x86_64"], "_avx2": ["-mcpu=x86_64_v3"]}
        return {"": [], "_avx2": ["-mavx2", "-mfma"]}
    return {"": ["-mcpu=generic"] if zig and machine in ("aarch64", "arm64") else []}


def compilers() -> list[list[str]]:
    """Return commands that may compile C on this machine, the preferred one first."""
    configured = [command] if (command := os.environ.get("CC", "").split()) and shutil.which(command[0]) else []
    zig = [[sys.executable, "-m", _ZIG, "cc"]] if importlib.util.find_spec(_ZIG) else []
    return configured + zig + [[path] for name in ("cc", "gcc", "clang") if (path := shutil.which(name))]


def build(into: Path, cache: Path) -> list[Path]:
    """Compile the kernel into a folder and return the libraries, or none if every compiler fails.

    Args:
        into: an existing folder.
        cache: folder for ziglang's files.
    """
    environment = dict(os.environ) | {"ZIG_GLOBAL_CACHE_DIR": str(cache), "ZIG_LOCAL_CACHE_DIR": str(cache)}
    for old in into.glob(f"{NAME}*.so"):  # a process that has it open is not affected
        old.unlink()
    for compiler in compilers():
        running = []
        for suffix, flags in _levels(_ZIG in compiler).items():
            target = into / f"{NAME}{suffix}.so"
            command = [*compiler, *_FLAGS, *flags, "-o", str(target), str(FOLDER / "src" / "kernel.c"), "-lm"]
            process = subprocess.Popen(
                command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            running.append((target, process))
        errors = [process.communicate()[1] for _, process in running]
        if not any(process.returncode for _, process in running):
            return [target for target, _ in running]
        sys.stderr.write(f"{' '.join(compiler)} fails to compile the planning kernel:\n{''.join(errors)[:2000]}\n")
        for target, _ in running:
            target.unlink(missing_ok=True)
    return []


if __name__ == "__main__":
    built = build(FOLDER, FOLDER.parents[2] / "build" / "zig")
    sys.stdout.write("".join(f"{path}\n" for path in built) or "nothing was built: no C compiler\n")
    sys.exit(not built)
