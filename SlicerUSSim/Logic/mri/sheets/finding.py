"""Everything that ultrasound shows and classes of intensity do not: found in a patient's MRI, in one call."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import Atlas
from SlicerUSSim.Logic.mri.coarse import components, largest_component
from SlicerUSSim.Logic.mri.refinement import closed, near_points, on_grid
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.sheets.falx import falx
from SlicerUSSim.Logic.mri.sheets.falx_of_part import falx_of_part
from SlicerUSSim.Logic.mri.sheets.head import Head, require_contrast
from SlicerUSSim.Logic.mri.sheets.kept import keep_sheets, key_of, read_kept_sheets
from SlicerUSSim.Logic.mri.sheets.regions import lateral_ventricles_of_atlas, ventricles
from SlicerUSSim.Logic.mri.sheets.sulcal import sulci
from SlicerUSSim.Logic.mri.sheets.tentorium import tentorium
from SlicerUSSim.Logic.tissue.names import labels_of
from SlicerUSSim.Logic.tissue.surfels import KINDS, Surfels

_log = logging.getLogger(__name__)

#: Structures with a volume and the tissue that stands for each; label n + 1 of Sheets.structures is number n
STRUCTURES = {"corpus callosum": "corpus callosum", "choroid plexus": "enhancing", "vessels": "enhancing"}
#: Everything that can be found
ALL_KINDS = (*KINDS, *STRUCTURES)
#: Those that only contrast agent shows
_ENHANCING = ("choroid plexus", "vessels")
#: Those that are found without an atlas, in a part of a brain
_WITHOUT_ATLAS = ("sulcus", "falx", "ependyma")
#: A sulcus this near to the falx or the tentorium and as parallel to it is the fissure in which that lies, mm
_SAME_MM, _SAME_COSINE = 2.0, 0.7
#: About how long each step takes
_SHARES = {
    "head": 0.15, "ventricles": 0.12, "falx": 0.1, "tentorium": 0.05, "sulcus": 0.3, "ependyma": 0.08,
    "corpus callosum": 0.05, "choroid plexus": 0.05, "vessels": 0.1,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sheets:
    """What was found in one patient's head."""

    surfels: Surfels
    #: uint8 on the MRI's grid: label n + 1 is number n of STRUCTURES, 0 elsewhere
    structures: Volume
    #: Lines for the user: what was found, and what the search omitted
    notes: tuple[str, ...]

    def masks(self) -> list[tuple[str, Volume, str]]:
        """(tissue, mask, source) of every structure that was found, as add_tissues lays them over labels."""
        result = []
        for number, (name, tissue) in enumerate(STRUCTURES.items(), 1):
            inside = self.structures.array == number
            if inside.any():
                result.append((tissue, self.structures.with_array(inside.astype(np.uint8)), name))
        return result


