"""The `zencell` command, and the codec for zenoh-cli."""

import signal
import sys
from pathlib import Path

if Path(sys.argv[0]).name in ("zencell", "main.py"):
    # Ctrl-C while we still import ends the process without a traceback: nothing was started yet. main.py undoes it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
