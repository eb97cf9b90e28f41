"""What makes the start of a cell's processes and of the command line light."""

import os

# Our matrices have six rows: a pool of threads for them costs each process 0.1 CPU seconds as it starts, and gains
# nothing. pydantic reads the metadata of every installed package for plug-ins, of which we use none.
VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "PYDANTIC_DISABLE_PLUGINS": "__all__"}


def start_light() -> None:
    """Set this before numpy and pydantic are loaded; what the environment says already stays."""
    for name, value in VARIABLES.items():
        os.environ.setdefault(name, value)
