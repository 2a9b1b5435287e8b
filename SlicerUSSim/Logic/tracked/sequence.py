"""TrackedSequence: ultrasound images, each with the transforms measured by a tracker.

The files are sequence metafiles of Plus and IGSIO, which 3D Slicer reads too: MetaImage or NRRD with fields such as
Seq_Frame0003_ProbeToTrackerTransform. Transforms apply to homogeneous column vectors. Coordinates in the frame called
Image are pixels (column, row, 0, 1) of the image in memory, which has the orientation MF: columns towards the marked
side of the probe, rows away from the probe. World frames are RAS in millimetres, as in those programs.
"""

from __future__ import annotations

import logging
import os
import re
import zlib
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_package, required
from SlicerUSSim.Logic.base.files import read_text, written_whole
from SlicerUSSim.Logic.base.image_files import read_image
from SlicerUSSim.Logic.base.reading import reader
from SlicerUSSim.Logic.base.transforms import check_affine, check_rigid, is_singular
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tracked.pose_files import matrix_of_text

_log = logging.getLogger(__name__)

#: File name endings that `write` accepts.
SEQUENCE_SUFFIXES = (".igs.mha", ".seq.mha", ".mha", ".seq.nrrd", ".nrrd")
_FRAME_FIELD = re.compile(r"Seq_Frame(\d+)_(.+)")
#: Field of sequences whose images are simulated
SIMULATED = "SlicerUSSimSimulated"
#: Field of sequences whose images are slices of a 3D ultrasound volume
_CUT = "SlicerUSSimCutFromVolume"
_ORIENTATION, _TYPE = "UltrasoundImageOrientation", "UltrasoundImageType"
_MOST_HEADER_BYTES = 2**26
#: Name of a transform, split at the last To followed by a capital letter or digit
_FROM_TO = re.compile(r"(.+)To([A-Z0-9].*)")
#: Header of transforms without images: 3D Slicer writes images of 0 x 0 pixels, Plus of 1 x 1
_NO_IMAGES = re.compile(rb"^(?:DimSize *=|sizes:) *(?:[01] +){2,}(\d{1,9}) *\r?$", re.MULTILINE)
_OK = "OK"
#: {kind and bytes of a number: its name in MetaImage}
_ELEMENT_TYPES = {
    "u1": "UCHAR", "i1": "CHAR", "u2": "USHORT", "i2": "SHORT", "u4": "UINT", "i4": "INT", "u8": "ULONG_LONG",
    "i8": "LONG_LONG", "f4": "FLOAT", "f8": "DOUBLE",
}  # fmt: skip
#: Fields of ITK and NRRD files that do not belong to a sequence.
_NOT_OURS = (
    "ITK_", "Kinds", "Modality", "NRRD_", "ObjectType", "AnatomicalOrientation", "type", "dimension", "space", "sizes",
    "kinds", "endian", "encoding", "measurement frame", "centers", "spacings", "thicknesses", "axis", "labels", "units",
)  # fmt: skip
#: Least difference of the components of a pixel that has a colour, grey levels; codecs make smaller ones
_COLOURED = 24
#: Least grey level at which colours show; if more of the bright pixels have a colour, it is a tint
_BRIGHT, _MOST_COLOURED = 40, 0.5
_OPPOSITE = {"M": "U", "U": "M", "F": "N", "N": "F"}


