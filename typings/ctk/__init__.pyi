"""Exists inside 3D Slicer only; whatever it holds is of any type."""

from typing import Any

def __getattr__(name: str) -> Any: ...