def find_sheets(
    mri: Volume,
    segmentation: Segmentation,
    *,
    contrast: str,
    kinds: Iterable[str] = ALL_KINDS,
    keep_at: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Sheets:
    """Sulci, falx, tentorium and walls of ventricles as surfels; corpus callosum, choroid plexus and vessels as labels.

    Parameters
    ----------
    mri : the image from which `segmentation` was made.
    segmentation : led by the atlas. Without it, as in a part of a brain, only sulci and walls of wide deep fluid are
        found, and a falx that stands out of the sulci (falx_of_part.py).
    contrast : of the MRI: "t1", "t1gd" or "t2".
    kinds : what to find, of ALL_KINDS. Without contrast agent no vessels and no choroid plexus are found.
    keep_at : file in which they are kept and from which they are read again; see kept.sheets_beside.
    progress : called with the completed fraction, 0 to 1; may raise errors.Cancelled, which ends the search.

    Raises SimulationError for an unknown kind or contrast, an MRI on another grid than the segmentation, and
    where nothing of what is wanted can be found without an atlas.
    """
    wanted = tuple(kinds)
    require_findable(wanted, contrast)
    require(wanted, f"no kind was chosen, expected some of: {', '.join(ALL_KINDS)}")
    notes, asked = [], wanted
    if segmentation.atlas is None:
        wanted = tuple(kind for kind in wanted if kind in _WITHOUT_ATLAS)
        lacking = "without an atlas, which needs a whole brain"
        require(wanted, f"{', '.join(asked)} cannot be found {lacking}")
        if len(wanted) < len(asked):
            notes.append(f"only {' and '.join(wanted)} can be found {lacking}")
    report = progress or (lambda share: None)
    report(0.0)
    key = key_of(mri, segmentation, contrast) if keep_at is not None else ""
    kept = read_kept_sheets(keep_at, key, wanted) if keep_at is not None else None
    if kept is not None:
        surfels, array = kept
        array = np.where(np.isin(array, labels_of(STRUCTURES, wanted)), array, 0)
        structures = Volume(array.astype(np.uint8), mri.ijk_to_ras, label_names=dict(enumerate(STRUCTURES, 1)))
        surfels, first = surfels.of_kind(*(set(KINDS) & set(wanted))), f"the sheets are those kept in {keep_at}"
    else:
        surfels, structures = _found(Head.of(mri, segmentation, contrast), mri, wanted, report)
        first = keep_sheets(keep_at, key, wanted, surfels, structures.array) if keep_at is not None else ""
    notes += [first] if first else []
    if contrast != "t1gd" and set(_ENHANCING) & set(wanted):
        notes.append("vessels and choroid plexus are omitted: only a T1 with contrast agent shows them")
    notes += _lines(surfels, structures, wanted)
    if segmentation.atlas is None and "falx" in wanted:
        notes.append("the falx is the straight sulcus, if there is one, that is as deep as the fissure: look at it")
    for line in notes:
        _log.info("%s", line)
    report(1.0)
    return Sheets(surfels, structures, tuple(notes))


def require_findable(kinds: Iterable[str], contrast: str) -> None:
    """Raise SimulationError for a kind that is not in ALL_KINDS, and a contrast in which sheets are not found."""
    for kind in kinds:
        require(kind in ALL_KINDS, f"nothing of kind {kind!r} can be found, expected some of: {', '.join(ALL_KINDS)}")
    require_contrast(contrast)


def _found(head: Head, mri: Volume, wanted: tuple[str, ...], report: Callable[[float], None]) -> tuple[Surfels, Volume]:
    """(surfels, structures) of the wanted kinds, each step after the ones it needs."""
    done, start = 0.0, perf_counter()

    def finished(step: str) -> None:
        nonlocal done, start
        done, now = min(done + _SHARES[step], 1.0), perf_counter()
        _log.debug("sheets: %s in %.0f ms", step, (now - start) * 1e3)
        start = now
        report(done)

    finished("head")
    if not head.is_enhanced:
        wanted = tuple(kind for kind in wanted if kind not in _ENHANCING)
    found: dict[str, Surfels] = {}
    masks: dict[str, np.ndarray] = {}
    in_ventricles = np.zeros(head.brain.shape, bool)
    is_whole = head.registered is not None
    by_sulci = "sulcus" in wanted or ("falx" in wanted and not is_whole)
    if {"ependyma", *_ENHANCING} & set(wanted) or by_sulci:
        in_ventricles = ventricles(head)
        finished("ventricles")
    all_sulci = Surfels.joined([])
    if by_sulci:
        all_sulci = sulci(head, in_ventricles)
        finished("sulcus")
    if {"falx", "tentorium", "vessels"} & set(wanted):  # the apex of the tentorium is below the falx
        found["falx"] = falx(head) if is_whole else falx_of_part(head, all_sulci)
        finished("falx")
    if {"tentorium", "vessels"} & set(wanted):
        found["tentorium"] = tentorium(head, found["falx"])
        finished("tentorium")
    dura = Surfels.joined(list(found.values()))
    if "sulcus" in wanted:
        found["sulcus"] = _beside(all_sulci, dura.of_kind(*(set(KINDS) & set(wanted))))
    if "ependyma" in wanted:
        found["ependyma"] = ependyma(head, in_ventricles)
        finished("ependyma")
    if "corpus callosum" in wanted:
        masks["corpus callosum"] = corpus_callosum(head)
        finished("corpus callosum")
    if set(_ENHANCING) & set(wanted):
        masks["choroid plexus"] = choroid_plexus(head, in_ventricles)
        finished("choroid plexus")
    if "vessels" in wanted:
        masks["vessels"] = vessels(head, dura, masks["choroid plexus"])
        finished("vessels")
    surfels = Surfels.joined([found[kind] for kind in KINDS if kind in found and kind in wanted])
    return surfels, _labels(mri, head, {name: mask for name, mask in masks.items() if name in wanted})


def _beside(sulci_: Surfels, dura: Surfels) -> Surfels:
    """Sulci without those that are the fissure of the falx or the tentorium, which would be a second sheet there."""
    if not len(dura) or not len(sulci_):
        return sulci_
    away, nearest = KDTree(dura.place).query(sulci_.place, distance_upper_bound=_SAME_MM, workers=-1)
    is_near = np.isfinite(away)
    cosine = np.zeros(len(sulci_), np.float32)
    cosine[is_near] = np.abs((sulci_.normal[is_near] * dura.normal[np.asarray(nearest)[is_near]]).sum(axis=1))
    return sulci_.chosen(cosine < _SAME_COSINE)


def _labels(mri: Volume, head: Head, masks: dict[str, np.ndarray]) -> Volume:
    labels = np.zeros(mri.array.shape, np.uint8)
    for number, name in enumerate(STRUCTURES, 1):
        if name in masks:
            share = on_grid(head.image.with_array(masks[name].astype(np.float32)), mri)
            labels[share > 0.5] = number
    names = dict(enumerate(STRUCTURES, 1))
    return Volume(labels, mri.ijk_to_ras, label_names=names)


def _lines(surfels: Surfels, structures: Volume, wanted: tuple[str, ...]) -> list[str]:
    lines = []
    for kind in KINDS:
        if kind in wanted:
            part = surfels.of_kind(kind)
            lines.append(f"{kind}: {len(part)} surfels, {part.area.sum() / 100.0:.0f} cm²")
    for number, name in enumerate(STRUCTURES, 1):
        count = int((structures.array == number).sum())
        if name in wanted and (count or name == "corpus callosum"):
            lines.append(f"{name}: {count * structures.voxel_ml:.1f} ml")
    return lines


# ---- walls of the ventricles: where the fluid in them ends, between voxels -------------------------------------------

_SIGMA_MM = 0.5
#: Gaps by which choroid plexus and septa part the fluid, closed before the fluid around is looked at, mm
_CLOSED_MM = 2.0
#: From the wall into the tissue and into the fluid, where both have to be met, mm
_OUTSIDE_MM, _INSIDE_MM = 1.5, 1.2
#: One layer of cells with the glia below
_THICKNESS_MM = 0.1


def ependyma(head: Head, ventricles: np.ndarray) -> Surfels:
    """Surfels where the intensity is midway between CSF and the tissue around the `ventricles` (k, j, i).

    Without those at foramina, where fluid continues outside, and at the choroid plexus, which enhances.
    """
    from skimage.measure import marching_cubes

    if not ventricles.any():
        return Surfels.joined([])
    head, ventricles = head.around(ventricles, _CLOSED_MM + _OUTSIDE_MM + 3.0)
    tissue = 0.5 * (head.grey + head.white)
    fluid = np.clip((tissue - head.smoothed(_SIGMA_MM)) / (tissue - head.csf), 0.0, 1.0).astype(np.float32)
    inside = closed(ventricles, _CLOSED_MM / float(head.spacing.mean()))
    if head.is_enhanced:
        fluid[inside & (head.image.array > head.white + 2.0 * head.noise)] = 1.0
    field = np.where(distance_to(inside, head.image.spacing_mm) <= _OUTSIDE_MM, fluid, 0.0).astype(np.float32)
    corners, triangles, outwards, _ = marching_cubes(field, 0.5, spacing=(1.0, 1.0, 1.0), gradient_direction="descent")
    place = head.to_ras(corners)
    # Normals of marching cubes are gradients in voxels, which point from fluid into tissue.
    normal = outwards[:, ::-1] / head.image.spacing_mm
    normal = normal @ (head.image.ijk_to_ras[:3, :3] / head.image.spacing_mm).T
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    sides = place[triangles]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    areas = np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), len(place))
    within, beyond = head.at(place - _INSIDE_MM * normal, fluid), head.at(place + _OUTSIDE_MM * normal, fluid)
    confidence = np.clip(within - beyond, 0.0, 1.0)
    kept = (beyond < 0.5) & (confidence > 0.1)
    return Surfels.of("ependyma", place[kept], normal[kept], _THICKNESS_MM, confidence[kept], areas[kept])