@dataclass(frozen=True, eq=False)
class TrackedSequence:
    """Tracked images of one sweep.

    Raises SimulationError if the numbers of images, transforms and timestamps differ, or for matrices that are not 4x4.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import TrackedSequence
    >>> probe_to_reference = np.eye(4)
    >>> probe_to_reference[:3, 3] = [10, 20, 30]
    >>> sequence = TrackedSequence(np.zeros((1, 64, 48), np.uint8), ({"ProbeToReference": probe_to_reference},), [0.0])
    >>> sequence = sequence.with_transforms({"ImageToProbe": np.diag([0.2, 0.2, 0.2, 1.0])})
    >>> sequence.pose(0, "ImageToReference")[:3, 3].tolist()  # composed of the two
    [10.0, 20.0, 30.0]
    >>> sequence.write("tracked.igs.mha")
    >>> len(TrackedSequence.read("tracked.igs.mha"))
    1
    """

    #: [n, row, column], or [n, scan line, sample] for RF data; [n, 0, 0] for poses without images
    images: np.ndarray
    #: {"ProbeToTracker": (4, 4), ...} for each image, without transforms that were not tracked
    transforms: tuple[Mapping[str, np.ndarray], ...]
    #: Seconds
    timestamps: np.ndarray
    #: BRIGHTNESS, or RF_REAL, RF_I_LINE_Q_LINE, RF_IQ_LINE for RF data
    image_type: str = "BRIGHTNESS"
    #: Other fields of the file, and of every image
    fields: Mapping[str, str] = field(default_factory=dict)
    frame_fields: tuple[Mapping[str, str], ...] = ()
    #: (rows, columns) bool, pixels that have a colour in any image, such as Doppler's, and in tinted images another one
    #: than the colour map's; None without colours
    coloured: np.ndarray | None = None

    def __post_init__(self) -> None:
        images = np.asarray(self.images)
        require(images.ndim == 3 and len(images) > 0, f"images have shape {images.shape}, expected (n, rows, columns)")
        count = len(images)
        transforms = tuple(
            {name: _matrix(f"image {n}: {name}", m) for name, m in entry.items()}
            for n, entry in enumerate(self.transforms)
        )
        require(len(transforms) == count, f"{len(transforms)} sets of transforms for {count} images, expected as many")
        timestamps = np.asarray(self.timestamps, float)
        require(timestamps.shape == (count,), f"timestamps have shape {timestamps.shape}, expected ({count},)")
        frame_fields = tuple(self.frame_fields) or ({},) * count
        require(len(frame_fields) == count, f"{len(frame_fields)} sets of fields for {count} images, expected as many")
        for name, value in (
            ("images", images), ("transforms", transforms), ("timestamps", timestamps), ("frame_fields", frame_fields),
        ):  # fmt: skip
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.images)

    @property
    def has_images(self) -> bool:
        """Whether it has images, and not only poses."""
        return self.images.size > 0

    @property
    def is_simulated(self) -> bool:
        """Whether its images say that this package simulated them, as a twin's and those of `ussim sweep` do."""
        return SIMULATED in self.fields

    @property
    def is_recorded(self) -> bool:
        """Whether a scanner may have drawn over its images: neither simulated nor slices of a volume."""
        return not self.is_simulated and _CUT not in self.fields

    # ---- poses -------------------------------------------------------------------------------------------------

    def frames_of_reference(self) -> list[str]:
        """The coordinate frames connected by the transforms."""
        return sorted({end for entry in self.transforms for name in entry for end in _ends(name)})

    def pose(self, number: int, name: str) -> np.ndarray:
        """(4, 4) transform of image `number`, such as ImageToReference: measured, or composed of measured transforms
        and their inverses along the shortest path.

        Raises SimulationError for an image that does not exist, or if no path connects the two frames.
        """
        return self._composed(number, name)[0]

    def composition(self, number: int, name: str) -> list[str]:
        """The names of the transforms of which `pose` composes one of image `number`, in the order in which they act;
        an inverse has "inverse of" before it. Raises SimulationError as `pose` does."""
        return self._composed(number, name)[1]

    def _composed(self, number: int, name: str) -> tuple[np.ndarray, list[str]]:
        self._require_images([number])
        entry = self.transforms[number]
        steps: dict[str, list[tuple[str, np.ndarray, str]]] = {}
        for known, matrix in entry.items():
            start, end = _ends(known)
            steps.setdefault(start, []).append((end, matrix, known))
            if not is_singular(matrix):
                steps.setdefault(end, []).append((start, np.linalg.inv(matrix), f"inverse of {known}"))
        source, target = asked_ends(name, set(steps))
        found: dict[str, tuple[np.ndarray, list[str]]] = {source: (np.eye(4), [])}
        waiting = deque([source])
        while waiting and target not in found:
            here = waiting.popleft()
            for there, matrix, step in steps.get(here, []):
                if there not in found:
                    found[there] = matrix @ found[here][0], [*found[here][1], step]
                    waiting.append(there)
        if target not in found:
            hint = ", such as the calibration ImageToProbe" if source == "Image" and source not in steps else ""
            raise SimulationError(
                f"image {number}: no path from {source} to {target}, the file has {', '.join(sorted(entry)) or 'no'} "
                f"transforms; give the missing one{hint}"
            )
        return found[target]

    def has_pose(self, number: int, name: str) -> bool:
        """Whether `pose` can give this transform of this image, that is, whether it was tracked."""
        try:
            self.pose(number, name)
        except SimulationError:
            return False
        return True

    def with_transforms(self, constant: Mapping[str, np.ndarray]) -> TrackedSequence:
        """The sequence with additional transforms that are constant over all images: a calibration, a registration.

        A calibration of the image, ImageToProbe, takes the place of its own. Others between frames that the transforms
        of the sequence connect are not used, even where these were lost: they were measured. A warning says so.
        """
        keys = set().union(*self.transforms, *self.frame_fields)
        names = {re.sub(r"Transform(Status)?$", "", key) for key in keys}
        known = {name: np.eye(4) for name in names if _FROM_TO.fullmatch(name)}
        of_file = replace(self.select([0]), transforms=(known,))
        measured = {name for name in constant if not name.startswith("ImageTo") and of_file.has_pose(0, name)}
        if measured:
            _log.warning("not used, as the sequence has measured it: constant %s", ", ".join(sorted(measured)))
        added = {name: _matrix(name, matrix) for name, matrix in constant.items() if name not in measured}
        return replace(self, transforms=tuple({**entry, **added} for entry in self.transforms))

    def select(self, numbers: Sequence[int]) -> TrackedSequence:
        """The sequence of only these images. Raises SimulationError for images that do not exist."""
        self._require_images(numbers)
        require(len(numbers) > 0, "no image chosen, expected at least one")
        pick = list(numbers)
        return replace(
            self,
            images=self.images[pick],
            transforms=tuple(self.transforms[n] for n in pick),
            timestamps=self.timestamps[pick],
            frame_fields=tuple(self.frame_fields[n] for n in pick),
        )

    def _require_images(self, numbers: Sequence[int]) -> None:
        last = len(self) - 1
        for number in numbers:
            exists = int(number) == number and 0 <= number <= last
            require(exists, f"image {number} does not exist, expected 0 to {last}")

    def with_images(self, numbers: Sequence[int], images: np.ndarray) -> TrackedSequence:
        """The images `numbers` with other pixels [n, row, column], and with their original transforms and times."""
        return replace(self.select(numbers), images=images)

    # ---- files -------------------------------------------------------------------------------------------------

    @classmethod
    @reader
    def read(cls, path: str | os.PathLike) -> TrackedSequence:
        """Read a sequence metafile (.igs.mha, .seq.mha, .mhd, .nrrd), compressed or not, in any image orientation.

        Transforms whose status is not OK were not tracked and are omitted, and so are those without a name or matrix.
        Colours are converted to grey levels, those of a colour map with a warning. Transforms alone, as 3D Slicer
        saves a sequence of them, are poses without images.
        Raises SimulationError for a file that is missing, unreadable or of another format.
        """
        path = Path(path)
        require(path.is_file(), f"{path}: no such file")
        with path.open("rb") as file:
            start = file.read(65536)
        if (found := _NO_IMAGES.search(start)) is not None:
            pixels, header = _read_poses(path, int(found[1]))
        else:
            pixels, header = _read_images(path)
        return _from_header(pixels, header, str(path))

    def write(self, path: str | os.PathLike, compress: bool = True) -> None:
        """Write a sequence metafile; the format follows from the name (SEQUENCE_SUFFIXES).

        An existing file is replaced only when the new one is complete. Raises SimulationError for another name, or if
        the file cannot be written.
        """
        path = Path(path)
        require_sequence_name(path)
        write_format = _write_nrrd if path.name.lower().endswith(".nrrd") else _write_metaimage
        with written_whole(path) as partial:
            write_format(partial, self.images, self._header(), compress)

    def _header(self) -> dict[str, str]:
        is_rf = self.image_type != "BRIGHTNESS"
        header = {**self.fields, _ORIENTATION: "FM" if is_rf else "MF", _TYPE: self.image_type}
        names = sorted({name for entry in self.transforms for name in entry})
        for n, (entry, extra) in enumerate(zip(self.transforms, self.frame_fields, strict=True)):
            frame = {"ImageStatus": _OK, **extra, "Timestamp": f"{self.timestamps[n]:.6f}"}
            for name in names:
                matrix = entry.get(name, np.eye(4))
                frame[f"{name}Transform"] = " ".join(f"{value:.9g}" for value in matrix.ravel())
                frame[f"{name}TransformStatus"] = _OK if name in entry else "INVALID"
            header |= {f"Seq_Frame{n:04d}_{key}": value for key, value in frame.items()}
        return header

    # ---- other sources -----------------------------------------------------------------------------------------

    @classmethod
    def from_slices(cls, paths: Iterable[str | os.PathLike]) -> TrackedSequence:
        """From one image file per slice with its position in the patient, as in the MNI's BITE database (MINC 1 or 2).

        ImageToReference of each image is the geometry of its file. Raises SimulationError for files that do not contain
        exactly one slice each, or differ in size.
        """
        slices = [_read_slice(Path(path)) for path in paths]
        require(bool(slices), "no slice, expected at least one file")
        shapes = {image.shape for image, _ in slices}
        require(len(shapes) == 1, f"the slices have the sizes {sorted(shapes)}, expected one size")
        images = np.stack([image for image, _ in slices])
        if images.dtype != np.uint8:
            top = float(images.max())
            _log.info("grey levels of the slices go to %g, %s", top, "scaled to 255" if top > 255.0 else "rounded")
            images = np.clip(images * (255.0 / top if top > 255.0 else 1.0), 0, 255).round().astype(np.uint8)
        return cls(images, tuple({"ImageToReference": m} for _, m in slices), np.arange(len(slices), dtype=float))

    @classmethod
    def from_volume(cls, volume: Volume, probe, poses: Iterable[np.ndarray], image_size=None) -> TrackedSequence:
        """Slices of a 3D ultrasound volume (such as RESECT's) in the image planes of a probe at (4, 4) probe_to_ras.

        ProbeToReference are the poses, ImageToProbe belongs to the probe's image. Outside the imaged field the images
        are black.
        """
        from SlicerUSSim.Logic.base.transforms import check_rigid
        from SlicerUSSim.Logic.probe.image_grid import ImageGrid
        from SlicerUSSim.Logic.probe.poses import slice_under_probe

        grid = ImageGrid.for_probe(probe, image_size)
        inside = grid.field(probe)
        poses = [check_rigid(f"pose {n}", pose) for n, pose in enumerate(poses)]
        images = [np.where(inside, slice_under_probe(volume, grid, pose), 0) for pose in poses]
        array = np.clip(np.stack(images), 0, 255).round().astype(np.uint8)
        transforms = tuple({"ImageToProbe": grid.image_to_probe, "ProbeToReference": pose} for pose in poses)
        return cls(array, transforms, np.arange(len(poses), dtype=float), fields={_CUT: "True"})


