from common.process.service import main
from tests.cli.fakes.tiny import Config, run

if __name__ == "__main__":
    main(run, Config)
