"""Reports: figures, charts and one page about the recording of a run. No file or network access."""