def is_tracked_sequence(path: str | os.PathLike) -> bool:
    """Whether the header of an image file has fields of tracked images."""
    path = Path(path)
    if not path.name.lower().endswith((*SEQUENCE_SUFFIXES, ".mhd")) or not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(65536)
    return b"Seq_Frame" in start or _ORIENTATION.encode() in start


def require_sequence_name(path: Path) -> None:
    """Raise SimulationError unless TrackedSequence.write supports the format of this file name."""
    require(
        path.name.lower().endswith(SEQUENCE_SUFFIXES),
        f"{path}: unknown sequence format, expected a name ending in one of {', '.join(SEQUENCE_SUFFIXES)}",
    )


def frame_numbers(text: str, count: int) -> list[int]:
    """Numbers of images from a text: 0,5,10 or 3-5 (with both ends), or start:stop:step as in Python, or several.

    Raises SimulationError for other text, and if it selects none of the `count` images.
    """
    numbers: list[int] = []
    for part in text.split(","):
        try:
            if ":" in part:
                numbers += range(count)[slice(*(int(end) if end.strip() else None for end in part.split(":")))]
            elif (ends := re.fullmatch(r"\s*(\d+)\s*-\s*(\d+)\s*", part)) is not None:
                numbers += range(int(ends[1]), int(ends[2]) + 1)
            else:
                numbers.append(int(part))
        except (TypeError, ValueError):  # not numbers; more than three; a step of 0
            raise SimulationError(f"frames are {text!r}, expected numbers such as 0,5,10, 3-5 or 0:20:5") from None
    require(bool(numbers), f"frames are {text!r}, expected at least one of the {count} images")
    return numbers


