"""Slicer's package: whole inside 3D Slicer, in part in the wheel slicer-core.

Whatever it holds is of any type, so that checks say the same with and without it. A submodule has a file here.
"""

from typing import Any

def __getattr__(name: str) -> Any: ...
