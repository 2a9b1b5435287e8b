"""The `slicer` namespace, 3D Slicer's or that of the slicer-core wheel; no other file in Logic imports it."""

from __future__ import annotations

import importlib
from typing import Any

#: Untyped: its classes are wrapped VTK, and neither program ships stubs for them.
slicer: Any = importlib.import_module("slicer")
