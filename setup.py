"""Build steps beyond pyproject.toml: copy the folders of the clone below `zencell/`, and compile the planning kernel.

See docs/architecture.md, "Where modules live", and docs/planning.md. If the kernel cannot be compiled, the package is
installed without it.
"""

import runpy
import shutil
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

FOLDERS = ("common", "services", "cli", "config", "applications", "page", "drivers", "recording", "tools", "lab",
           "security", "bridges")
KERNEL = Path("common", "planning", "kernel")


def compile_kernel(into: Path, cache: Path) -> None:
    """Compile the kernel's libraries into a folder, or report that they cannot be compiled."""
    if not runpy.run_path(str(KERNEL / "build.py"))["build"](into.resolve(), cache.resolve()):
        sys.stderr.write("the planning kernel was not compiled: coal is used instead, see `zencell doctor`\n")


class BuildWithFolders(build_py):
    """Copy the folders; an editable installation uses those of the clone."""

    def run(self) -> None:
        """Build the package, compile the kernel, and copy the folders."""
        super().run()
        cache = Path(self.get_finalized_command("build").build_temp, "zig")
        if self.editable_mode:
            compile_kernel(KERNEL, cache)
            return
        inside = Path(self.build_lib, "zencell", "top-level")
        shutil.rmtree(inside, ignore_errors=True)  # leftovers of an earlier build
        for folder in FOLDERS:
            shutil.copytree(folder, inside / folder, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
        for example in Path("examples").glob("*/cell.yaml"):  # templates of `zencell new`
            shutil.copytree(example.parent, inside / example.parent, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree("examples/policy", inside / "examples" / "policy",  # config/cells/policy_panda.yaml names it
                        ignore=shutil.ignore_patterns("__pycache__", "test_*"))
        shutil.copy("constraints.txt", inside)  # for `zencell doctor`
        compile_kernel(inside / KERNEL, cache)
        shutil.rmtree(cache, ignore_errors=True)


class PlatformWheel(bdist_wheel):
    """Tag a wheel with the kernel for one platform and any Python 3."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the interpreter, ABI and platform tags."""
        tag: tuple[str, str, str] = super().get_tag()
        inside = Path(self.get_finalized_command("build").build_lib, "zencell", "top-level")
        if not list((inside / KERNEL).glob("*.so")):
            return tag
        self.root_is_pure = False
        platform = self.plat_name or super().get_tag()[2]
        return ("py3", "none", platform.replace("-", "_").replace(".", "_"))


setup(cmdclass={"build_py": BuildWithFolders, "bdist_wheel": PlatformWheel})