def checked_apart(text: str, fitted: Sequence[int] | None, count: int) -> list[int]:
    """Numbers of images that are predicted, from a text as for frame_numbers; an empty one selects none.

    Raises SimulationError for other text, and for images that are `fitted` (None: not known) as well.
    """
    if not text.strip():
        return []
    numbers = list(dict.fromkeys(frame_numbers(text, count)))
    both = [str(number) for number in numbers if fitted is not None and number in fitted]
    require(not both, f"images {', '.join(both)} are fitted and predicted, expected others to predict")
    return numbers


# ---- fields ----------------------------------------------------------------------------------------------------------


def _ends(name: str) -> tuple[str, str]:
    """Frames of a transform in a file."""
    expected = f"transform is {name!r}, expected two frames joined by To, such as ProbeToTracker"
    found = required(_FROM_TO.fullmatch(name), expected)
    return found[1], found[2]


def asked_ends(name: str, known: Collection[str]) -> tuple[str, str]:
    """Frames of a transform that is asked for, if possible `known` ones. Raises SimulationError for other names."""
    splits = [(name[: m.start()], name[m.end() :]) for m in re.finditer("To", name)]
    splits = [(start, end) for start, end in splits if start and end]
    require(bool(splits), f"transform is {name!r}, expected two frames joined by To, such as ImageToReference")
    return max(splits, key=lambda ends: sum(end in known for end in ends))


