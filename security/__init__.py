"""Certificates of a secured cell and who may do what in it."""
