"""The `zencell` command, also `python -m zencell`."""

import signal

# Ctrl-C during the imports ends the process without a traceback: nothing was started yet. cli.main restores it.
signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Run the command of the process arguments and exit with its code."""
    from common.process.environment import set_startup_variables

    set_startup_variables()
    from cli.main import app

    app()


if __name__ == "__main__":
    main()
