"""Reports: what a recording of a run says, as numbers, pictures and one page. Knows nothing of files and networks."""
