"""Files of probe poses: JSON, plain text, and ITK transforms as written by 3D Slicer; MNI transforms and tags."""

from __future__ import annotations

import io
import logging
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.files import read_json, read_small, read_text, write_json, written_whole
from SlicerUSSim.Logic.base.reading import in_child, reader, starts_like_hdf5
from SlicerUSSim.Logic.base.transforms import (
    LPS_TO_RAS,
    MOST_MM,
    check_affine,
    check_rigid,
    is_singular,
    pose_of_angles,
    rigid_between,
)

_log = logging.getLogger(__name__)

#: Least root mean square distance of landmarks from the line through most of them
_LEAST_WIDTH_MM = 1.0
_BINARY = (".h5", ".hdf5", ".mat")
_ITK_SUFFIXES = (".tfm", *_BINARY)


@reader
def read_pose(path: str | os.PathLike) -> np.ndarray:
    """(4, 4) probe_to_ras from a file.

    A JSON file contains {"probe_to_ras": [[...], ...]} or only the matrix; a text file sixteen numbers by rows. An ITK
    file (.tfm, .h5, .mat, .txt) contains the map from world to probe in LPS, as Slicer writes a linear transform.
    Raises SimulationError for other files and for a matrix that is not rigid.
    """
    return check_rigid(f"{path}: probe_to_ras", _matrix(Path(path)))


@reader
def read_matrix(path: str | os.PathLike) -> np.ndarray:
    """(4, 4) affine matrix, such as a calibration, which may scale, in any format of read_pose.

    Raises SimulationError for other files.
    """
    return check_affine(str(path), _matrix(Path(path)))


