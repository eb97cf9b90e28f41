"""Certificates of a secured cell and the access rights of its processes."""