def _matrix(name: str, matrix) -> np.ndarray:
    array = check_affine(name, matrix)
    array.setflags(write=False)
    return array


def _from_header(pixels: _Pixels, header: Mapping[str, str], source: str) -> TrackedSequence:
    """A sequence from the pixels of a file and its header fields."""
    grey, coloured = pixels
    count = len(grey)
    transforms: list[dict] = [{} for _ in range(count)]
    others: list[dict] = [{} for _ in range(count)]
    timestamps = np.full(count, np.nan)
    fields = {}
    lost, damaged = 0, {}
    for key, text in header.items():
        match = _FRAME_FIELD.fullmatch(key)
        if match is None:
            if key not in (_ORIENTATION, _TYPE) and not key.startswith(_NOT_OURS):
                fields[key] = text
            continue
        number, name = int(match.group(1)), match.group(2)
        require(number < count, f"{source}: has the field {key}, expected numbers below {count}, the number of images")
        short = name.removesuffix("Transform")
        if name == "Timestamp":
            try:
                timestamps[number] = float(text)
            except ValueError:
                raise SimulationError(f"{source}: {key} is {text!r}, expected seconds") from None
            continue
        if short != name and (frames := _FROM_TO.fullmatch(short)):
            try:
                if header.get(f"{key}Status", _OK).strip().upper() == _OK:
                    matrix = matrix_of_text(key, text)
                    if "Image" not in frames.groups():  # whose frame is in pixels
                        check_rigid(key, matrix)
                    transforms[number][short] = matrix
                    continue
                lost += 1
            except SimulationError as error:
                damaged.setdefault(short, str(error))
        others[number][name] = text
    _log.info("%s: %d images, transforms %s", source, count, ", ".join(sorted(set().union(*transforms))) or "none")
    if lost:
        _log.info("%s: %d transforms were not tracked (their status is not OK) and are left out", source, lost)
    for why in damaged.values():
        _log.warning("%s: %s; such transforms are left out", source, why)
    if not np.isfinite(timestamps).all():
        _log.info("%s: some images have no timestamp; their number is used instead", source)
    # Without timestamps the order of the images is used.
    timestamps = np.where(np.isfinite(timestamps), timestamps, np.arange(count))
    image_type = _value(header, _TYPE, "BRIGHTNESS", source)
    image_type = "BRIGHTNESS" if image_type == "RGB_COLOR" else image_type
    wanted = "MF" if image_type == "BRIGHTNESS" else "FM"
    orientation = _value(header, _ORIENTATION, wanted, source)
    array = _oriented(grey, orientation, wanted, source)
    if coloured is not None:
        coloured = _oriented(coloured[None], orientation, wanted, source)[0]
    return TrackedSequence(array, tuple(transforms), timestamps, image_type, fields, tuple(others), coloured)


