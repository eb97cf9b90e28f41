"""Generate the compose files and deploy/kubernetes from config/cells: `python -m deploy.generate`.

A test checks that the committed files are current.
"""

from __future__ import annotations

from pathlib import Path

from deploy.compose import compose, compose_dev
from deploy.manifests import manifests
from deploy.secured import compose_secure

ROOT = Path(__file__).resolve().parent.parent


def generated() -> dict[Path, str]:
    """Return the text of every generated file."""
    kubernetes = ROOT / "deploy" / "kubernetes"
    return {
        ROOT / "compose.yaml": compose(),
        ROOT / "compose.dev.yaml": compose_dev(),
        ROOT / "compose.secure.yaml": compose_secure(),
        **{kubernetes / name: text for name, text in manifests().items()},
    }


if __name__ == "__main__":
    for path, text in generated().items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
