"""Digital and analog inputs and outputs: docs/io.md."""