def _value(header: Mapping[str, str], key: str, default: str, source: str) -> str:
    """A general field, `default` if it is missing or unknown (XX, ??), of which the latter is a warning."""
    text = re.sub(r"^(?:US_IMG_)?(.*?)\1?$", r"\1", header.get(key, "").strip().upper())  # some write it twice
    if set(text) - set("?X"):
        return text
    meaning = f"{default}, rows away from the probe and columns towards its mark" if default == "MF" else default
    if key in header:
        _log.warning("%s: its %s is %r, which is unknown, read as %s", source, key, header[key], meaning)
    else:
        _log.info("%s: has no %s, read as %s", source, key, meaning)
    return default


def _oriented(array: np.ndarray, orientation: str, wanted: str, source: str) -> np.ndarray:
    """[n, y, x] images, transposed and flipped from `orientation` of the axes x, y to `wanted`."""
    letters = orientation[:2]
    known = len(orientation) in (2, 3) and any(letters in (a + b, b + a) for a in "MU" for b in "FN")
    require(known, f"{source}: {_ORIENTATION} is {orientation!r}, expected a code such as MF, UF, MN or MFA")
    if letters != wanted:
        _log.info("%s: images are reoriented from %s to %s", source, letters, wanted)
    if letters[0] not in (wanted[0], _OPPOSITE[wanted[0]]):
        array, letters = array.swapaxes(1, 2), letters[::-1]
    if letters[0] != wanted[0]:
        array = array[:, :, ::-1]
    if letters[1] != wanted[1]:
        array = array[:, ::-1, :]
    return np.ascontiguousarray(array)


#: ([n, y, x] grey levels of a file, (y, x) bool whether a pixel has a colour in any image; None without)
_Pixels = tuple[np.ndarray, np.ndarray | None]


def _as_images(array: np.ndarray, components: int, source: str) -> _Pixels:
    """Pixels of an array with or without a slice axis of length 1, and with a colour axis if components > 1."""
    coloured: np.ndarray | None = None
    if components > 1:
        require(components in (3, 4), f"{source}: has {components} components per pixel, expected 1 or colours")
        _log.info("%s: colours become grey (ITU-R BT.601)", source)
        colours = array[..., :3]
        array = (colours @ np.array([0.299, 0.587, 0.114])).round().astype(array.dtype)  # ITU-R BT.601
        is_coloured = _are_coloured(colours, array, source)
        if is_coloured.any():
            coloured = np.asarray(is_coloured.reshape(-1, *is_coloured.shape[-2:]).any(axis=0), bool)
    if array.ndim == 4:
        require(array.shape[1] == 1, f"{source}: has volumes of {array.shape[1]} slices, expected images")
        array = array[:, 0]
    if array.ndim == 2:
        array = array[None]
    require(array.ndim == 3, f"{source}: has {array.ndim} dimensions, expected columns, rows and images")
    return array, coloured


def _are_coloured(colours: np.ndarray, grey: np.ndarray, source: str) -> np.ndarray:
    """[...] bool, pixels of [..., 3] colours other than grey; none where most are coloured, as by a scanner's tint.

    A tint is logged as a warning.
    """
    is_coloured = colours.max(axis=-1).astype(int) - colours.min(axis=-1) > _COLOURED
    is_bright = grey > _BRIGHT
    if not is_coloured.any() or is_coloured[is_bright].mean() <= _MOST_COLOURED:
        return is_coloured
    _log.warning(
        "%s: the images are tinted: %.0f %% of the bright pixels are coloured; their luminance is the grey level",
        source, 100.0 * is_coloured[is_bright].mean(),
    )  # fmt: skip
    return np.zeros_like(is_coloured)


# ---- formats ---------------------------------------------------------------------------------------------------------


