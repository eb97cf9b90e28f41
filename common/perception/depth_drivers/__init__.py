"""Drivers of depth cameras that come with the project (extras of the same names): a file each, imported when named."""
