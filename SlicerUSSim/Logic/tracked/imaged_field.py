"""estimate_field: the imaged field and the geometry of the probe, estimated from a scanner's images.

Scanners show the field on black, with rulers, logos and text beside it. The field is the largest connected region of
pixels that are bright in any image. Its two straight sides show whether scan lines are parallel or meet at an apex.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.probe.arrays import Probe, probe_from_dict

_log = logging.getLogger(__name__)

#: Largest grey level of the black background around the field.
_DARK = 4
#: Sides with a smaller angle to the vertical belong to a linear array, degrees.
_PARALLEL_DEG = 1.5
#: A phased array has an apex radius below this fraction of the outer radius: 4.5 of 78 mm are a small convex array,
#: whose image would begin 4.5 mm early as a phased array.
_POINT_SHARE = 0.03
#: Least overlap of the estimated field with the bright region (intersection over union).
_LEAST_OVERLAP = 0.85


@dataclass(frozen=True, eq=False)
class ImagedField:
    """The imaged field of an image, as a probe and its position in the image."""

    probe: Probe
    #: (4, 4) map from (column, row, 0, 1) to the probe frame in millimetres
    image_to_probe: np.ndarray
    #: (rows, columns) bool, pixels in the field
    mask: np.ndarray
    #: Overlap of the field with the bright region: intersection over union, 1 is perfect; NaN if it was not estimated
    overlap: float = float("nan")

    @classmethod
    def of(cls, probe: Probe, image_to_probe: np.ndarray, shape: tuple[int, int], overlap=float("nan")) -> ImagedField:
        """The field of a known probe in an image of `shape` (rows, columns)."""
        columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
        x = image_to_probe[0, 0] * columns + image_to_probe[0, 1] * rows + image_to_probe[0, 3]
        y = image_to_probe[1, 0] * columns + image_to_probe[1, 1] * rows + image_to_probe[1, 3]
        return cls(probe, image_to_probe, probe.holds(x, y), overlap)

    @property
    def window(self) -> tuple[slice, slice]:
        """Smallest range of rows and columns around the field. Raises SimulationError if it is outside the image."""
        rows, columns = (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        require(rows.size > 0, "the probe's field is outside the images, expected an overlap")
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    def outline_pixels(self) -> np.ndarray:
        """(points, 2) closed outline as (column, row)."""
        outline = self.probe.outline_mm()
        points = np.concatenate([outline, np.ones((len(outline), 1))], axis=1) @ np.linalg.inv(self.image_to_probe).T
        return points[:, :2]


def estimate_field(images: np.ndarray, pixel_spacing_mm: tuple[float, float], **probe_parameters) -> ImagedField:
    """The imaged field in images, and the probe with this field.

    Parameters
    ----------
    images : (n, rows, columns) or (rows, columns) uint8, rows away from the probe; more images show more of the field.
    pixel_spacing_mm : (column, row).
    probe_parameters : further parameters of the probe, such as frequency_mhz.

    Raises SimulationError if no field is found (black images, or a bright region of another shape).
    """
    images = np.asarray(images)
    stack = images if images.ndim == 3 else images[None]
    require(stack.ndim == 3 and stack.size > 0, f"images have shape {images.shape}, expected (n, rows, columns)")
    bright = bright_region(stack)
    scale = np.asarray(pixel_spacing_mm, float)
    require(
        scale.shape == (2,) and bool((scale > 0).all()), f"pixel spacing is {pixel_spacing_mm}, expected (x, y) in mm"
    )
    left, right = _sides(bright, scale)
    rows, columns = np.nonzero(bright)
    points = np.stack([columns, rows], axis=1) * scale
    if max(abs(left[1]), abs(right[1])) < np.tan(np.deg2rad(_PARALLEL_DEG)):
        kind, geometry, origin = _linear(points, scale)
    else:
        kind, geometry, origin = _sector(points, left, right, scale)
    image_to_probe = np.diag([*scale, 1.0, 1.0])
    image_to_probe[:2, 3] = -origin
    try:
        probe = probe_from_dict({"kind": kind, **geometry, **probe_parameters}, "estimated probe")
    except SimulationError as error:
        raise SimulationError(
            f"{error}; pixels are {scale[0]:.3g} x {scale[1]:.3g} mm large, check the calibration"
        ) from None
    field = ImagedField.of(probe, image_to_probe, bright.shape)
    overlap = float((field.mask & bright).sum() / (field.mask | bright).sum())
    require(
        overlap >= _LEAST_OVERLAP,
        f"the bright region of the images is not a probe's field (best overlap {overlap:.0%}); give the probe and its "
        "position",
    )
    sizes = ", ".join(f"{name} {value:.1f}" for name, value in geometry.items())
    _log.info("field found in the images: %s probe (%s), over %.0f %% of the bright region", kind, sizes, 100 * overlap)
    return replace(field, overlap=overlap)


def place_field(images: np.ndarray, pixel_spacing_mm: tuple[float, float], probe: Probe) -> ImagedField:
    """The field of a known probe at the place where it covers the bright region of the images best; one may be enough.

    Parameters as those of estimate_field. The bright region is in the field, and begins at the probe's face.
    Raises SimulationError for black images, and if the field covers less than 0.85 of the bright region.
    """
    from scipy import signal  # takes half a second to import, which every start of the program would have to wait for

    images = np.asarray(images)
    stack = images if images.ndim == 3 else images[None]
    bright = bright_region(stack)
    scale = np.asarray(pixel_spacing_mm, float)
    outline = probe.outline_mm()[:, :2]
    low = np.floor(outline.min(axis=0) / scale).astype(int) - 1
    size = np.ceil(outline.max(axis=0) / scale).astype(int) + 2 - low
    x, y = np.meshgrid(*((low[axis] + np.arange(size[axis])) * scale[axis] for axis in (0, 1)))
    inside = probe.holds(x, y).astype(np.float32)
    # Just above the face and beside the field it is black, just below the face it is not
    step = max(round(2.0 / scale[1]), 1)
    near = inside * (1.0 - np.pad(inside, ((step, 0), (0, 0)))[: inside.shape[0]])
    covered = signal.fftconvolve(bright.astype(np.float32), inside[::-1, ::-1])
    at_face = signal.fftconvolve(bright.astype(np.float32), near[::-1, ::-1])
    row, column = np.unravel_index(np.argmax(covered + at_face), covered.shape)
    corner = np.array([column - size[0] + 1, row - size[1] + 1])
    image_to_probe = np.diag([*scale, 1.0, 1.0])
    image_to_probe[:2, 3] = (low - corner) * scale
    field = ImagedField.of(probe, image_to_probe, bright.shape)
    share = float((field.mask & bright).sum() / bright.sum())
    require(
        share >= _LEAST_OVERLAP,
        f"the probe's field covers {share:.0%} of the bright region in the images, expected at least "
        f"{_LEAST_OVERLAP:.0%}; check its geometry and the calibration",
    )
    _log.info("the probe's field covers %.0f %% of the bright region in the images", 100 * share)
    return replace(field, overlap=float((field.mask & bright).sum() / (field.mask | bright).sum()))


def draw_field(path: str | os.PathLike, image: np.ndarray, field: ImagedField) -> None:
    """Write a PNG of an image (rows, columns) with the outline of the field, to check the estimate."""
    from PIL import Image, ImageDraw

    shown = np.repeat(np.asarray(image, np.uint8)[..., None], 3, axis=2)
    hidden = ImagedField.of(field.probe, field.image_to_probe, field.mask.shape).mask & ~field.mask
    shown[hidden, :2] //= 2
    shown[hidden, 2] = np.maximum(shown[hidden, 2], 110)  # blue: in the field, but cut off or drawn over
    picture = Image.fromarray(shown)
    draw = ImageDraw.Draw(picture)
    draw.line([tuple(point) for point in field.outline_pixels()], fill=(255, 200, 61), width=2)
    x, y = np.linalg.inv(field.image_to_probe)[:2, 3]
    draw.ellipse((x - 4, y - 4, x + 4, y + 4), outline=(255, 90, 60), width=2)  # the centre of the probe's face
    kind = field.probe.to_dict()["kind"]
    fits = "" if np.isnan(field.overlap) else f", overlap {field.overlap:.0%}"
    draw.text((8, picture.height - 16), f"{kind}, {field.probe.depth_mm:.1f} mm deep{fits}", fill=(255, 200, 61))
    with written_whole(path) as partial:
        picture.save(partial, "PNG")


def bright_region(images: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: the largest connected region bright in any image, without holes and thin attachments.

    Raises SimulationError for black images.
    """
    bright = ndimage.binary_closing(images.max(axis=0) > _DARK, iterations=3)
    bright = ndimage.binary_opening(bright, structure=np.ones((9, 9)))
    # Casts: the return types of scipy's functions depend on their arguments, without type annotations for that.
    labels, count = cast(tuple[np.ndarray, int], ndimage.label(bright))
    require(count > 0, "the images are black, expected an imaged field")
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return cast(np.ndarray, ndimage.binary_fill_holes(labels == sizes.argmax()))