def _read_images(path: Path) -> tuple[_Pixels, dict[str, str]]:
    """Images and header of a sequence in MetaImage or NRRD."""
    found = read_image(path)
    # Plus writes the two general fields in the style of NRRD.
    names = {"ultrasound image orientation": _ORIENTATION, "ultrasound image type": _TYPE}
    components = found.array.shape[-1] if found.has_components else 1
    header = {names.get(key, key): value for key, value in found.header.items()}
    return _as_images(found.array, components, str(path)), header


def _read_poses(path: Path, count: int) -> tuple[_Pixels, dict[str, str]]:
    """What a file of `count` transforms without images has."""
    text = read_text(path, _MOST_HEADER_BYTES, errors="replace")
    text = re.sub(r"-Sequence(_\d+)?(?=Transform)", "", text)  # 3D Slicer adds it to the name of what it records
    fields = dict(re.findall(r"^(Seq_Frame[^=:\n]+?) *:?= *(.*?)\s*$", text, re.MULTILINE))
    require(
        0 < count <= len(fields), f"{path}: promises {count} poses without images, has {len(fields)} fields of them"
    )
    names = {found[1] for key in fields if (found := re.fullmatch(r"Seq_Frame\d+_(.+)Transform", key))}
    if len(names) == 1 and not _FROM_TO.fullmatch(only := names.pop()):
        _log.warning("%s: its only transform is %s, read as ProbeToReference", path, only)
        fields = {key.replace(f"_{only}Transform", "_ProbeToReferenceTransform"): fields[key] for key in fields}
    return (np.zeros((count, 0, 0), np.uint8), None), fields


def _write_metaimage(path: Path, images: np.ndarray, header: Mapping[str, str], compress: bool) -> None:
    """Uncompressed images are written one by one: SimpleITK copies all, and needs a time quadratic in the fields."""
    packed = zlib.compress(images.tobytes()) if compress else b""
    fields = {
        "ObjectType": "Image", "NDims": 3, "DimSize": "{2} {1} {0}".format(*images.shape),
        "ElementType": f"MET_{_ELEMENT_TYPES[images.dtype.str[1:]]}", "BinaryData": True,
        "BinaryDataByteOrderMSB": images.dtype.str[0] == ">", "CompressedData": compress,
        "CompressedDataSize": len(packed), **header, "ElementDataFile": "LOCAL",
    }  # fmt: skip
    with path.open("wb") as file:
        file.writelines(f"{key} = {value}\n".encode() for key, value in fields.items())
        file.writelines([packed] if compress else (image.tobytes() for image in images))


def _write_nrrd(path: Path, images: np.ndarray, header: Mapping[str, str], compress: bool) -> None:
    require_package("nrrd", "pynrrd", f"{path.name}: writing NRRD sequences")
    import nrrd

    fields = {
        "kinds": ["domain", "domain", "list"],
        "encoding": "gzip" if compress else "raw",
        "ultrasound image orientation": header[_ORIENTATION],
        "ultrasound image type": header[_TYPE],
        **header,
    }
    nrrd.write(str(path), np.ascontiguousarray(images), fields, index_order="C")


def _read_slice(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """((rows, columns), image_to_ras) of a file with one slice, whose axis of length 1 may be any of the three."""
    from SlicerUSSim.Logic.base.volume import read_image_file

    found = read_image_file(path)
    array, ijk_to_ras = found.array, found.ijk_to_ras
    require(array.ndim == 3, f"{path}: has {array.ndim} dimensions, expected 3")
    flat = [axis for axis in range(3) if array.shape[axis] == 1]
    require(len(flat) == 1, f"{path}: is {'x'.join(map(str, array.shape[::-1]))}, expected one slice")
    rows, columns = (axis for axis in range(3) if axis != flat[0])
    matrix = np.eye(4)
    matrix[:, 0], matrix[:, 1], matrix[:, 3] = ijk_to_ras[:, 2 - columns], ijk_to_ras[:, 2 - rows], ijk_to_ras[:, 3]
    normal = np.cross(matrix[:3, 0], matrix[:3, 1])
    matrix[:3, 2] = normal / np.linalg.norm(normal)
    return array.squeeze(flat[0]), matrix