# ---- corpus callosum: the template's, moved to the patient's white matter in the midsagittal plane -------------------

#: y and z of MNI152 between which it is, and how far it is followed to the sides, mm
_Y_MM, _Z_MM, _SIDE_MM = (-48.0, 38.0), (-12.0, 35.0), 15.0
_WHITE = 0.6
#: Moves in the midsagittal plane that are tried, and the ring around it that has to be darker, mm
_MOVES_MM, _RING_MM = 6, 3.0
#: By how much the template's may differ from the patient's, mm
_GROWN_MM = 1.0


@cache
def template_callosum(atlas: Atlas) -> np.ndarray:
    """(k, j, i) bool of the atlas: connected white matter of the midline, followed to the sides."""
    t1, white = atlas.t1, atlas.white.array > _WHITE
    k, j, i = np.ogrid[tuple(map(slice, white.shape))]
    x, y, z = (row[0] * i + row[1] * j + row[2] * k + row[3] for row in t1.ijk_to_ras[:3])
    place = (y > _Y_MM[0]) & (y < _Y_MM[1]) & (z > _Z_MM[0]) & (z < _Z_MM[1])
    white &= place
    middle = largest_component(ndimage.binary_opening(white & (np.abs(x) <= 2.0)))
    result = middle.copy()
    centre = int(np.argmin(np.abs(x[0, 0])))
    # From slice to slice to both sides: each may be a voxel wider only every fourth time.
    for direction in (1, -1):
        before = middle[:, :, centre]
        for n in range(1, int(_SIDE_MM / t1.spacing_mm[0]) + 1):
            column = centre + direction * n
            before = (ndimage.binary_dilation(before) if n % 4 == 0 else before) & white[:, :, column]
            result[:, :, column] |= before
    return ndimage.binary_opening(result)


