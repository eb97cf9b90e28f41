"""What pyproject.toml cannot say: a wheel holds the folders of the clone below `zencell/`.

docs/architecture.md, "Where modules live", has the rule.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

FOLDERS = ("common", "services", "cli", "config")


class BuildWithFolders(build_py):
    """Copies the folders as they are; an editable installation uses those of the clone."""

    def run(self) -> None:
        """Build the package, and put the folders into it."""
        super().run()
        if self.editable_mode:
            return
        inside = Path(self.build_lib, "zencell", "top-level")
        shutil.rmtree(inside, ignore_errors=True)  # what an earlier build left and the clone no longer has
        for folder in FOLDERS:
            shutil.copytree(folder, inside / folder, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy("constraints.txt", inside)  # `zencell doctor` compares


setup(cmdclass={"build_py": BuildWithFolders})
