"""PatientSurface: the surface on which a probe can lie: the outside of the labelled voxels, closed over sulci."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import mutable
from vtkmodules.vtkCommonDataModel import vtkPolyData, vtkStaticCellLocator
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D, vtkPolyDataNormals, vtkQuadricDecimation
from vtkmodules.vtkFiltersGeneral import vtkTransformPolyDataFilter

from SlicerUSSim.Logic.base.errors import require, require_between
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.probe.poses import angles_to_surface, carried, turned

#: Voxel size of the surface, mm: a compromise between accuracy and the time to compute it.
_VOXEL_MM = 2.0
#: Gaps narrower than twice this are bridged, as a probe face bridges a sulcus, mm.
_CLOSING_MM = 8.0
_SMOOTHING_MM = 2.0
#: Radius of the patch over which normals are averaged, about that of a probe face, mm.
_PATCH_MM = 10.0
#: Fraction of the triangles that can be removed without visible change of the smooth surface.
_DROPPED = 0.85
#: Limits of the distance between a sliding probe and the surface, mm.
_LIFT_MM = (-5.0, 20.0)
_UP = np.array([0.0, 0.0, 1.0])
#: Pose of a probe on the vertex of the head that points down, with its lateral axis to the patient's right.
_LOOKING_DOWN = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class SurfacePose:
    """A probe's pose in a sonographer's terms: position on the patient, and orientation to the surface."""

    #: Position on the surface as angles from the vertex of the head; see PatientSurface.angles
    right_deg: float
    front_deg: float
    #: Rotation about the probe axis; at 0, in front of the vertex, the lateral axis points to the patient's right
    rotate_deg: float
    #: Angles to the surface normal; see placement.turned
    rock_deg: float
    tilt_deg: float
    #: Distance between surface and probe face; negative if pressed in
    lift_mm: float


class PatientSurface:
    """A smooth surface around the labelled voxels, over which a probe can slide.

    Parameters
    ----------
    labels : non-zero voxels are the patient. All points here are in the world frame of `labels.ijk_to_ras`.
    progress : called with the fraction done; may raise errors.Cancelled.

    Raises SimulationError for labels that are all zero.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import Volume
    >>> from SlicerUSSim.Logic.probe import PatientSurface
    >>> surface = PatientSurface(Volume(np.ones((60, 60, 60), np.uint8), np.eye(4)))
    >>> vertex = surface.at(right_deg=0, front_deg=0)
    >>> round(float(surface.normal(vertex)[2]), 1)  # outward is straight up
    1.0
    """

    def __init__(self, labels: Volume, progress: Callable[[float], None] = lambda share: None) -> None:
        require(bool((labels.array > 0).any()), "the label map is empty, expected labelled voxels")
        self.polydata: vtkPolyData = _closed_surface(labels, lambda share: progress(0.7 * share))
        points = vtk_to_numpy(self.polydata.GetPoints().GetData()).astype(float)
        self._normals = vtk_to_numpy(self.polydata.GetPointData().GetNormals()).astype(float)
        self._tree = KDTree(points)
        self._locator = vtkStaticCellLocator()
        self._locator.SetDataSet(self.polydata)
        self._locator.BuildLocator()
        progress(0.8)
        low, high = points.min(axis=0), points.max(axis=0)
        #: (3,) the middle of the patient's bounding box, the origin of angles()
        self.centre = 0.5 * (low + high)
        self._radius = float(np.linalg.norm(high - low))

    @cached_property
    def coarse_polydata(self) -> vtkPolyData:
        """The same surface with fewer triangles, for rendering without a GPU; it takes as long as the rest."""
        return _with_fewer_triangles(self.polydata)

    def nearest(self, point) -> np.ndarray:
        """(3,) the point of the surface closest to `point`."""
        closest, cell, part, distance = [0.0, 0.0, 0.0], _written(0), _written(0), _written(0.0)
        self._locator.FindClosestPoint(list(map(float, point)), closest, cell, part, distance)
        return np.array(closest)

    def distances_mm(self, points) -> np.ndarray:
        """(n,) distances of (n, 3) points to the nearest corners of the surface's triangles, which are 2 mm wide."""
        return self._tree.query(points)[0]

    def hit(self, start, end) -> np.ndarray | None:
        """(3,) the first intersection of the line from `start` to `end` with the surface, or None."""
        t, point, parametric = _written(0.0), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        part, cell = _written(0), _written(0)
        met = self._locator.IntersectWithLine(
            list(map(float, start)), list(map(float, end)), 1e-6, t, point, parametric, part, cell
        )
        return np.array(point) if met else None

    def normal(self, point) -> np.ndarray:
        """(3,) outward normal at a point of the surface, averaged over a patch of the size of a probe face."""
        point = np.asarray(point, float)
        near = self._tree.query_ball_point(point, _PATCH_MM) or [self._tree.query(point)[1]]
        away = np.linalg.norm(self._tree.data[near] - point, axis=1) / _PATCH_MM
        mean = (1.0 - np.minimum(away, 0.999) ** 2) ** 2 @ self._normals[near]
        length = np.linalg.norm(mean)
        return mean / length if length > 1e-6 else self._normals[near[0]]

    def angles(self, point) -> tuple[float, float]:
        """(to the right, to the front) in degrees: the direction of a point from the centre, relative to straight up.

        An azimuthal equidistant map: both zero at the vertex of the head, (90, 0) at the right ear, (0, 90) at the
        forehead; only straight down is singular.
        """
        x, y, z = np.asarray(point, float) - self.centre
        away, across = np.rad2deg(np.arctan2(np.hypot(x, y), z)), np.hypot(x, y)
        return (float(away * x / across), float(away * y / across)) if across > 1e-9 else (0.0, 0.0)

    def at(self, right_deg: float, front_deg: float) -> np.ndarray:
        """(3,) the outermost point of the surface in the direction given by these angles; the inverse of angles()."""
        away, across = np.deg2rad(np.hypot(right_deg, front_deg)), np.arctan2(front_deg, right_deg)
        outward = np.array([np.sin(away) * np.cos(across), np.sin(away) * np.sin(across), np.cos(away)])
        far = self.centre + self._radius * outward
        found = self.hit(far, self.centre)
        return self.nearest(far) if found is None else found

    def where(self, probe_to_ras: np.ndarray) -> SurfacePose:
        """A probe's pose (4, 4) relative to the point of the surface nearest to its face."""
        face = probe_to_ras[:3, 3]
        point = self.nearest(face)
        normal = self.normal(point)
        rock, tilt = angles_to_surface(probe_to_ras, normal)
        upright = probe_to_ras @ np.linalg.inv(turned(np.eye(4), rock_deg=rock, tilt_deg=tilt))
        across = carried(_LOOKING_DOWN, face, _UP, normal)[:3, :3].T @ upright[:3, 0]
        rotate = np.rad2deg(np.arctan2(-across[2], across[0]))
        return SurfacePose(*self.angles(point), float(rotate), rock, tilt, float((face - point) @ normal))

    def held(self, probe_to_ras: np.ndarray, **changes: float) -> np.ndarray:
        """(4, 4) probe_to_ras with some values of its SurfacePose changed; angles alone do not move the face."""
        pose = replace(self.where(probe_to_ras), **changes)
        if {"right_deg", "front_deg", "lift_mm"} & set(changes):
            point = self.at(pose.right_deg, pose.front_deg)
            normal = self.normal(point)
            face = point + pose.lift_mm * normal
        else:
            face = probe_to_ras[:3, 3]
            normal = self.normal(self.nearest(face))
        upright = turned(carried(_LOOKING_DOWN, face, _UP, normal), rotate_deg=pose.rotate_deg)
        return turned(upright, rock_deg=pose.rock_deg, tilt_deg=pose.tilt_deg)

    def slid(self, probe_to_ras: np.ndarray, point, *, upright: bool = True) -> np.ndarray:
        """(4, 4) probe_to_ras slid to the point of the surface nearest to `point`, at unchanged distance from it.

        With `upright` the probe is aligned with the normal there, otherwise it keeps its angles to the surface.
        """
        face = probe_to_ras[:3, 3]
        here, there = self.nearest(face), self.nearest(point)
        old, new = self.normal(here), self.normal(there)
        lift = np.clip((face - here) @ old, *_LIFT_MM)
        return carried(probe_to_ras, there + lift * new, -probe_to_ras[:3, 1] if upright else old, new)

    def along(self, path, step_mm: float = 1.0) -> list[np.ndarray]:
        """(4, 4) probe_to_ras at steps of `step_mm` along a `path` (points, 3) near the surface, both ends included.

        The probe stands upright on the surface, and its image planes are across the path, as in a freehand sweep. In
        the middle of the path the right of the image is to the right of the patient, or to the front.
        Raises SimulationError for a path without length on the surface, and for more than 10,000 poses.
        """
        require_between("PatientSurface.along", "step_mm", step_mm, 0.01, 100)
        near = [self.nearest(point) for point in _at_equal_steps(np.asarray(path, float), step_mm)]
        faces = _at_equal_steps(np.array(near), step_mm)
        depth = -np.array([self.normal(face) for face in faces])
        lateral = np.cross(depth, np.gradient(faces, axis=0))
        lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
        if lateral[len(faces) // 2] @ [1.0, 0.1, 0.0] < 0:
            lateral = -lateral
        poses = np.tile(np.eye(4), (len(faces), 1, 1))
        poses[:, :3] = np.stack([lateral, depth, np.cross(lateral, depth), faces], axis=2)
        return list(poses)


def _at_equal_steps(path: np.ndarray, step_mm: float) -> np.ndarray:
    """(points, 3) of a path, about `step_mm` apart along it, with both its ends."""
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    require(
        len(path) > 1 and 0 < travelled[-1] <= 10_000 * step_mm,
        f"the path on the patient is {travelled[-1]:.1f} mm long, expected up to {10_000 * step_mm:g} mm",
    )
    at = np.linspace(0.0, travelled[-1], max(round(travelled[-1] / step_mm), 1) + 1)
    return np.stack([np.interp(at, travelled, axis) for axis in path.T], axis=1)


def _written(start: float) -> Any:
    """A number that a method of VTK can write to. Any: VTK's type stubs require a plain number there."""
    return mutable(start)


def _distance_mm(outside: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(k, j, i) distance in mm of every voxel of `outside` to the nearest voxel that is not; voxels are `size` mm."""
    # The return type of scipy's function depends on its arguments, and scipy has no type annotations for that.
    return cast(np.ndarray, ndimage.distance_transform_edt(outside, sampling=size))


def _closed_surface(labels: Volume, progress: Callable[[float], None]) -> vtkPolyData:
    spacing = np.array(labels.spacing_mm)[::-1]  # k, j, i
    step = np.maximum(1, np.round(_VOXEL_MM / spacing)).astype(int)
    margin = np.ceil((_CLOSING_MM + 3 * _SMOOTHING_MM) / (step * spacing)).astype(int)
    inside = np.pad(_coarse(labels.array > 0, step), [(m, m) for m in margin])
    size = step * spacing
    progress(0.1)
    near = _distance_mm(~inside, size) <= _CLOSING_MM
    progress(0.4)
    closed = _distance_mm(near, size) > _CLOSING_MM
    progress(0.7)
    soft = ndimage.gaussian_filter((closed | inside).astype(np.float32), _SMOOTHING_MM / size)
    progress(0.8)

    contour = vtkFlyingEdges3D()
    contour.SetInputData(Volume(soft, np.eye(4)).to_vtk())
    contour.SetValue(0, 0.5)
    contour.ComputeNormalsOff()
    to_ras = labels.ijk_to_ras.copy()  # of the centres of the coarse voxels
    to_ras[:3, 3] += to_ras[:3, :3] @ (0.5 * (step[::-1] - 1) - step[::-1] * margin[::-1])
    to_ras[:3, :3] *= step[::-1]
    transform = vtkTransform()
    transform.SetMatrix(vtk_matrix(to_ras))
    placed = vtkTransformPolyDataFilter()
    placed.SetInputConnection(contour.GetOutputPort())
    placed.SetTransform(transform)
    return _with_normals(placed)


def _with_fewer_triangles(polydata: vtkPolyData) -> vtkPolyData:
    fewer = vtkQuadricDecimation()
    fewer.SetInputData(polydata)
    fewer.SetTargetReduction(_DROPPED)
    return _with_normals(fewer)


def _with_normals(source) -> vtkPolyData:
    normals = vtkPolyDataNormals()
    normals.SetInputConnection(source.GetOutputPort())
    normals.AutoOrientNormalsOn()
    normals.SplittingOff()
    normals.Update()
    return normals.GetOutput()


def _coarse(inside: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Blocks of `step` voxels that contain any voxel of the patient."""
    wanted = -(-np.array(inside.shape) // step) * step
    padded = np.pad(inside, [(0, extra) for extra in wanted - inside.shape])
    k, j, i = wanted // step
    return np.any(padded.reshape(k, step[0], j, step[1], i, step[2]), axis=(1, 3, 5))
