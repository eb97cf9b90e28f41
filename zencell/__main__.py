"""The `zencell` command, also as `python -m zencell`."""

import signal

# Ctrl-C while we still import ends the process without a traceback: nothing was started yet. cli.main undoes it.
signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Run the verb that the process's arguments name and end the process with its code."""
    from common.process.environment import set_startup_variables

    set_startup_variables()
    from cli.main import app

    app()


if __name__ == "__main__":
    main()