def _matrix(path: Path):
    """What a file has for a matrix, which is to be checked."""
    require(path.is_file(), f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix == ".json":
        values = read_json(path)
        if isinstance(values, dict):
            require("probe_to_ras" in values, f'{path}: has no "probe_to_ras", expected a 4x4 matrix under that name')
            return values["probe_to_ras"]
        _log.info("%s: a bare matrix, read as probe_to_ras", path)
        return values
    if suffix in _ITK_SUFFIXES or _starts_like_itk(path):
        require(
            suffix != ".mat" or b"\0" in read_small(path),
            f"{path}: is a text, as FSL's FLIRT writes a matrix relative to the voxels of two images; expected a map "
            f"in millimetres: c3d_affine_tool -ref REFERENCE -src IMAGE {path.name} -fsl2ras -oitk pose.tfm converts "
            "it; if it is one in RAS, name it .txt",
        )
        _log.info("%s: ITK transform, read as the map from world to probe in LPS, as 3D Slicer saves it", path)
        return _itk_to_world(path)
    _log.info("%s: 16 numbers, read as probe_to_ras by rows", path)
    return matrix_of_text(f"{path}:", read_text(path))


def matrix_of_text(name: str, text: str) -> np.ndarray:
    """(4, 4) of a text of sixteen numbers by rows. Raises SimulationError for others, and if it is not affine."""
    try:
        numbers = np.array(text.replace(",", " ").split(), float)
    except ValueError:
        raise SimulationError(f"{name} is {text.strip()[:40]!r}, expected 16 numbers, a 4x4 matrix by rows") from None
    require(numbers.size == 16, f"{name} has {numbers.size} numbers, expected 16, a 4x4 matrix by rows")
    return check_affine(name, numbers.reshape(4, 4))


def write_pose(path: str | os.PathLike, probe_to_ras: np.ndarray) -> None:
    """Write a pose, which read_pose reads; an existing file is replaced only when the new one is complete.

    An ITK file (.tfm, .h5, .mat) has the map from world to probe in LPS, as Slicer writes and reads linear transforms;
    a text file (.txt) sixteen numbers by rows. Others are JSON. Raises SimulationError for a matrix that is not rigid.
    """
    path, pose = Path(path), check_rigid("probe_to_ras", probe_to_ras)
    suffix = path.suffix.lower()
    if suffix in _ITK_SUFFIXES:
        _write_itk(path, pose)
    elif suffix == ".txt":
        with written_whole(path) as partial:
            partial.write_text("\n".join(" ".join(map(repr, row)) for row in pose.tolist()) + "\n", encoding="utf-8")
    else:
        write_json(path, {"probe_to_ras": pose.tolist()})


def pose_of_text(text: str) -> np.ndarray:
    """(4, 4) probe_to_ras of a text: sixteen numbers by rows, or six: position and angles as in pose_of_angles.

    Raises SimulationError for other texts and for a matrix that is not rigid.

    >>> from SlicerUSSim.Logic.tracked.pose_files import pose_of_text
    >>> pose_of_text("10 20 30  0 0 90").round(3).tolist()[0]
    [0.0, -1.0, 0.0, 10.0]
    """
    parts = re.sub(r"[,;\[\]()]", " ", text).split()
    try:
        numbers = np.array(parts, float)
    except ValueError:
        numbers = np.zeros(0)
    require(
        numbers.size in (6, 16) and numbers.size == len(parts),
        f"the pose is {text.strip()[:60]!r}, expected 6 numbers (R A S in mm, and angles about these axes in degrees) "
        "or 16 (a 4x4 matrix by rows)",
    )
    if numbers.size == 6:
        return check_rigid("the pose", pose_of_angles(numbers[:3], numbers[3:]))
    return check_rigid("the pose", numbers.reshape(4, 4))


def _starts_like_itk(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(8) == b"#Insight"


def _itk_to_world(path: Path) -> np.ndarray:
    """(4, 4) in RAS of the inverse of an ITK file's linear map, which is in LPS."""
    if path.suffix.lower() in _BINARY or starts_like_hdf5(path):
        world_to_probe = _linear_map_of_binary(path)
    else:
        require_sound_text(path)
        world_to_probe = _linear_map(path)
    require(not is_singular(world_to_probe), f"{path}: the transform is singular, expected a rigid one")
    return LPS_TO_RAS @ np.linalg.inv(world_to_probe) @ LPS_TO_RAS


def _write_itk(path: Path, pose: np.ndarray) -> None:
    import SimpleITK as sitk

    world_to_probe = np.linalg.inv(LPS_TO_RAS @ pose @ LPS_TO_RAS)
    transform = sitk.AffineTransform(3)
    transform.SetMatrix(world_to_probe[:3, :3].ravel().tolist())
    transform.SetTranslation(world_to_probe[:3, 3].tolist())
    with written_whole(path) as partial:
        sitk.WriteTransform(transform, str(partial))


def _linear_map(path: Path, is_binary: bool = False) -> np.ndarray:
    """(4, 4) of a linear ITK transform, in LPS."""
    import SimpleITK as sitk

    try:
        transform = sitk.ReadTransform(str(path))
    except RuntimeError as error:
        raise SimulationError(
            f"{path}: cannot be read as a transform ({str(error).splitlines()[-1].strip()})"
        ) from None
    if is_binary:
        require_sound(path, transform)
    # A linear map is determined by the images of the origin and the axes.
    origin = np.array(transform.TransformPoint((0.0, 0.0, 0.0)))
    world_to_probe = np.eye(4)
    for axis, unit in enumerate(np.eye(3)):
        world_to_probe[:3, axis] = np.array(transform.TransformPoint(unit.tolist())) - origin
    world_to_probe[:3, 3] = origin
    return world_to_probe


@in_child  # ITK ends the process for some damaged files
def _linear_map_of_binary(path: Path) -> np.ndarray:
    return _linear_map(path, is_binary=True)


@reader
def read_transform(path: str | os.PathLike) -> np.ndarray:
    """(4, 4) affine map from a file: all formats of read_pose, or a linear MNI .xfm, which may scale.

    Raises SimulationError for other files.
    """
    path = Path(path)
    if path.suffix.lower() == ".xfm":
        return _read_xfm(path)
    return read_pose(path)


@reader
def read_tags(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray | None]:
    """((n, 3), (n, 3) or None) RAS points of an MNI .tag file: landmarks in one or two volumes, as in BITE and RESECT.

    Raises SimulationError for other files.
    """
    path = Path(path)
    text = _mni_text(path, "MNI Tag Point File")
    nothing = f"{path}: has no points of one or two volumes, expected an MNI tag file"
    volumes = required(re.search(r"Volumes\s*=\s*(\d+)", text), nothing)
    points = required(re.search(r"Points\s*=(.*)", text, re.DOTALL), nothing)
    require(int(volumes.group(1)) in (1, 2), nothing)
    per_point = 3 * int(volumes.group(1))
    rows = []
    for line in points.group(1).split("\n"):
        numbers = re.findall(r"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?", line.split('"')[0])
        if len(numbers) >= per_point:
            rows.append([float(number) for number in numbers[:per_point]])
        else:
            require(not numbers, f"{path}: a point has {len(numbers)} numbers, expected {per_point}")
    require(bool(rows), f"{path}: has no points, expected at least one")
    array = np.array(rows)
    farthest = float(np.abs(array).max())
    require(farthest <= MOST_MM, f"{path}: has a coordinate of {farthest:.3g} mm, expected at most {MOST_MM:g} mm")
    return array[:, :3], (array[:, 3:] if per_point == 6 else None)


def read_calibration(path: str | os.PathLike, name: str = "ImageToProbe") -> dict[str, np.ndarray]:
    """{"ImageToProbe": (4, 4), ...} of a Plus configuration (.xml), or of a file with one matrix, which is `name`.

    That is 16 numbers by rows, JSON rows, or a linear ITK transform as 3D Slicer saves it (.tfm, .h5); it may scale.
    Raises SimulationError for other files.
    """
    if Path(path).suffix.lower() == ".xml":
        return read_coordinate_definitions(path)
    return {name: read_matrix(path)}


@reader
def read_coordinate_definitions(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """{"ImageToProbe": (4, 4), ...} from the <CoordinateDefinitions> of a Plus configuration file (XML).

    Raises SimulationError for other files, and for a matrix that is not 4x4.
    """
    from xml.etree import ElementTree

    path = Path(path)
    try:
        root = ElementTree.fromstring(read_small(path))
    except ElementTree.ParseError as error:
        raise SimulationError(f"{path}: is not XML ({error})") from None
    transforms = {}
    for entry in root.iter("Transform"):
        start, end, text = entry.get("From"), entry.get("To"), entry.get("Matrix")
        if start and end and text:
            transforms[f"{start}To{end}"] = matrix_of_text(f"{path}: {start} to {end}", text)
    require(bool(transforms), f"{path}: has no <Transform From= To= Matrix=>, expected a Plus configuration")
    return transforms


def read_registration(path: str | os.PathLike) -> tuple[np.ndarray, str]:
    """((4, 4) map from the reference frame of ultrasound to the MRI, a line about it), as for --to-mri.

    A file is one of read_transform, or a .tag with landmarks in MRI and ultrasound, for which the rigid map with the
    least squared distances is computed. Raises SimulationError for others, and for landmarks of one volume.
    """
    if Path(path).suffix.lower() != ".tag":
        return read_transform(path), ""
    in_mri, in_ultrasound = read_tags(path)
    if in_ultrasound is None:
        raise SimulationError(f"{path}: has points of one volume, expected pairs in MRI and ultrasound")
    return fit_landmarks(in_ultrasound, in_mri)[:2]


def fit_landmarks(in_ultrasound: np.ndarray, in_mri: np.ndarray) -> tuple[np.ndarray, str, np.ndarray]:
    """((4, 4) rigid map of the first to the second, a line about it, (n,) what remains of each in millimetres).

    Parameters
    ----------
    in_ultrasound, in_mri : (n, 3) the same landmarks, millimetres.

    Raises SimulationError for fewer than three pairs, and for landmarks that lie on a line, about which they turn.
    """
    in_ultrasound, in_mri = np.asarray(in_ultrasound, float), np.asarray(in_mri, float)
    count = len(in_ultrasound)
    require(count >= 3, f"{count} pair{'s' * (count != 1)} of landmarks, expected three or more")
    for points, where in ((in_ultrasound, "ultrasound"), (in_mri, "MRI")):
        wide = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(count)
        require(
            wide >= _LEAST_WIDTH_MM,
            f"landmarks in the {where} lie within {wide:.2g} mm of a line, about which the fit would turn; expected "
            f"{_LEAST_WIDTH_MM:g} mm or more",
        )
    matrix, left = rigid_between(in_ultrasound, in_mri)
    remaining = np.linalg.norm(in_ultrasound @ matrix[:3, :3].T + matrix[:3, 3] - in_mri, axis=1)
    return matrix, f"{count} landmarks agree to {left:.2f} mm (root mean square)", remaining


def _read_xfm(path: Path) -> np.ndarray:
    text = _mni_text(path, "MNI Transform File")
    kind = re.search(r"Transform_Type\s*=\s*(\w+)", text)
    name = kind.group(1) if kind else "none"
    require(name == "Linear", f"{path}: the transform type is {name}, expected Linear")
    match = re.search(r"Linear_Transform\s*=([^;]*);", text)
    numbers = match.group(1).split() if match else []
    require(len(numbers) == 12, f"{path}: has {len(numbers)} numbers, expected 12 (a 3x4 matrix by rows)")
    matrix = np.eye(4)
    try:
        matrix[:3] = np.array(numbers, float).reshape(3, 4)
    except ValueError:
        raise SimulationError(f"{path}: Linear_Transform is not numeric, expected 12 numbers") from None
    if re.search(r"Invert_Flag\s*=\s*True", text):
        _log.info("%s: Invert_Flag is set, the matrix is inverted", path)
        matrix = np.linalg.inv(matrix)
    return check_affine(f"{path}: Linear_Transform", matrix)


def _mni_text(path: Path, first_words: str) -> str:
    require(path.is_file(), f"{path}: no such file")
    try:
        text = io.StringIO(read_text(path), newline=None).read()  # all kinds of line ends
    except UnicodeDecodeError:
        text = ""
    require(text.lstrip().startswith(first_words), f"{path}: does not start with {first_words!r}")
    return re.sub(r"^%.*$", "", text, flags=re.MULTILINE)  # comments


# ---- what must hold of an ITK transform ------------------------------------------------------------------------------
# ITK takes fewer numbers than a kind needs, and reads beyond their end; a number that it cannot read, such as `inf`,
# ends a list without a word (itkTxtTransformIO.hxx, SetParameters of itkEuler3DTransform.hxx).

_COMPOSITE = "CompositeTransform"
#: Parameters of the linear kinds in three dimensions
_LINEAR = {
    "IdentityTransform": 0,
    "TranslationTransform": 3,
    "ScaleTransform": 3,
    "ScaleLogarithmicTransform": 3,
    "VersorTransform": 3,
    "Euler3DTransform": 6,
    "VersorRigid3DTransform": 6,
    "Similarity3DTransform": 7,
    "QuaternionRigidTransform": 7,
    "ScaleVersor3DTransform": 9,
    "AffineTransform": 12,
    "MatrixOffsetTransformBase": 12,
    "ComposeScaleSkewVersor3DTransform": 12,
    "ScaleSkewVersor3DTransform": 15,
    _COMPOSITE: 0,
}
#: Name, whether there are numbers, and these
_BLOCK = r"(?m)^Transform: *(.*)\n(Parameters:(.*)\nFixedParameters:(.*)\n)?"
_NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,3})?"


def require_sound_text(path: Path) -> None:
    """Raise SimulationError unless a text file holds one linear transform, or a chain of them, with all its numbers."""
    try:
        text = read_text(path)
    except UnicodeDecodeError:
        text = "\0"
    require("\0" not in text, f"{path}: is not a text, expected an ITK transform")
    lines = [line.strip() for line in text.split("\n") if ":" in line and not line.lstrip().startswith("#")]
    blocks = re.findall(_BLOCK, "".join(f"{line}\n" for line in lines))
    require(bool(blocks), f"{path}: has no line Transform, expected an ITK transform")
    require(
        len(lines) == sum(3 if parameters else 1 for _, parameters, *_ in blocks),
        f"{path}: has the lines {', '.join(line[:20] for line in lines[:9])}, expected Transform, Parameters and "
        "FixedParameters of each",
    )
    is_chain = blocks[0][0].startswith(_COMPOSITE)
    require(is_chain or len(blocks) == 1, f"{path}: has {len(blocks)} transforms that are not chained, expected one")
    for whole, _, parameters, fixed in blocks:
        kind = re.sub(r"_(double|float)_3_3$", "", whole)
        for name, numbers in (("Parameters", parameters.split()), ("FixedParameters", fixed.split())):
            for part in numbers:
                is_number = re.fullmatch(_NUMBER, part) and abs(float(part)) <= 1e300
                require(bool(is_number), f"{path}: {name} of {kind} has {part!r:.40}, expected numbers")
        _require_parameters(path, kind, parameters.split())


def require_sound(path: Path, transform) -> None:
    """Raise SimulationError unless a SimpleITK transform is linear and has all its numbers."""
    import SimpleITK as sitk

    require(transform.IsLinear(), f"{path}: the transform is not linear, expected a rigid one")
    parts = [transform]
    if transform.GetName() == _COMPOSITE:
        chain = sitk.CompositeTransform(transform)
        parts = [chain.GetNthTransform(n) for n in range(chain.GetNumberOfTransforms())]
    for part in parts:
        kind, found = part.GetName(), part.GetParameters()
        if kind == _COMPOSITE:  # SimpleITK has no class for ITK's base class, and shows it as a chain with itself
            kind = "MatrixOffsetTransformBase"
        _require_parameters(path, kind, found)


def _require_parameters(path: Path, kind: str, found: Sequence) -> None:
    require(
        kind in _LINEAR,
        f"{path}: the transform is {kind!r:.60}, expected a linear one in three dimensions: {', '.join(_LINEAR)}",
    )
    require(len(found) == _LINEAR[kind], f"{path}: {kind} has {len(found)} parameters, expected {_LINEAR[kind]}")
