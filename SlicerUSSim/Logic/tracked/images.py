"""TrackedImages: real images of a tracked sequence, prepared for comparison: probe, poses, images, imaged field."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.transforms import check_rigid, nearest_rotation
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tracked.hidden import spread_images, visible_part
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField, bright_region, estimate_field, place_field
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence, asked_ends

_log = logging.getLogger(__name__)

#: Largest cosine between the axes of an image that still counts as perpendicular.
_SKEW = 1e-3
#: Of the field: an image that is brighter than black, as codecs leave it, in less of it cannot be compared
_LEAST_SHOWN, _BLACK = 0.02, 4
#: Least area of a given probe's field by that of what images show, which may have other bright areas beside it, and
#: largest area by that of an image, which may be cropped
_LEAST_AREA, _MOST_AREA = 1 / 3, 4.0
#: Least size of a pixel of a scanner's image; largest distance of a probe's face from its sensor
_LEAST_PIXEL_MM, _MOST_FACE_MM = 0.005, 500.0


@dataclass(frozen=True, eq=False)
class TrackedImages:
    """Real images with the data needed to simulate the same images."""

    probe: Probe
    #: (4, 4) probe_to_ras of each image
    poses: list[np.ndarray]
    #: (rows, columns) uint8, each cropped to the field
    images: list[np.ndarray]
    #: Pixels of the cropped images in the probe frame
    grid: ImageGrid
    #: (rows, columns) bool, the field in the cropped images
    mask: np.ndarray
    #: Numbers of the images in the sequence, and the field in the uncropped images
    numbers: list[int]
    field: ImagedField

    @classmethod
    def of(
        cls,
        sequence: TrackedSequence,
        numbers: Sequence[int] | None = None,
        *,
        path: str = "ImageToReference",
        reference_to_ras: np.ndarray | None = None,
        probe: Probe | None = None,
        beam: Probe | None = None,
        most: int | None = None,
        apart: Sequence[int] = (),
        field: ImagedField | None = None,
        finds_marks: bool = True,
    ) -> TrackedImages:
        """Prepare images of a sequence.

        Parameters
        ----------
        numbers : which images (default: all whose pose is known, or `most` of them, evenly distributed).
        path : transform from pixels to the reference frame, which is fixed to the patient.
        reference_to_ras : (4, 4) rigid map from that frame to the MRI (default: identity).
        probe : the probe, if known. Its position in the image is then taken from ImageToProbe, if the sequence has this
            transform in the probe frame (as in sequences written by this package), or else estimated from the images.
            Without `probe` the probe is estimated too.
        apart : images that are prepared as well, but are not among those of the default choice; see `split`.
        beam : probe whose parameters other than the geometry are used for an estimated probe.
        field : the probe and its place in the images, if both are known, as for images prepared before; what a scanner
            draws over it is detected again.
        finds_marks : whether to detect what a scanner draws over the field, as for a comparison.

        Raises SimulationError for images that do not exist or were not tracked, a skewed calibration, a field that
        cannot be estimated or whose size is not that of what images show, and images that are black or of one grey
        level (nearly everywhere). A calibration that mirrors, tinted images, and what a file cuts off or a scanner
        draws over the field (hidden.py) are warned of.
        """
        require(
            sequence.image_type == "BRIGHTNESS",
            f"the sequence has {sequence.image_type} data, expected B-mode images (BRIGHTNESS)",
        )
        tracked = [n for n in range(len(sequence)) if sequence.has_pose(n, path)]
        kept = [n for n in tracked if n not in apart] if numbers is None else list(numbers)
        if numbers is None and 0 < len(tracked) < len(sequence):
            missing = len(sequence) - len(tracked)
            _log.warning("%d of %d images have no %s and are left out", missing, len(sequence), path)
        if numbers is None and most is not None and len(kept) > most:
            kept = [kept[place] for place in np.linspace(0, len(kept) - 1, most).round().astype(int)]
        kept += [number for number in apart if number not in kept]
        # If no image was tracked, the error for the first one names the missing transform.
        matrices = [sequence.pose(number, path) for number in kept or [0]]
        chosen = sequence.select(kept)
        if numbers is None:
            _log.info("images chosen: %d of %d: %s", len(kept), len(sequence), _listed(kept))
        steps = sequence.composition(kept[0], path)
        if steps != [path]:
            _log.info("%s is composed of %s", path, ", ".join(steps))
        images = _as_uint8(chosen.images)
        if sequence.has_images:
            for number, image in zip(kept, images, strict=True):
                require(int(image.max()) > 0, f"image {number} of the sequence is black")
            spacing = pixel_spacing(matrices[0], path)
            # All images of the recording show more of the field than the few that are fitted
            every = _as_uint8(spread_images(sequence.images))
            if field is None:
                field = _located_field(sequence, every, spacing, probe, beam)
                if probe is not None:
                    _require_size(field, every, spacing, path)
            finds_marks = finds_marks and sequence.is_recorded
            seen = visible_part(every, field.mask, sequence.coloured, finds_marks=finds_marks)
            require(bool(seen.any()), "the images show nothing of the probe's field")
            for number, image in zip(kept, images, strict=True):
                low, high = int(image[seen].min()), int(image[seen].max())
                require(
                    low < high,
                    f"image {number} has the grey level {low} in all of the probe's field, expected a patient",
                )
                shown = float((image[seen] > _BLACK).sum() / field.mask.sum())
                require(
                    shown >= _LEAST_SHOWN,
                    f"image {number} shows something in {shown:.1%} of the probe's field only, where nothing hides it, "
                    f"expected at least {_LEAST_SHOWN:.0%}",
                )
            field = replace(field, mask=seen)
        field = required(field, "the sequence has poses without images, expected images")
        to_ras = np.eye(4) if reference_to_ras is None else check_rigid("reference_to_ras", reference_to_ras)
        at_face = np.linalg.inv(field.image_to_probe)[:2, 3].tolist()
        poses = [to_ras @ face_pose(matrix, at_face, path) for matrix in matrices]
        window = rows, columns = field.window
        left, top = (field.image_to_probe @ [columns.start - 0.5, rows.start - 0.5, 0.0, 1.0])[:2]
        size = field.image_to_probe[0, 0], field.image_to_probe[1, 1]
        mask = field.mask[window]
        height, width = mask.shape
        grid = ImageGrid(height, width, float(left), float(top), (float(size[0]), float(size[1])))
        cropped = [np.ascontiguousarray(image[window]) for image in images]
        return cls(field.probe, poses, cropped, grid, mask, kept, field)

    def split(self, apart: Sequence[int]) -> tuple[TrackedImages, TrackedImages]:
        """(the others, those with the numbers `apart`), as for a fit and its prediction.

        Raises SimulationError if nothing is left, or for numbers that are not among them.
        """
        others = [number for number in self.numbers if number not in apart]
        require(bool(others), "all images are predicted, expected some to fit")
        return self.only(others), self.only(list(dict.fromkeys(apart)))

    def only(self, numbers: Sequence[int]) -> TrackedImages:
        """Those with these numbers in the sequence. Raises SimulationError for numbers that are not among them."""
        unknown = [number for number in numbers if number not in self.numbers]
        require(not unknown, f"images {_listed(unknown)} are not among {_listed(self.numbers)}")
        places = [self.numbers.index(number) for number in numbers]
        return replace(
            self, poses=[self.poses[n] for n in places], images=[self.images[n] for n in places], numbers=list(numbers)
        )


def pixels_for_poses(sequence: TrackedSequence, path: str, probe: Probe) -> tuple[TrackedSequence, str, ImagedField]:
    """(sequence, path, field) for TrackedImages.of, with which poses without images refer to pixels of `probe`.

    A path from Image is taken from Probe, which is the probe's own frame then. Raises SimulationError for a path that
    no pose has, and for an ImageToProbe of another frame, as the place of the probe in images is not known.
    """
    source, target = asked_ends(path, sequence.frames_of_reference())
    name = f"{'Probe' if source == 'Image' else source}To{target}"
    tracked = [n for n in range(len(sequence)) if sequence.has_pose(n, name)]
    first = tracked[0] if tracked else 0
    sequence.pose(first, name)
    if source == "Image" and sequence.has_pose(first, "ImageToProbe"):
        matrix = sequence.pose(first, "ImageToProbe")
        require(
            _is_upright(matrix, pixel_spacing(matrix, "ImageToProbe")),
            "the sequence has no images that show the probe's place in them, and ImageToProbe is not in the probe's "
            f"own frame; expected {name} of that frame, and no calibration",
        )
    grid = ImageGrid.for_probe(probe, None)
    transforms = [{"ImageToProbe": grid.image_to_probe} for _ in range(len(sequence))]
    for number in tracked:
        transforms[number][f"ProbeTo{target}"] = sequence.pose(number, name)
    field = ImagedField.of(probe, grid.image_to_probe, (grid.rows, grid.columns))
    return replace(sequence, transforms=tuple(transforms)), f"ImageTo{target}", field


def _is_upright(image_to_probe: np.ndarray, spacing: tuple[float, float]) -> bool:
    """Whether the image is upright and in the plane z = 0, as in this package's probe frame, not in a marker's."""
    upright = np.diag([*spacing, 1.0, 1.0])
    upright[:, 3] = image_to_probe[:, 3]
    upright[2, 2] = image_to_probe[2, 2]
    return np.allclose(image_to_probe, upright, atol=1e-4) and abs(image_to_probe[2, 3]) < 1e-6


def _listed(numbers: Sequence[int]) -> str:
    """Numbers for a message, the middle left out where there are many."""
    texts = [str(number) for number in numbers]
    return ", ".join(texts if len(texts) <= 12 else [*texts[:6], "...", *texts[-3:]])


def _as_uint8(images: np.ndarray) -> np.ndarray:
    if images.dtype == np.uint8:
        return images
    _log.info("images of %s numbers are rounded to grey levels", images.dtype)
    require(
        np.issubdtype(images.dtype, np.number) and images.min() >= 0 and images.max() <= 255,
        f"images are {images.dtype} from {images.min()} to {images.max()}, expected grey levels from 0 to 255",
    )
    return images.round().astype(np.uint8)


def pixel_spacing(image_to_world: np.ndarray, path: str) -> tuple[float, float]:
    """(column, row) size of a pixel in millimetres. Raises SimulationError unless pixels are rectangles."""
    x, y = image_to_world[:3, 0], image_to_world[:3, 1]
    size = float(np.linalg.norm(x)), float(np.linalg.norm(y))
    require(min(size) > 0, f"{path} is singular, expected an image's axes in millimetres per pixel")
    cosine = abs(float(x @ y)) / (size[0] * size[1])
    if np.linalg.det(image_to_world[:3, :3]) < 0.0:
        _log.warning("%s mirrors: its axes are left-handed; it is wrong if left and right are exchanged", path)
    require(cosine < _SKEW, f"{path} is skewed: the image's axes have a cosine of {cosine:.2g}, expected 0")
    return size


def _located_field(
    sequence: TrackedSequence,
    images: np.ndarray,
    spacing: tuple[float, float],
    probe: Probe | None,
    beam: Probe | None,
) -> ImagedField:
    if probe is None:
        shared = {field.name for field in fields(Probe)}
        known = {} if beam is None else {name: v for name, v in beam.to_dict().items() if name in shared}
        _log.info("no probe is given: its geometry is estimated from the images, the rest comes from the preset")
        return estimate_field(images, spacing, **known)
    if all("ImageToProbe" in entry for entry in sequence.transforms):
        image_to_probe = np.array(sequence.transforms[0]["ImageToProbe"])
        if _is_upright(image_to_probe, spacing):
            image_to_probe[2, 2] = 1.0
            _log.info("the probe's place in the images is from ImageToProbe, which is in the probe's own frame")
            return ImagedField.of(probe, image_to_probe, images.shape[1:])
    _log.info("the probe's place is estimated from the images: no ImageToProbe in the probe's own frame")
    try:
        found = estimate_field(images, spacing)
    except SimulationError as error:
        _log.info("%s; the given probe's field is placed where it covers them best", error)
        return place_field(images, spacing, probe)
    kinds = found.probe.to_dict()["kind"], probe.to_dict()["kind"]
    require(
        kinds[0] == kinds[1] or {"convex", "phased"} == set(kinds),
        f"the probe is {kinds[1]}, expected {kinds[0]} as in the images",
    )
    depth = found.probe.depth_mm
    if abs(depth - probe.depth_mm) > 0.1 * depth:
        raise SimulationError(
            f"the probe's depth is {probe.depth_mm:g} mm, expected {depth:.1f} mm as in the images; check the "
            "calibration"
        )
    return replace(ImagedField.of(probe, found.image_to_probe, images.shape[1:]), overlap=found.overlap)


def _require_size(field: ImagedField, images: np.ndarray, spacing: tuple[float, float], path: str) -> None:
    """Raise SimulationError if a given probe's field has another size than what images show: pixels of another size."""
    x, y = field.probe.outline_mm()[:, :2].T
    area = 0.5 * abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1))) / (spacing[0] * spacing[1])
    shown = int(bright_region(images).sum())
    require(
        area >= _LEAST_AREA * shown and area <= _MOST_AREA * images[0].size,
        f"the probe's field has {area:.0f} pixels of {spacing[0]:.3g} x {spacing[1]:.3g} mm, the images show "
        f"{shown} of {images[0].size}, expected about as many; check the size of a pixel in {path} or the calibration",
    )


