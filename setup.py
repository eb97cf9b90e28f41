"""What pyproject.toml cannot say: a wheel holds the folders of the clone below `zencell/`, and a compiled kernel.

docs/architecture.md, "Where modules live", has the rule; docs/planning.md tells of the kernel. Where it cannot be
compiled the package is installed without it.
"""

import runpy
import shutil
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

FOLDERS = ("common", "services", "cli", "config", "applications", "page", "drivers", "recording", "tools", "lab",
           "security")
KERNEL = Path("common", "planning", "kernel")


def compile_kernel(into: Path, cache: Path) -> None:
    """Put the kernel's libraries into a folder, or say that there are none."""
    if not runpy.run_path(str(KERNEL / "build.py"))["build"](into.resolve(), cache.resolve()):
        sys.stderr.write("the planning kernel was not compiled: coal is used in its place, see `zencell doctor`\n")


class BuildWithFolders(build_py):
    """Copies the folders as they are; an editable installation uses those of the clone."""

    def run(self) -> None:
        """Build the package, compile the kernel, and put the folders into it."""
        super().run()
        cache = Path(self.get_finalized_command("build").build_temp, "zig")
        if self.editable_mode:
            compile_kernel(KERNEL, cache)
            return
        inside = Path(self.build_lib, "zencell", "top-level")
        shutil.rmtree(inside, ignore_errors=True)  # what an earlier build left and the clone no longer has
        for folder in FOLDERS:
            shutil.copytree(folder, inside / folder, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
        for example in Path("examples").glob("*/cell.yaml"):  # `zencell new` begins with one
            shutil.copytree(example.parent, inside / example.parent, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy("constraints.txt", inside)  # `zencell doctor` compares
        compile_kernel(inside / KERNEL, cache)
        shutil.rmtree(cache, ignore_errors=True)


class PlatformWheel(bdist_wheel):
    """A wheel for one kind of processor and any Python, when it holds the kernel."""

    def get_tag(self) -> tuple[str, str, str]:
        """The interpreter, ABI and platform in the wheel's name."""
        tag: tuple[str, str, str] = super().get_tag()
        inside = Path(self.get_finalized_command("build").build_lib, "zencell", "top-level")
        if not list((inside / KERNEL).glob("*.so")):
            return tag
        self.root_is_pure = False
        platform = self.plat_name or super().get_tag()[2]
        return ("py3", "none", platform.replace("-", "_").replace(".", "_"))


setup(cmdclass={"build_py": BuildWithFolders, "bdist_wheel": PlatformWheel})
