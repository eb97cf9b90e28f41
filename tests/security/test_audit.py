"""`make audit` audits the pinned versions, fails with pip-audit, and succeeds in one line without the database."""

import subprocess
from pathlib import Path

import pytest

from tests.harness import ROOT


@pytest.mark.parametrize(("reachable", "audited", "code"), [(True, 0, 0), (True, 1, 1), (False, 1, 0)])
def test_exit_code_is_that_of_pip_audit(tmp_path: Path, reachable: bool, audited: int, code: int) -> None:
    fakes = {"python": f"exit {0 if reachable else 1}", "pip-audit": f'echo audited "$@"; exit {audited}'}
    for name, script in fakes.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)
    done = subprocess.run([ROOT / ".ci" / "audit", tmp_path], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == code
    if reachable:
        assert done.stdout.startswith("audited --requirement constraints.txt --no-deps") and not done.stderr
    else:
        unreachable = "dependencies were not audited: https://pypi.org/pypi/pip/24.0/json cannot be reached\n"
        assert (done.stdout, done.stderr) == ("", unreachable)
