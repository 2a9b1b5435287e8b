"""Volume: a 3D image with its position in the patient (RAS), and its files."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import permutations
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.dicom import is_dicom, read_dicom
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import messages_withheld, written_whole
from SlicerUSSim.Logic.base.image_files import (
    ImageFile,
    add_label_table,
    axis_letters,
    checked_image,
    of_sitk,
    read_image,
    require_readable_name,
    require_spacing,
)
from SlicerUSSim.Logic.base.label_numbers import numbers_of
from SlicerUSSim.Logic.base.reading import in_child, reader
from SlicerUSSim.Logic.base.segments import flattened, segments_of
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS, check_affine, is_singular, nearest_rotation

_log = logging.getLogger(__name__)

#: A smaller or larger side of a volume indicates a wrong unit.
SMALLEST_MM, LARGEST_MM = 5.0, 2500.0
#: Formats with header and voxels in one file, so that it is replaced as a whole
WRITABLE_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".mha", ".vti")
#: Names of the sides towards which R, A and S decrease and increase
SIDES = (("left", "right"), ("back", "front"), ("bottom", "top"))


@dataclass(frozen=True, eq=False)
class Volume:
    """A scalar image in patient space.

    Parameters
    ----------
    array : (k, j, i) numbers; i varies fastest in memory, as in ITK and VTK.
    ijk_to_ras : (4, 4) from homogeneous voxel indices (i, j, k, 1) of voxel *centres* to RAS millimetres.
    name : of its file or node, for messages.
    label_names : {label: name} of masks and label maps, where their file gives them; see mri.read_mask.
    label_codes : {label: SNOMED CT codes, the most special first}, likewise.
    doubts : what a user should check about its file, one line each, which read() has also logged.
    modality : of a DICOM file, such as "CT" or "MR"; "" for another file.

    Raises SimulationError for an array that is not 3D or not numeric, and for a singular or non-affine matrix.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import Volume
    >>> mri = Volume(np.zeros((20, 30, 40), np.float32), np.diag([0.5, 0.5, 2.0, 1.0]))
    >>> mri.spacing_mm.tolist()
    [0.5, 0.5, 2.0]
    >>> (mri.ijk_to_ras @ [39, 29, 19, 1])[:3].tolist()  # the centre of the last voxel, RAS mm
    [19.5, 14.5, 38.0]
    >>> mri.write("mri.nii.gz")
    >>> Volume.read("mri.nii.gz").array.shape
    (20, 30, 40)
    """

    array: np.ndarray
    ijk_to_ras: np.ndarray
    name: str = field(default="", compare=False)  # does not affect the image
    label_names: Mapping[int, str] = field(default_factory=dict, compare=False)
    doubts: tuple[str, ...] = field(default=(), compare=False)
    label_codes: Mapping[int, tuple[str, ...]] = field(default_factory=dict, compare=False)
    modality: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        array = np.asarray(self.array)
        require(array.ndim == 3, f"volume has {array.ndim} dimensions {array.shape}, expected 3")
        require(array.size > 0, f"volume is empty (shape {array.shape})")
        require(
            (np.issubdtype(array.dtype, np.number) and not np.iscomplexobj(array)) or array.dtype == bool,
            f"volume holds {array.dtype}, expected real numbers",
        )
        matrix = check_affine("ijk_to_ras", self.ijk_to_ras)
        require(not is_singular(matrix), f"ijk_to_ras is singular: {matrix.tolist()}")
        matrix.setflags(write=False)
        object.__setattr__(self, "array", array)
        object.__setattr__(self, "ijk_to_ras", matrix)

    @property
    def spacing_mm(self) -> np.ndarray:
        """(3,) voxel size along i, j, k in millimetres."""
        return np.linalg.norm(self.ijk_to_ras[:3, :3], axis=0)

    @property
    def ends(self) -> tuple[tuple[str, str], ...]:
        """The sides (SIDES) at which the axes i, j, k begin and end: (("left", "right"), ...)."""
        return tuple(
            SIDES[row] if self.ijk_to_ras[row, column] > 0 else SIDES[row][::-1]
            for column, row in enumerate(np.abs(self.ijk_to_ras[:3, :3]).argmax(axis=0))
        )

    @property
    def size_text(self) -> str:
        """Its numbers of voxels along i, j, k, for messages: "181x217x181"."""
        return "x".join(map(str, self.array.shape[::-1]))

    @property
    def voxel_ml(self) -> float:
        """Volume of a voxel in millilitres."""
        return float(abs(np.linalg.det(self.ijk_to_ras[:3, :3])) / 1000.0)

    @property
    def ras_to_ijk(self) -> np.ndarray:
        """(4, 4) inverse of ijk_to_ras."""
        return np.linalg.inv(self.ijk_to_ras)

    def with_array(self, array: np.ndarray) -> Volume:
        """Another image on the same grid. Raises SimulationError if the shape differs."""
        require(np.shape(array) == self.array.shape, f"array has shape {np.shape(array)}, expected {self.array.shape}")
        return Volume(array, self.ijk_to_ras)

    def along(self, like: Volume | None = None) -> Volume:
        """The same voxels at the same places, stored along the axes nearest to those of `like`.

        By default along R, A and S, so that results do not depend on the order of the voxels in a file.
        """
        wanted = np.eye(3) if like is None else like.ijk_to_ras[:3, :3] / like.spacing_mm
        cosines = wanted.T @ self.ijk_to_ras[:3, :3] / self.spacing_mm
        own = max(permutations(range(3)), key=lambda order: np.abs(cosines[range(3), list(order)]).sum())
        ways = np.sign(cosines[range(3), own])
        array = self.array.T.transpose(own)
        to_own = np.eye(4)[:, [*own, 3]] * [*ways, 1.0]
        to_own[own, 3] = np.where(ways < 0, np.array(array.shape) - 1, 0)
        array = np.ascontiguousarray(np.flip(array, tuple(np.flatnonzero(ways < 0).tolist())).T)
        return replace(self, array=array, ijk_to_ras=self.ijk_to_ras @ to_own)

    def looks_like_labels(self) -> bool:
        """Whether the image has whole numbers, also as floating point: few of them, or in regions, as a label map has.

        Neighbours in an MRI differ, and mostly by little; label_numbers has the limits.
        """
        found, is_labels = numbers_of(self.array)
        _log.info("the volume contains %s, as %s does", found, "a label map" if is_labels else "an MRI")
        return is_labels

    # ---- files -------------------------------------------------------------------------------------------------

    @classmethod
    @reader
    def read(cls, path: str | os.PathLike) -> Volume:
        """Read NIfTI, NRRD, MetaImage, MINC 1 and 2, FreeSurfer's MGZ, VTI, or DICOM: a folder with one volume, or any
        image of it.

        Raises SimulationError for a missing or unreadable file and for an image that is not 3D and scalar.
        """
        path = Path(path)
        found = read_image_file(path)
        volume = cls.from_image_file(found, str(path))
        require_spacing(str(path), tuple(volume.spacing_mm))
        _log_size(volume, path)
        return volume

    @classmethod
    def from_image_file(cls, found: ImageFile, name: str) -> Volume:
        """From what is in a file; overlapping segments of 3D Slicer become one label map, the last on top.

        Raises SimulationError if it is not 3D and scalar.
        """
        array, size = found.array, found.array.shape[::-1][found.has_components :]
        _require_volume(size, name)
        if found.has_components:
            segments = segments_of(found.header, name)
            require(
                segments,
                f"{name}: has {array.shape[-1]} components per voxel, expected 1; save one of them, or a label map",
            )
            array = flattened(array, segments, float(abs(np.linalg.det(found.ijk_to_ras[:3, :3])) / 1000.0), name)
        return cls(array, found.ijk_to_ras, name, found.label_names, found.doubts, found.label_codes, found.modality)

    @classmethod
    def from_sitk(cls, image, name: str = "image") -> Volume:
        """From a SimpleITK image (LPS). Raises SimulationError if it is not 3D and scalar."""
        return cls.from_image_file(of_sitk(image), name)

    def to_sitk(self):
        """A SimpleITK image (LPS). Raises SimulationError if the axes are not perpendicular (ITK cannot store that)."""
        import SimpleITK as sitk

        direction, spacing, origin = self._direction_spacing_origin(LPS_TO_RAS @ self.ijk_to_ras)
        array = self.array.astype(np.uint8) if self.array.dtype == bool else self.array
        image = sitk.GetImageFromArray(np.ascontiguousarray(array))
        image.SetSpacing(spacing.tolist())
        image.SetOrigin(origin.tolist())
        image.SetDirection(direction.ravel().tolist())
        return image

    def write(self, path: str | os.PathLike, about: Mapping[str, str] | None = None) -> None:
        """Write the volume in the format of the suffix; on failure an existing file is kept.

        `about` are further lines of its header, {key: text without line ends}, of NRRD, MetaImage and VTI. NIfTI has
        the label names as Connectome Workbench and TotalSegmentator write them, if nibabel is installed.
        Raises SimulationError for an unknown suffix or if the file cannot be written.
        """
        path = Path(path)
        require_image_name(path)
        suffix = path.suffix.lower()
        with written_whole(path) as partial, messages_withheld():
            if suffix == ".vti":
                self._write_vti(partial, about or {})
            else:
                import SimpleITK as sitk

                image = self.to_sitk()
                is_nifti = path.name.lower().endswith((".nii", ".nii.gz"))
                for key, text in (about or {}).items():
                    image.SetMetaData(key, text)
                sitk.WriteImage(image, str(partial), useCompression=True)
                if is_nifti or suffix == ".nrrd":  # of which the last blocks may be missing without a word
                    written = sitk.GetArrayFromImage(sitk.ReadImage(str(partial)))
                    wanted = sitk.GetArrayFromImage(image)
                    is_kept = (written == wanted) | ~np.isfinite(wanted)  # of NIfTI, ITK reads NaN as 0
                    if not is_kept.all():
                        raise OSError("not all voxels are in the file; is the disk full?")
                if is_nifti and self.label_names:
                    add_label_table(partial, self.label_names)

    # ---- VTK ---------------------------------------------------------------------------------------------------

    @classmethod
    def from_vtk(cls, image_data, ijk_to_ras: np.ndarray | None = None) -> Volume:
        """From a vtkImageData whose physical coordinates are RAS, or with a separate matrix as MRML nodes have.

        Raises SimulationError for an image without scalars, with several components, or that is not 3D.
        """
        from vtkmodules.util.numpy_support import vtk_to_numpy

        dims = image_data.GetDimensions()
        require(min(dims) > 0, "vtkImageData is empty")
        scalars = image_data.GetPointData().GetScalars()
        require(scalars is not None, "vtkImageData has no scalars")
        components = scalars.GetNumberOfComponents()
        require(components == 1, f"vtkImageData has {components} components per voxel, expected 1")
        array = vtk_to_numpy(scalars).reshape(dims[::-1])
        if ijk_to_ras is None:
            vtk_matrix = image_data.GetIndexToPhysicalMatrix()
            ijk_to_ras = np.array([[vtk_matrix.GetElement(r, c) for c in range(4)] for r in range(4)])
        # VTK indices start at the extent's start; in this class they start at zero.
        first = np.eye(4)
        first[:3, 3] = image_data.GetExtent()[0::2]
        return cls(array, np.asarray(ijk_to_ras, float) @ first)

    def to_vtk(self):
        """A vtkImageData in RAS with a direction matrix and a copy of the voxels."""
        from vtkmodules.vtkCommonDataModel import vtkImageData

        from SlicerUSSim.Logic.base.vtk_data import set_scalars

        direction, spacing, origin = self._direction_spacing_origin(self.ijk_to_ras)
        array = self.array.astype(np.uint8) if self.array.dtype == bool else self.array
        image = vtkImageData()
        image.SetDimensions(*self.array.shape[::-1])
        image.SetSpacing(*spacing)
        image.SetOrigin(*origin)
        image.SetDirectionMatrix(*direction.ravel())
        set_scalars(image, array)
        return image

    def _direction_spacing_origin(self, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        spacing = np.linalg.norm(matrix[:3, :3], axis=0)
        direction = matrix[:3, :3] / spacing
        skew = np.abs(direction.T @ direction - np.eye(3)).max()
        require(skew < 1e-4, f"volume axes are not perpendicular (cosine {skew:.3g}); resample it to a regular grid")
        return nearest_rotation(direction), spacing, matrix[:3, 3]  # ITK and VTK require exactly orthogonal axes

    def _write_vti(self, path: Path, about: Mapping[str, str]) -> None:
        from vtkmodules.vtkCommonCore import vtkStringArray
        from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

        image = self.to_vtk()
        for key, value in about.items():
            text = vtkStringArray()
            text.SetName(key)
            text.InsertNextValue(value)
            image.GetFieldData().AddArray(text)
        writer = vtkXMLImageDataWriter()
        writer.SetFileName(str(path))
        writer.SetInputData(image)
        if writer.Write() != 1 or writer.GetErrorCode() != 0:
            raise OSError("not all voxels are in the file; is the disk full?")


def _log_size(volume: Volume, path: Path) -> None:
    """Log the volume, and warn if its size in millimetres is implausible."""
    size = volume.spacing_mm * volume.array.shape[::-1]
    _log.info(
        "%s: %s voxels of %s mm, %s, i, j, k towards %s", path, volume.size_text,
        "x".join(f"{round(mm, 3):g}" for mm in volume.spacing_mm), volume.array.dtype, axis_letters(volume.ijk_to_ras),
    )  # fmt: skip
    if not SMALLEST_MM <= size.max() <= LARGEST_MM:
        _log.warning(
            "%s: its size is %s mm if lengths are in millimetres, as assumed; check its voxel size", path,
            "x".join(f"{round(mm, 3):g}" for mm in size),
        )  # fmt: skip


def require_image_name(path: Path, also: tuple[str, ...] = ()) -> None:
    """Raise SimulationError unless Volume.write supports the format of this file name, or it ends in one of `also`."""
    suffixes = (*also, *WRITABLE_SUFFIXES)
    require(
        path.name.lower().endswith(suffixes),
        f"{path}: unknown image format, expected a name ending in one of {', '.join(suffixes)}",
    )
    nifti = next((suffix for suffix in (".nii.gz", ".nii") if path.name.lower().endswith(suffix)), "")
    require(path.name.endswith(nifti), f"{path}: expected {nifti} in small letters; others cannot be written")
    twice = nifti and path.name[: -len(nifti)].lower().endswith((".nii", ".nii.gz"))
    require(not twice, f"{path}: has the ending {nifti} after another one; ITK would write a file of another name")


@reader
def read_image_file(path: str | os.PathLike) -> ImageFile:
    """What is in a file of any format that Volume.read reads, which may also have several components or one slice.

    Raises SimulationError for a missing or unreadable file.
    """
    require_readable_name(path)
    path = Path(path)
    require(path.exists(), f"{path}: no such file or folder")
    if path.is_dir() or is_dicom(path):
        return checked_image(path, read_dicom(path))
    if path.suffix.lower() == ".vti":
        _log.info("%s: coordinates are read as RAS millimetres, since VTI files do not specify them", path)
        return checked_image(path, _read_vti(path))
    return read_image(path)


@in_child  # VTK ends the process for some damaged files
def _read_vti(path: Path) -> ImageFile:
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    file = vtkXMLImageDataReader()
    require(bool(file.CanReadFile(str(path))), f"{path}: cannot be read as a VTK image")
    file.SetFileName(str(path))
    file.Update()
    require(
        file.GetErrorCode() == 0 and min(file.GetOutput().GetDimensions()) > 0,
        f"{path}: cannot be read as a VTK image, it is incomplete or damaged; copy or export it again",
    )
    volume = Volume.from_vtk(file.GetOutput())
    return ImageFile(volume.array, volume.ijk_to_ras)


def _require_volume(size, name: str) -> None:
    require(
        len(size) == 3 and min(size) > 1,
        f"{name}: is a {'x'.join(map(str, size))} image, expected three dimensions with two or more samples each",
    )