def _sides(bright: np.ndarray, scale: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """The two straight sides as x = a + b y, millimetres: the longest edges of the convex hull on either side."""
    from scipy.spatial import ConvexHull, QhullError

    rows, columns = np.nonzero(bright ^ ndimage.binary_erosion(bright))
    points = np.stack([columns, rows], axis=1) * scale
    try:
        hull = points[ConvexHull(points).vertices]
    except QhullError:
        raise SimulationError("the bright region of the images is not a probe's field: it has no area") from None
    middle = hull.mean(axis=0)
    found = []
    for is_right in (False, True):
        # Edges of the hull on this side, of which the longest is taken
        ends = [(p, q) for p, q in zip(hull, np.roll(hull, -1, axis=0), strict=True)]
        side = [
            (p, q)
            for p, q in ends
            if (0.5 * (p + q)[0] > middle[0]) == is_right and 3.0 * abs(q[1] - p[1]) > abs(q[0] - p[0])
        ]
        require(bool(side), "the bright region of the images is not a probe's field: it has no straight sides")
        p, q = max(side, key=lambda edge: np.hypot(*(edge[1] - edge[0])))
        slope = (q[0] - p[0]) / (q[1] - p[1])
        # The hull passes through the outermost points only; the line is fitted to all border points near it.
        distance = np.abs(points[:, 0] - p[0] - slope * (points[:, 1] - p[1]))
        low, high = sorted((p[1], q[1]))
        near = (distance < 3.0 * scale[0]) & (points[:, 1] >= low) & (points[:, 1] <= high)
        slope, start = (
            np.polyfit(points[near, 1], points[near, 0], 1) if near.sum() > 10 else (slope, p[0] - slope * p[1])
        )
        # The centres of border pixels lie half a pixel inside on average, along rows or, for flat sides, columns.
        outward = 0.5 * max(scale[0], abs(slope) * scale[1]) * (1.0 if is_right else -1.0)
        found.append((float(start) + outward, float(slope)))
    return found[0], found[1]


def _linear(points: np.ndarray, scale: np.ndarray) -> tuple[str, dict[str, float], np.ndarray]:
    low, high = np.percentile(points, 0.1, axis=0) - 0.5 * scale, np.percentile(points, 99.9, axis=0) + 0.5 * scale
    width, depth = (high - low).tolist()
    return "linear", {"width_mm": width, "depth_mm": depth}, np.array([0.5 * (low[0] + high[0]), low[1]])


def _sector(points: np.ndarray, left, right, scale) -> tuple[str, dict[str, float], np.ndarray]:
    require(right[1] > left[1], "the sides of the bright region converge, expected a field that widens with depth")
    depth = (left[0] - right[0]) / (right[1] - left[1])
    apex = np.array([left[0] + left[1] * depth, depth])
    half = 0.5 * (np.arctan(right[1]) - np.arctan(left[1]))
    away = points - apex
    radius, angle = np.hypot(*away.T), np.arctan2(away[:, 0], away[:, 1])
    in_sides = np.abs(angle) < half
    require(bool(in_sides.any()), "the bright part of the images is not a probe's field, it is outside its own sides")
    radius, angle = radius[in_sides], angle[in_sides]
    # The probe face is a circle about the apex. The first bright pixel of each direction, one pixel wide, lies on it;
    # the pixel's centre is on average half a pixel deeper.
    directions = max(int(2.0 * half * radius.min() / scale[0]), 20)
    bins = np.minimum((0.5 * (angle / half + 1.0) * directions).astype(int), directions - 1)
    first = np.full(directions, np.inf)
    np.minimum.at(first, bins, radius)
    middle = first[directions // 8 : directions - directions // 8]
    inner = max(float(np.median(middle[np.isfinite(middle)]) - 0.5 * scale[1]), 0.0)
    # Pixels are uniform over the area and therefore uniform in squared radius, so a percentile gives the outer radius.
    share = 0.999
    outer = float(np.sqrt(inner**2 + (np.percentile(radius**2, 100.0 * share) - inner**2) / share))
    opening = {"field_of_view_deg": float(2.0 * np.rad2deg(half))}
    if inner < _POINT_SHARE * outer:
        return "phased", {**opening, "depth_mm": outer}, apex
    return "convex", {**opening, "radius_mm": inner, "depth_mm": outer - inner}, apex + [0.0, inner]
