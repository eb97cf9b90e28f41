"""Services, one process each: thin shells that declare keys, loop, call and publish. Logic is in common/."""

from common.process.environment import set_startup_variables

set_startup_variables()
