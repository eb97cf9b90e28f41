"""One process each: a thin shell that declares, is ready, loops, asks and publishes. What it thinks is in common/."""

from common.process.environment import set_startup_variables

set_startup_variables()
