"""One cell that is up for whoever asked for it: checked, started, shown, told of, and ended."""