def corpus_callosum(head: Head) -> np.ndarray:
    """(k, j, i) True in the corpus callosum; all False where it is not met."""
    template = template_callosum(head.atlas.atlas)
    move = _best_move(head, template)
    t1 = head.atlas.atlas.t1
    shifted = ndimage.shift(template.astype(np.float32), np.rint(move[::-1] / t1.spacing_mm[::-1]), order=0)
    near = distance_to(head.carried(shifted) > 0.5, head.image.spacing_mm) <= _GROWN_MM
    values = head.smoothed(0.4)
    white = (values > 0.5 * (head.grey + head.white)) & (values < head.white + 4.0 * head.noise)
    found = ndimage.binary_opening(near & white & head.brain)
    return largest_component(found) if found.any() else found


def _best_move(head: Head, template: np.ndarray) -> np.ndarray:
    """(3,) mm of the atlas, in its midsagittal plane, by which it is most white within and least around."""
    t1 = head.atlas.atlas.t1
    around = distance_to(template) * float(t1.spacing_mm.mean())
    x = t1.ijk_to_ras[0, 0] * np.arange(template.shape[2]) + t1.ijk_to_ras[0, 3]
    near = np.abs(x) <= 6.0
    ring = (around > 0.5) & (around <= _RING_MM) & near
    inside = template & near
    points, signs = [], []
    for part, sign in ((inside, 1.0), (ring, -1.0)):
        kji = np.argwhere(part)[::3]
        points.append(kji[:, ::-1] @ t1.ijk_to_ras[:3, :3].T + t1.ijk_to_ras[:3, 3])
        signs.append(np.full(len(kji), sign / len(kji)))
    xyz, weights = np.concatenate(points), np.concatenate(signs)
    share = np.clip((head.smoothed(1.0) - head.grey) / (head.white - head.grey), -1.0, 1.0)

    def score(move: tuple[int, ...]) -> float:
        seen = float(head.at(head.from_atlas(xyz + [0.0, *move]), share) @ weights)
        return seen - 0.01 * float(np.hypot(move[0], move[1]))

    steps = range(-_MOVES_MM, _MOVES_MM + 1)
    coarse = max(itertools.product(steps[::2], steps[::2]), key=score)
    fine = max(itertools.product(*(range(m - 1, m + 2) for m in coarse)), key=score)
    return np.array([0.0, *fine])