def face_pose(image_to_world: np.ndarray, face_pixel: Sequence[float], path: str) -> np.ndarray:
    """(4, 4) rigid probe_to_world from (4, 4) image_to_world, whose pixels may have any size.

    `face_pixel` is (column, row) of the middle of the probe's face; `path` names the map in errors.
    """
    pose = np.eye(4)
    for axis in range(2):
        column = image_to_world[:3, axis]
        pose[:3, axis] = column / np.linalg.norm(column)
    pose[:3, 2] = np.cross(pose[:3, 0], pose[:3, 1])
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    pose[:3, 3] = (image_to_world @ [*face_pixel, 0.0, 1.0])[:3]
    return check_rigid(path, pose)


def face_of_calibration(
    image_to_probe: np.ndarray, images: np.ndarray | None = None, face_pixel: Sequence[float] | None = None
) -> tuple[np.ndarray, str]:
    """((4, 4) rigid, from the probe frame, at the face, to the tracked sensor, which Plus calls Probe; what was taken).

    `image_to_probe` is a calibration (4, 4), from pixels (column, row, 0, 1) to the sensor, mm. The face is at
    `face_pixel`, or else found in `images` (n, rows, columns), or else in the middle of their first row.
    Raises SimulationError for a skewed calibration, for pixels of another size than scanners have, such as those of a
    calibration in metres, and if the place of the face is unknown.
    """
    spacing = pixel_spacing(image_to_probe, "ImageToProbe")
    size = f"pixels of {spacing[0]:.3g} x {spacing[1]:.3g} mm"
    require(min(spacing) >= _LEAST_PIXEL_MM, f"ImageToProbe has {size}, expected millimetres; is it in metres?")
    if face_pixel is not None:
        place, how = face_pixel, "as given"
    else:
        images = required(images, "where the face is in the image is not known: choose real images, or give its pixel")
        try:
            found = estimate_field(images, spacing)
            place, how = np.linalg.inv(found.image_to_probe)[:2, 3].tolist(), f"found in {found.overlap:.0%} of a field"
        except SimulationError as error:
            _log.info("%s", error)
            place, how = (0.5 * (images.shape[2] - 1), -0.5), "the middle of the first row, no field was found"
    pose = face_pose(image_to_probe, place, "ImageToProbe")
    distance, end = np.linalg.norm(pose[:3, 3]), (np.inf, np.inf) if images is None else images.shape[:0:-1]
    words = f"{size}; face at column {place[0]:.1f}, row {place[1]:.1f} ({how}); {distance:.1f} mm from the sensor"
    if np.greater(place, end).any() or distance > _MOST_FACE_MM:
        words += "; check: the face is outside of the image, or more than half a metre from the sensor"
    if np.linalg.det(image_to_probe[:3, :3]) < 0.0:
        words += "; the calibration mirrors: it is wrong if left and right of the image are exchanged"
    return pose, words
