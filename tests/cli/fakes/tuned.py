"""The same parameters and those of the motion."""

from common.config import Motion
from common.process.service import main
from tests.cli.fakes import other


class Config(other.Config):
    motion: Motion


if __name__ == "__main__":
    main(other.run, Config)