# ---- vessels and choroid plexus, where contrast agent shows them -----------------------------------------------------

#: Radii of vessels, mm; their objectness counts from this percentile of the brain's
_SIGMAS_MM, _PERCENTILE = (0.7, 1.0, 1.5), 93.0
#: Brighter than white matter by these deviations of the noise: every voxel, and at least one of each vessel
_LEAST, _PEAK = 3.0, 6.0
_LEAST_VESSEL_MM3 = 2.0
#: Sinuses are wider than this, lie this far around those parts and this near the surface, and dura is this near to its
#: sheets; mm
_SINUS_MM, _SINUS_RIM_MM, _SURFACE_MM, _DURA_MM = 5.0, 2.0, 1.0, 1.5
#: Choroid plexus: gaps that it leaves in the fluid, how far it may stick out of it, mm; brightness, and least volume
_CHOROID_CLOSED_MM, _CHOROID_OUTSIDE_MM, _CHOROID_LEAST, _LEAST_CHOROID_MM3 = 3.6, 1.5, 2.0, 15.0
#: Internal cerebral veins are nearer to the midline
_MIDLINE_MM = 5.0


def choroid_plexus(head: Head, ventricles: np.ndarray) -> np.ndarray:
    """(k, j, i) True where tissue in the `ventricles` enhances; without internal cerebral veins."""
    if not ventricles.any():
        return np.zeros(ventricles.shape, bool)
    mm = float(head.spacing.mean())
    # The plexus fills the atria, where no fluid tells of them.
    region = closed(ventricles | lateral_ventricles_of_atlas(head), _CHOROID_CLOSED_MM / mm)
    region = distance_to(region, head.image.spacing_mm) <= _CHOROID_OUTSIDE_MM
    bright = region & (head.image.array > head.white + _CHOROID_LEAST * head.noise)
    bright &= np.abs(head.in_atlas[0]) > _MIDLINE_MM
    return _large(bright, _LEAST_CHOROID_MM3 / head.voxel_mm3)


def vessels(head: Head, sheets: Surfels, apart: np.ndarray) -> np.ndarray:
    """(k, j, i) True in enhancing tubes of the brain (Antiga, Insight Journal 2007, after Frangi et al., MICCAI 1998).

    Without the sinuses, the dura's `sheets`, which enhance as well, and what is `apart` (k, j, i).
    """
    bright = head.brain & (head.image.array > head.white + _LEAST * head.noise)
    tubes = _tubeness(head)
    found = bright & (tubes > np.percentile(tubes[head.brain], _PERCENTILE))
    wide = head.image.array > head.white + _LEAST * head.noise
    core = distance_to(~wide, head.image.spacing_mm) > 0.5 * _SINUS_MM
    if core.any():
        found &= distance_to(core, head.image.spacing_mm) > 0.5 * _SINUS_MM + _SINUS_RIM_MM
    found &= (head.depth > _SURFACE_MM) & ~apart & ~near_points(head.image, sheets.place, _DURA_MM)
    parts = components(found, corners=True)
    sizes = np.bincount(parts.ravel())
    peaks = ndimage.maximum(head.image.array, parts, np.arange(len(sizes)))
    kept = (sizes * head.voxel_mm3 > _LEAST_VESSEL_MM3) & (np.asarray(peaks) > head.white + _PEAK * head.noise)
    kept[0] = False
    return kept[parts]


def _tubeness(head: Head) -> np.ndarray:
    """(k, j, i) float32 largest objectness of bright lines over the radii."""
    import SimpleITK as sitk

    image, result = head.image.to_sitk(), np.zeros(head.brain.shape, np.float32)
    for sigma in _SIGMAS_MM:
        smooth = sitk.SmoothingRecursiveGaussian(image, [sigma] * 3)
        lines = sitk.ObjectnessMeasure(
            smooth, alpha=0.5, beta=0.5, gamma=20.0, scaleObjectnessMeasure=False, objectDimension=1, brightObject=True
        )
        result = np.maximum(result, sigma**2 * sitk.GetArrayViewFromImage(lines))
    return result


def _large(inside: np.ndarray, voxels: float) -> np.ndarray:
    parts = components(inside)
    kept = np.bincount(parts.ravel()) > voxels
    kept[0] = False
    return kept[parts]
