"""Pictures of what a probe sees: what is drawn over which image, and where."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from SlicerUSSim.Logic import LinearProbe
from SlicerUSSim.Logic.imaging.figures import draw_views

pytest.importorskip("matplotlib", reason="figures need matplotlib: pip install '.[demo]'")
PROBE = LinearProbe(20, 30)
BOUNDS = (-15.0, 15.0, -2.0, 34.0)


def drawn(tmp_path, *kinds, names=()) -> np.ndarray:
    """(rows, columns, 3) picture of views of these kinds, each a flat grey image."""
    flat = np.full((72, 60), 1, np.uint8)
    draw_views(tmp_path / "views.png", [(kind, flat, kind) for kind in kinds], PROBE, BOUNDS, names)
    return np.asarray(Image.open(tmp_path / "views.png").convert("RGB")).astype(int)


def outlined(picture: np.ndarray) -> np.ndarray:
    """(points, 2) row and column of pixels in the colour of the outline."""
    return np.argwhere(np.abs(picture - [0xFF, 0xC8, 0x3D]).max(axis=-1) < 40)


@pytest.mark.parametrize(("kind", "is_outlined"), [("mri", True), ("labels", True), ("bmode", False)])
def test_the_field_is_outlined_where_more_than_the_field_is_shown(tmp_path, kind, is_outlined):
    points = outlined(drawn(tmp_path, kind, names=("csf",)))
    assert (len(points) > 50) == is_outlined
    if is_outlined:  # as wide and high as the field is, in one scale
        height, width = np.ptp(points, axis=0)
        assert width / height == pytest.approx(20 / 30, abs=0.03)


def test_views_lie_side_by_side_in_their_order(tmp_path):
    one, two = (drawn(tmp_path, *kinds) for kinds in (["mri"], ["bmode", "mri"]))
    assert two.shape[0] == one.shape[0] and two.shape[1] > 1.7 * one.shape[1]
    assert outlined(two)[:, 1].min() > 0.5 * two.shape[1]


def test_an_mri_fills_the_display_and_an_image_keeps_its_levels(tmp_path):
    """A faint MRI fills the display, a faint B-mode image stays faint."""
    mri, bmode = (drawn(tmp_path, kind) for kind in ("mri", "bmode"))
    centre = tuple(slice(size // 2 - 10, size // 2 + 10) for size in mri.shape[:2])
    assert np.median(mri[centre]) > 240 and np.median(bmode[centre]) < 10
