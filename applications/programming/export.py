"""Export a program as a readable Python script over the blocking client."""

from __future__ import annotations
