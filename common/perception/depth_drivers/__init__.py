"""Drivers of depth cameras that come with the project (extra `cameras`): one file each, imported only when named."""
