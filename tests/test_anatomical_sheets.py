"""Sulci, falx, tentorium and walls of ventricles as surfels, and surfels on voxels."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree

from SlicerUSSim.Logic import Segmentation, SimulationError, TissueTable, UltrasoundSimulator, Volume, segment_mri
from SlicerUSSim.Logic.imaging.sheet_voxels import on_voxels
from SlicerUSSim.Logic.mri import demo_mri, head_mri
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit
from SlicerUSSim.Logic.mri.sheets import find_sheets
from SlicerUSSim.Logic.mri.sheets.falx import falx
from SlicerUSSim.Logic.mri.sheets.finding import ependyma
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.heights import settled
from SlicerUSSim.Logic.mri.sheets.kept import key_of, read_kept_sheets
from SlicerUSSim.Logic.mri.sheets.polydata import as_polydata, read_surfels, write_surfels
from SlicerUSSim.Logic.mri.sheets.regions import tentorium_height
from SlicerUSSim.Logic.mri.sheets.sulcal import ridges, sulci
from SlicerUSSim.Logic.tissue import KINDS, Surfels
from validation.brain_phantoms import COLIN27


def unit(vector) -> np.ndarray:
    return np.array(vector, float) / np.linalg.norm(vector)


def plane_ridges(normal, spacing=(1.0, 1.0, 1.0), size_mm: float = 36.0):
    """(ridges of a bright plane through (0.2, 0.1, -0.3) mm of the middle, (k, j, i) mm of voxels, its place)."""
    spacing = np.array(spacing)
    shape = np.ceil(size_mm / spacing).astype(int)
    mm = (np.moveaxis(np.indices(tuple(shape)), 0, -1) - (shape - 1) / 2.0) * spacing
    place = np.array([0.2, 0.1, -0.3])
    values = np.exp(-0.5 * ((mm - place) @ normal / 1.2) ** 2).astype(np.float32)
    inside = np.asarray((np.abs(mm) < 13.0).all(axis=-1))
    return ridges(values, spacing, inside, 0.7, 0.1), (shape - 1) / 2.0, place


@pytest.mark.parametrize(
    ("normal", "spacing"),
    [
        ((0, 0, 1), (1.0, 1.0, 1.0)),
        ((0.3, -0.5, 0.81), (1.0, 1.0, 1.0)),
        ((1, 1, 1), (1.2, 0.9, 0.9)),
        ((0.7, 0.7, 0.05), (1.2, 0.9, 0.9)),
    ],
)
def test_a_plane_is_found_between_voxels_with_its_normal_and_area(normal, spacing):
    normal = unit(normal)
    found, middle, place = plane_ridges(normal, spacing)
    mm = (found.place - middle) * spacing
    assert np.abs((mm - place) @ normal).max() < 0.03
    assert np.abs(found.normal @ normal).min() > np.cos(np.radians(1.0))
    # Its area within the cube, by dense points on it
    first, second = np.linalg.svd(normal[None])[2][1:]
    u = np.arange(-30.0, 30.0, 0.1)
    points = place + u[:, None, None] * first + u[None, :, None] * second
    half = np.floor(13.0 / np.array(spacing) + 0.5) * spacing  # to the faces of the outermost voxels
    area = 0.01 * (np.abs(points) < half).all(axis=-1).sum()
    if len(set(np.abs(normal))) > 1:  # of planes that are tilted like the lattice itself, all or no voxels count
        assert found.area.sum() == pytest.approx(area, rel=0.06)


def test_heights_settle_on_a_ridge_and_stay_where_nothing_is_seen():
    offsets = np.arange(-10.0, 10.1, 0.5)
    rows = np.arange(60)[:, None]
    truth = (3.0 * np.sin(rows / 20.0) * np.ones(60)).astype(np.float32)
    relief = 4.0 * np.exp(-0.5 * ((offsets - truth[..., None]) / 1.0) ** 2)
    usable = np.ones(relief.shape, bool)
    height, sure = settled(relief, offsets, usable, (8.0, 5.0, 3.0), (4.0, 3.0, 2.0))
    assert np.abs(height - truth)[5:-5].max() < 0.15
    assert sure.mean() > 0.4
    height, sure = settled(np.zeros_like(relief), offsets, usable, (8.0, 5.0), (3.0, 2.0))
    assert np.abs(height).max() < 1e-3
    assert sure.max() < 0.15
    height, _ = settled(relief, offsets, np.zeros_like(usable), (8.0,), (3.0,))
    assert np.abs(height).max() == 0.0


def folded_head(gap_mm: float) -> Head:
    """Two banks of cortex, 2.5 mm each, in white matter; on x = 3 sin(y / 12) between them fluid of `gap_mm`."""
    mm = np.moveaxis(np.indices((70, 80, 80)), 0, -1).astype(np.float32) - np.array([0, 40, 40], np.float32)
    x, y, z = mm[..., 2], mm[..., 1], mm[..., 0]
    slope = 0.25 * np.cos(y / 12.0)
    across = np.abs((x - 3.0 * np.sin(y / 12.0)) / np.sqrt(1.0 + slope**2))
    is_sulcus = z > 25.0
    white = np.where(is_sulcus, np.clip(across - 2.5 - gap_mm / 2 + 0.5, 0, 1), 1.0)
    fluid = np.where(is_sulcus, np.clip(gap_mm / 2 - across + 0.5, 0, min(1.0, gap_mm)), 0.0)
    image = 100.0 + 40.0 * white - 80.0 * fluid * (1 - white)
    image += np.random.default_rng(1).normal(0.0, 3.0, image.shape)
    brain = (np.hypot(x, y) < 36.0) & (z > 3) & (z < 62)
    to_atlas = np.eye(4)
    to_atlas[2, 3] = 10.0
    volume = Volume(image.astype(np.float32), np.eye(4))
    return Head(volume, brain, 20.0, 100.0, 140.0, 4.0, False, AtlasFit(to_atlas, 1.0, mni152()))


def sulcus_error(found: Surfels) -> np.ndarray:
    place = found.place - np.array([40, 40, 0], np.float32)
    x, y = place[:, 0], place[:, 1]
    slope = 0.25 * np.cos(y / 12.0)
    return np.abs(x - 3.0 * np.sin(y / 12.0)) / np.sqrt(1.0 + slope**2)


@pytest.mark.parametrize("gap_mm", [0.6, 2.5])
def test_a_sulcus_is_one_sheet_at_its_middle_with_its_width(gap_mm):
    head = folded_head(gap_mm)
    found = sulci(head, np.zeros(head.brain.shape, bool))
    inner = found.chosen((found.place[:, 2] > 30) & (found.place[:, 2] < 55))
    error = sulcus_error(inner)
    assert np.median(error) < 0.25
    assert (error < 1.0).mean() > 0.9  # one sheet, nothing in the white matter
    assert np.median(inner.thickness) == pytest.approx(gap_mm, abs=0.5)
    # It is there all along: no holes
    y, z = np.meshgrid(np.arange(15, 65), np.arange(32, 54))
    truth = np.stack([40 + 3.0 * np.sin((y - 40) / 12.0), y, z], -1).reshape(-1, 3)
    assert KDTree(inner.place).query(truth)[0].max() < 1.5


def test_white_matter_alone_has_no_sulci():
    head = folded_head(1.0)
    rng = np.random.default_rng(2)
    noise = rng.normal(140.0, 4.0, head.image.array.shape).astype(np.float32)
    assert len(sulci(replace(head, image=head.image.with_array(noise)), np.zeros(head.brain.shape, bool))) == 0


def test_the_wall_of_a_ventricle_ends_at_an_opening():
    head = folded_head(1.0)
    k, j, i = np.indices(head.brain.shape)
    radius = np.sqrt((k - 15.3) ** 2 + (j - 40.2) ** 2 + (i - 39.7) ** 2)
    fluid = np.clip(9.0 - radius + 0.5, 0, 1)
    pipe = (np.hypot(j - 40.2, i - 39.7) < 3.0) & (k > 15)
    fluid = np.maximum(fluid, pipe)
    head = replace(head, image=head.image.with_array((120.0 - 100.0 * fluid).astype(np.float32)), grey=100.0)
    wall = ependyma(head, radius < 9.0)
    away = np.linalg.norm(wall.place - [39.7, 40.2, 15.3], axis=1)
    assert np.median(np.abs(away - 9.0)) < 0.15
    assert np.abs(np.median(away) - 9.0) < 0.1
    outwards = (wall.place - [39.7, 40.2, 15.3]) / away[:, None]
    assert np.median((wall.normal * outwards).sum(axis=1)) > 0.99
    is_opening = (np.hypot(*(wall.place[:, :2] - [39.7, 40.2]).T) < 1.5) & (wall.place[:, 2] > 15)
    assert not is_opening.any()
    assert wall.area.sum() == pytest.approx(4 * np.pi * 81.0 - np.pi * 9.0, rel=0.06)
    assert not len(ependyma(head, np.zeros(head.brain.shape, bool)))


# ---- surfels and their files ----------------------------------------------------------------------------------------


def some_surfels(count: int = 50) -> Surfels:
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Surfels.joined(
        [
            Surfels.of(kind, rng.uniform(-50, 50, (count, 3)), normal, 0.5, rng.uniform(0, 1, count), 1.2)
            for kind in KINDS
        ]
    )


def test_surfels_of_a_file_are_those_that_were_written(tmp_path):
    surfels = some_surfels()
    write_surfels(tmp_path / "sheets.vtp", surfels)
    again = read_surfels(tmp_path / "sheets.vtp")
    for entry in fields(Surfels):
        np.testing.assert_allclose(
            getattr(again, entry.name), getattr(surfels, entry.name), 1e-3, 1e-4, err_msg=entry.name
        )


def test_a_file_shows_squares_of_the_surfels_where_slicer_expects_them(tmp_path):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkMassProperties, vtkTriangleFilter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    surfels = some_surfels()
    write_surfels(tmp_path / "sheets.vtp", surfels)
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(tmp_path / "sheets.vtp"))
    reader.Update()
    shown = reader.GetOutput()
    corners = vtk_to_numpy(shown.GetPoints().GetData()).reshape(-1, 4, 3)
    assert np.allclose(corners.mean(axis=1), surfels.place, atol=1e-4)
    assert shown.GetFieldData().GetAbstractArray("SPACE").GetValue(0) == "RAS"
    triangles = vtkTriangleFilter()
    triangles.SetInputData(shown)
    mass = vtkMassProperties()
    mass.SetInputConnection(triangles.GetOutputPort())
    assert mass.GetSurfaceArea() == pytest.approx(surfels.area.sum(), rel=1e-4)


@pytest.mark.slow
def test_files_without_sheets_are_listed(tmp_path):
    with pytest.raises(SimulationError, match="expected a name with"):
        write_surfels(tmp_path / "sheets.stl", some_surfels())
    with pytest.raises(SimulationError, match="no such file"):
        read_surfels(tmp_path / "none.vtp")
    (tmp_path / "text.vtp").write_text("no XML")
    with pytest.raises(SimulationError, match="not a VTK surface"):
        read_surfels(tmp_path / "text.vtp")
    # VTK ended the process for a damaged one
    write_surfels(tmp_path / "own.vtp", some_surfels())
    text = (tmp_path / "own.vtp").read_bytes()
    for cut in (len(text) // 2, len(text) - 200):
        (tmp_path / "own.vtp").write_bytes(text[:cut] + b"\xff" * 40 + text[cut + 40 :])
        with pytest.raises(SimulationError):
            read_surfels(tmp_path / "own.vtp")


def test_surfels_are_checked_and_chosen_by_kind():
    surfels = some_surfels()
    assert len(surfels.of_kind("falx", "sulcus")) == 100
    assert len(Surfels.joined([])) == 0
    with pytest.raises(SimulationError, match="no kind 'dura'"):
        surfels.of_kind("dura")
    with pytest.raises(SimulationError, match="thickness of surfels is float64"):
        replace(surfels, thickness=surfels.thickness.astype(float))


# ---- on voxels ------------------------------------------------------------------------------------------------------


def plane_surfels(normal) -> tuple[Surfels, np.ndarray]:
    """(surfels as ridges of a plane gives them, a place on it), RAS."""
    found, middle, place = plane_ridges(unit(normal))
    back = slice(None, None, -1)
    return Surfels.of("falx", (found.place - middle)[:, back], found.normal[:, back], 0.8, 0.7, found.area), place[back]


def grid(spacing: float, half_mm: float = 9.0, turn_deg: float = 0.0) -> Volume:
    count = int(2 * half_mm / spacing) + 1
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) * spacing
    matrix[:3, 3] = -matrix[:3, :3] @ np.full(3, (count - 1) / 2.0)
    return Volume(np.zeros((count,) * 3, np.uint8), matrix)


def centres(volume: Volume) -> np.ndarray:
    kji = np.moveaxis(np.indices(volume.array.shape), 0, -1)
    return kji[..., ::-1] @ volume.ijk_to_ras[:3, :3].T + volume.ijk_to_ras[:3, 3]


@pytest.mark.parametrize(
    ("normal", "spacing", "turn"),
    [((0, 0, 1), 0.5, 0.0), ((1, 1, 1), 1.0, 0.0), ((0.3, -0.5, 0.81), 0.8, 20.0)],
)
def test_a_tilted_plane_on_voxels_has_its_distance_and_no_holes(normal, spacing, turn):
    surfels, place = plane_surfels(normal)
    ras_normal = unit(normal)[::-1]
    on = grid(spacing, turn_deg=turn)
    found = on_voxels(surfels, on)
    away = ((place - centres(on)) @ ras_normal).ravel()
    assert np.isin(np.flatnonzero(np.abs(away) < 1.95), found.voxels).all()
    assert np.abs(away[found.voxels]).max() < 2.05
    sign = np.sign(found.normal @ ras_normal)
    assert np.abs(found.distance * sign - away[found.voxels]).max() < 0.05
    assert np.abs(found.normal @ ras_normal).min() > np.cos(np.radians(1.0))
    assert np.allclose(found.thickness, 0.8, atol=1e-4) and np.allclose(found.confidence, 0.7, atol=1e-4)
    assert (found.kind == KINDS.index("falx")).all()


def test_a_ray_through_voxels_meets_a_sphere_where_it_is():
    count, radius = 2500, 12.0
    turns = np.arange(count) + 0.5
    up = 1 - 2 * turns / count
    around = np.pi * (1 + 5**0.5) * turns
    normal = np.stack([np.sqrt(1 - up**2) * np.cos(around), np.sqrt(1 - up**2) * np.sin(around), up], 1)
    surfels = Surfels.of("sulcus", radius * normal, normal, 0.5, 1.0, 4 * np.pi * radius**2 / count)
    on = grid(1.0, 16.0)
    voxels = on_voxels(surfels, on)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(400, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    steps = np.arange(9.0, 15.0, 0.25)
    points = steps[None, :, None] * ways[:, None] + rng.uniform(-0.5, 0.5, (400, 1, 3))
    index = np.rint(points @ on.ras_to_ijk[:3, :3].T + on.ras_to_ijk[:3, 3]).astype(int)
    entries = np.full(on.array.shape, -1)
    entries.ravel()[voxels.voxels] = np.arange(len(voxels.voxels))
    entry = entries[tuple(np.moveaxis(index[..., ::-1], -1, 0))]
    distance, found = voxels.distance[entry], voxels.normal[entry]
    centre = index @ on.ijk_to_ras[:3, :3].T + on.ijk_to_ras[:3, 3]
    # Height of a point above the plane stored in its voxel, with normals outwards
    height = ((points - centre) * found).sum(-1) - distance
    height *= np.sign((found * ways[:, None]).sum(-1))
    true = np.linalg.norm(points, axis=-1) - radius
    close = np.abs(true) < 0.5
    assert (entry[close] >= 0).all()
    assert np.abs(height - true)[close].max() < 0.12  # 0.5 mm aside on a sphere of 12 mm: 0.01, and neighbours' planes
    assert np.median(np.abs(height - true)[close]) < 0.03
    crosses = (height[:, :-1] < 0) & (height[:, 1:] >= 0) & (entry[:, :-1] >= 0) & (entry[:, 1:] >= 0)
    assert (crosses.sum(axis=1) == 1).all()  # one sheet, not two


def test_two_sheets_near_each_other_stay_apart():
    first, _ = plane_surfels((0, 0, 1))
    second = replace(first, place=first.place + np.array([2.4, 0, 0], np.float32))
    on = grid(1.0, 8.0)
    found = on_voxels(Surfels.joined([first, second]), on)
    met = centres(on).reshape(-1, 3)[found.voxels, 0] + found.distance * found.normal[:, 0]
    assert np.minimum(np.abs(met + 0.3), np.abs(met - 2.1)).max() < 0.06


def test_a_grid_too_coarse_for_the_reach_and_no_surfels():
    surfels, _ = plane_surfels((0, 0, 1))
    with pytest.raises(SimulationError, match=r"reach_mm is 1, expected at least 2\.3"):
        on_voxels(surfels, grid(3.0), reach_mm=1.0)
    assert not len(on_voxels(Surfels.joined([]), grid(1.0)).voxels)


# ---- whole heads ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_falx_that_enhances_as_white_matter_does_is_not_white_matter():
    """Between hemispheres 10 mm apart, off the middle between them."""
    x, y, z = np.mgrid[-30:31, -110:76, -30:89].astype(float).transpose(0, 3, 2, 1)
    csf, grey, white = 20.0, 100.0, 140.0
    in_brain = ((x / 70.0) ** 2 + ((y + 18.0) / 90.0) ** 2 + ((z - 10.0) / 75.0) ** 2) < 1.0
    at = 1.5 + 0.5 * np.sin(y / 30.0)
    image = np.select([np.abs(x) > 9.0, np.abs(x) > 6.0], [white, grey], csf)
    image[(z < 0.0) & (np.abs(x) < 9.0)] = white  # below the free edge, where the falx meets it
    image[np.abs(x - at) < 1.0] = white + 60.0
    image = ndimage.gaussian_filter(np.where(in_brain, image, 0.0), 0.7).astype(np.float32)
    matrix = np.diag([1.0, 1.0, 1.0, 1.0])
    matrix[:3, 3] = -30.0, -110.0, -30.0
    fit = AtlasFit(np.eye(4), 1.0, None)  # type: ignore[arg-type]
    head = Head(Volume(image, matrix), in_brain, csf, grey, white, 6.0, True, fit)
    found = falx(head, use_intensity=True)
    _, v, w = found.place.T
    inner = (v > -80) & (v < 50) & (w > 40) & (w < 70)
    away = found.place[inner, 0] - (1.5 + 0.5 * np.sin(v[inner] / 30.0))
    assert inner.sum() > 1000
    assert np.median(np.abs(away)) < 0.4
    assert np.percentile(np.abs(away), 90) < 1.0


def wide_vertex(is_enhanced: bool) -> tuple[Head, np.ndarray]:
    """(head whose hemispheres part towards the vertex, one more than the other, (y,) x of its falx from y = -60).

    The brain mask dips into the wide fluid between them, 12 mm below the sinus.
    """
    x, y, z = np.mgrid[-40:41, -60:41, 0:97].astype(float).transpose(0, 3, 2, 1)
    csf, grey, white = 20.0, 100.0, 140.0
    at = 1.0 + 0.7 * np.sin(y / 15.0)
    opening = np.maximum(z - 58.0, 0.0) ** 2
    bank = np.where(x < 0, -x - 3.0 - opening / 50.0, x - 3.0 - opening / 25.0)  # mm into the hemisphere
    bank = np.minimum(bank, np.where(x < 0, 79.0, 76.0) - z)
    image = np.select([bank > 3.0, bank > 0.0], [white, grey], csf)
    image[(z < 42.0) & (np.abs(x) < 10.0)] = white  # below the free edge
    in_falx = (np.abs(x - at) < np.maximum(1.2, z - 79.0)) & (z >= 42.0)
    image[in_falx] = white + 80.0 if is_enhanced else 0.5 * (csf + grey)
    image[z > 84.0] = 0.0  # bone
    image = ndimage.gaussian_filter(image, 0.7) + np.random.default_rng(1).normal(0.0, 4.0, image.shape)
    in_brain = (bank > 0.0) | ((z < 64.0) & (np.abs(x) < 6.0))
    matrix = np.eye(4)
    matrix[:3, 3] = -40.0, -60.0, 0.0
    fit = AtlasFit(np.eye(4), 1.0, None)  # type: ignore[arg-type]
    head = Head(Volume(image.astype(np.float32), matrix), in_brain, csf, grey, white, 4.0, is_enhanced, fit)
    return head, at[0, :, 0]


@pytest.mark.parametrize("is_enhanced", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_falx_in_wide_fluid_at_the_vertex_stays_off_the_gyri(is_enhanced):
    head, at = wide_vertex(is_enhanced)
    found = falx(head)
    _, y, z = found.place.T
    away = np.abs(found.place[:, 0] - at[np.rint(y + 60.0).astype(int)])
    inner, upper = (z > 48) & (z < 60) & (np.abs(y + 10) < 40), (z > 66) & (np.abs(y + 10) < 40)
    assert inner.sum() > 500
    assert upper.sum() > 500
    assert z.max() > (82.0 if is_enhanced else 74.0)  # the sinus; the lower of the rims
    assert np.percentile(away[upper], 95) < (0.8 if is_enhanced else 2.0)
    top = upper & (z > 72)
    if is_enhanced:
        assert found.confidence[top].min() > 0.7
    else:  # drawn on from below
        assert np.median(found.confidence[top]) < 0.6 < found.confidence[inner].min()


@pytest.mark.slow
def test_what_cannot_be_found_is_reported_before_the_search():
    mri = head_mri(spacing_mm=4.0)
    found = segment_mri(mri, thin_sulci=False)
    with pytest.raises(SimulationError, match="'dura'"):
        find_sheets(mri, found, contrast="t1", kinds=["dura"])
    with pytest.raises(SimulationError, match="contrast 'flair'"):
        find_sheets(mri, found, contrast="flair")
    with pytest.raises(SimulationError, match="no kind was chosen"):
        find_sheets(mri, found, contrast="t1", kinds=[])
    with pytest.raises(SimulationError, match="expected one grid"):
        find_sheets(Volume(mri.array[1:], mri.ijk_to_ras), found, contrast="t1")
    without_atlas = replace(found, evidence=replace(found.evidence, atlas=None))
    with pytest.raises(SimulationError, match="tentorium, vessels cannot be found without an atlas"):
        find_sheets(mri, without_atlas, contrast="t1", kinds=["tentorium", "vessels"])
    with pytest.raises(SimulationError, match="expected the order of t2"):
        find_sheets(mri, found, contrast="t2")


@cache
def template_head() -> tuple[Volume, Segmentation]:
    """MNI152 without every other voxel, 2 mm, and its segmentation."""
    mri, _ = demo_mri()
    step = slice(None, None, 2)
    coarse = Volume(mri.array[step, step, step].astype(np.float32), mri.ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0]))
    return coarse, segment_mri(coarse, thin_sulci=False)


@pytest.mark.slow
def test_sheets_are_kept_and_each_can_be_switched_off(tmp_path):
    mri, found = template_head()
    shares: list[float] = []
    place = tmp_path / "head.sheets.npz"
    kinds = ("falx", "tentorium", "ependyma", "corpus callosum")
    first = find_sheets(mri, found, contrast="t1", kinds=kinds, keep_at=place, progress=shares.append)
    assert place.is_file()
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert all(before <= after for before, after in itertools.pairwise(shares))
    assert set(np.unique(first.surfels.kind)) == {KINDS.index(kind) for kind in kinds if kind in KINDS}
    # A template has its falx in its middle, and a tentorium where the polynomial was fitted to it.
    there = first.surfels.of_kind("falx")
    assert np.median(np.abs(there.place[:, 0])) < 0.5
    assert np.abs(there.normal[:, 0]).min() > 0.8
    dura = first.surfels.of_kind("tentorium")
    aside = np.abs(dura.place[:, 0]) > 15
    away = dura.place[:, 2] - tentorium_height(dura.place[:, 0].astype(float), dura.place[:, 1].astype(float))
    assert np.median(np.abs(away[aside])) < 2.0
    assert [(tissue, source) for tissue, _, source in first.masks()] == [("corpus callosum", "corpus callosum")]
    assert 5.0 < (first.structures.array > 0).sum() * first.structures.voxel_ml < 30.0
    # Again, from the file: fewer kinds are part of it, others are not.
    again = find_sheets(mri, found, contrast="t1", kinds=("falx", "ependyma"), keep_at=place)
    assert "kept in" in again.notes[0]
    assert len(again.surfels) == len(first.surfels.of_kind("falx", "ependyma"))
    assert not again.structures.array.any()
    other = Volume(mri.array + np.float32(1.0), mri.ijk_to_ras)
    assert read_kept_sheets(place, key_of(other, found, "t1"), ("falx",)) is None
    key = key_of(mri, found, "t1")
    assert read_kept_sheets(place, key, ("falx",)) is not None
    find_sheets(mri, found, contrast="t1", kinds=("corpus callosum", "vessels"), keep_at=place)  # others replace these
    assert read_kept_sheets(place, key, ("tentorium",)) is None
    place.write_text("mine")
    sheets = find_sheets(mri, found, contrast="t1", kinds=("vessels", "choroid plexus"), keep_at=place)
    assert f"not kept: {place} exists" in sheets.notes[0] and place.read_text() == "mine"
    assert "only a T1 with contrast agent" in sheets.notes[1]
    assert not sheets.masks() and not len(sheets.surfels)


@pytest.mark.long
def test_the_command_writes_sheets_and_lays_structures_over_the_labels(tmp_path):
    from click.testing import CliRunner

    from SlicerUSSim.Command.cli import main

    mri, _ = template_head()
    head, out, sheets = tmp_path / "head.nii.gz", tmp_path / "labels.nii.gz", tmp_path / "sheets.vtp"
    mri.write(head)
    call = ["segment", str(head), "-o", str(out), "--sheets", str(sheets)]
    done = CliRunner().invoke(main, call)
    assert done.exit_code == 0, done.output
    assert "corpus callosum" in done.output
    surfels = read_surfels(sheets)
    assert KINDS.index("falx") in surfels.kind
    assert (tmp_path / "head.sheets.npz").is_file()
    assert len(np.unique(Volume.read(out).array)) > 4


@pytest.mark.long
def test_sheets_of_colin27_are_where_its_image_and_aal_show_them():
    if not (COLIN27 / "ch2bet.nii.gz").exists():
        pytest.skip("mricron-data is not installed")
    mri = Volume.read(COLIN27 / "ch2bet.nii.gz")
    found = segment_mri(mri, thin_sulci=False)
    sheets = find_sheets(mri, found, contrast="t1")
    head = Head.of(mri, found, "t1")
    # Fluid of sulci near a sheet, and near a sheet displaced
    fluid = head.brain & (head.fluid(head.image.array) > 0.5) & (head.depth > 2.0) & (head.in_atlas[2] > 30)
    points = head.to_ras(np.argwhere(fluid)[::5].astype(float))
    there = sheets.surfels.of_kind("sulcus", "falx").place
    near, displaced = ((KDTree(places).query(points)[0] < 1.5).mean() for places in (there, there + 3.0))
    assert near > 0.85
    assert displaced < 0.6
    # Cerebellum below the tentorium, cerebrum above
    drawn, tentorium = Volume.read(COLIN27 / "aal.nii.gz"), sheets.surfels.of_kind("tentorium")
    for labels, sign in ((range(91, 109), -1), ((39, 40, 43, 44, 47, 48, 55, 56), 1)):
        places = np.argwhere(np.isin(drawn.array, list(labels)))[:, ::-1] @ drawn.ijk_to_ras[:3, :3].T
        places = places + drawn.ijk_to_ras[:3, 3]
        away, nearest = KDTree(tentorium.place).query(places)
        normal = tentorium.normal[nearest] * np.sign(tentorium.normal[nearest][:, 2:])
        side = ((places - tentorium.place[nearest]) * normal).sum(axis=1)
        assert (sign * side[away < 8] > 0).mean() > 0.85
    # They are his, also on slices of 5 mm, and mirrored or 6 mm aside they are not.
    tissues = TissueTable.brain(found.tissue_names)
    slices = Volume(found.labels.array[::5], found.labels.ijk_to_ras @ np.diag([1.0, 1.0, 5.0, 1.0]))
    for labels in (found.labels, slices):
        UltrasoundSimulator(labels, tissues, sheets=sheets.surfels)
    sign = np.array([-1.0, 1.0, 1.0], np.float32)
    mirrored = replace(sheets.surfels, place=sheets.surfels.place * sign, normal=sheets.surfels.normal * sign)
    aside = replace(sheets.surfels, place=sheets.surfels.place + np.array([0.0, 0.0, 6.0], np.float32))
    for wrong in (mirrored, aside):
        with pytest.raises(SimulationError, match="the sheets' sulci do not lie in those of the labels"):
            UltrasoundSimulator(found.labels, tissues, sheets=wrong)


@pytest.mark.slow
def test_sheets_of_a_file_that_was_transformed_are_where_its_points_are(tmp_path):
    """Other programs leave the arrays as they were."""
    from vtkmodules.vtkCommonTransforms import vtkTransform
    from vtkmodules.vtkFiltersGeneral import vtkTransformPolyDataFilter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    surfels = some_surfels()

    def written(name: str, scale=(1.0, 1.0, 1.0), shift=(0.0, 0.0, 0.0), space: str = "RAS") -> Path:
        transform, moved, writer = vtkTransform(), vtkTransformPolyDataFilter(), vtkXMLPolyDataWriter()
        transform.Translate(*shift)
        transform.Scale(*scale)
        moved.SetTransform(transform)
        moved.SetInputData(as_polydata(surfels))
        moved.Update()
        data = moved.GetOutput()
        data.GetFieldData().GetAbstractArray("SPACE").SetValue(0, space)
        writer.SetInputData(data)
        writer.SetFileName(str(tmp_path / name))
        writer.Write()
        return tmp_path / name

    for scale, shift in (((1, 1, 1), (0, 0, 1.0)), ((-1, -1, 1), (0, 0, 0)), ((-1, 1, 1), (0, 0, 0))):
        found = read_surfels(written("moved.vtp", scale, shift))
        np.testing.assert_allclose(found.place, surfels.place * np.array(scale) + shift, atol=1e-4)
        along = np.abs((found.normal * (surfels.normal * np.array(scale))).sum(axis=1))
        np.testing.assert_allclose(along, 1.0, atol=1e-4)
        np.testing.assert_allclose(found.thickness, surfels.thickness, rtol=1e-3)
    same = read_surfels(written("slicer.vtp", (-1, -1, 1), space="LPS"))  # as Slicer writes a model
    np.testing.assert_allclose(same.place, surfels.place, atol=1e-4)
