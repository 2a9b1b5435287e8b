"""Where an image lies in the probe frame, and what pages draw around it: ruler, focus, grey bar, caption."""

from __future__ import annotations

from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Height of the image in heights of its letters
_LETTERS = 36.0


def description(taken: TakenImage) -> dict[str, object]:
    """What pages show with an image, in one message with it, so that it is never that of another image."""
    return {
        "ruler": ruler(taken.grid, taken.preset),
        "patient": taken.patient,
        "time": taken.time,
        "pose": taken.probe_to_world.round(3).tolist(),
        "sequence": None if taken.number is None else taken.number + 1,
    }


def ruler(grid: ImageGrid, preset: Preset) -> dict[str, object]:
    """Edges of an image in the probe frame, mm, marks of depth, size of letters, focus, and dynamic range."""
    width, height = grid.columns * grid.pixel_spacing_mm[0], grid.rows * grid.pixel_spacing_mm[1]
    step = 10 if height > 40 else 5
    depths = range(0, int(grid.top_mm + height) + 1, step)
    return {
        "x": grid.left_mm,
        "y": grid.top_mm,
        "w": width,
        "h": height,
        "ticks": [{"y": depth, "text": str(depth) if depth % (2 * step) == 0 else ""} for depth in depths],
        "size": height / _LETTERS,
        "focus": preset.probe.focus_mm or 0.0,
        "range": f"{preset.display.dynamic_range_db:.0f}",
    }
