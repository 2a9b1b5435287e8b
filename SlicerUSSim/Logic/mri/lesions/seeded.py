"""grow_lesion: what is at a point of an MRI, and the lesion around it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast
from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, either, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.evidence import Evidence
from SlicerUSSim.Logic.mri.lesions.doubts import why_no_lesion
from SlicerUSSim.Logic.mri.lesions.growth import Region, distance_from, grow, smoothed, with_foot
from SlicerUSSim.Logic.mri.lesions.looks import (
    SNAP_MM,
    Look,
    Window,
    around,
    brighter_than_white,
    enhancing,
    fluid,
    watery,
    watery_look,
    watery_weights,
    window_around,
)
from SlicerUSSim.Logic.mri.lesions.proposal import Proposal, millilitres, place
from SlicerUSSim.Logic.mri.pathology import LESIONS, tissue_to_add
from SlicerUSSim.Logic.mri.sheets.falx_of_part import fissure_of_part
from SlicerUSSim.Logic.mri.sheets.head import LEAST_VOXELS, Head

if TYPE_CHECKING:
    from SlicerUSSim.Logic.mri.segmentation import Segmentation

#: Names of looks: fluid, and what does not enhance in what does
_FLUID, _CORE = "fluid", "in what enhances"
#: Reach of the windows in which a region is grown, one after the other: most lesions are small
_REACHES_MM = (20.0, 70.0)
#: Tissues that a lesion may be called
LESION_TISSUES = tuple(name for name in LESIONS if name != "brats")
#: Of these, what is fluid in an MRI, and what may be: blood is, once it has liquefied
FLUIDS, _MAYBE_FLUIDS = ("cyst", "necrosis", "cavity"), ("haematoma", "blood")
#: Least volume of a part besides the largest
_LEAST_PART_ML = 0.1
#: Voxels around a watery region in which its enhancing part may be, and how many places are tried
_BORDER_VOXELS, _MOST_BLOBS = 2, 4
#: Share of the border of fluid along which a rim enhances, if it is necrosis, and the rim's largest distance
_LEAST_ENCLOSED, _RIM_MM = 0.5, 4.0
#: A point this far beside what is proposed is said to be so
_BESIDE_MM = 2.0
#: Distance from an enhancing region in which oedema begins
_OEDEMA_MM = 4.0


#: In every message whose remedy is `tissue`
SAY_WHAT = "say what it is"
_FLUID_NAMES = f"{SAY_WHAT}: a cyst, a cavity or a necrosis"
_WATERY_MEANS = (
    f"what holds more water than white matter may be tumour or oedema: look, and {SAY_WHAT}; contrast agent would tell "
    "more"
)


@dataclass(frozen=True, eq=False)
class Grown:
    """A region in a window, and its look."""

    look: Look
    region: Region
    window: Window

    def in_box(self, evidence: Evidence) -> np.ndarray:
        """(k, j, i) bool on the box of the evidence."""
        result = np.zeros(evidence.inside.shape, bool)
        result[self.window] = self.region.inside
        return result


def grow_lesion(segmentation: Segmentation, seed_ras_mm: Sequence[float], tissue: str | None = None) -> Proposal:
    """The lesion around one point, as a proposal; the segmentation stays as it is.

    Parameters
    ----------
    segmentation : of the MRI by segment_mri; with several volumes, all are used.
    seed_ras_mm : (3,) RAS mm of a point in the lesion. Of what enhances, up to 5 mm beside it.
    tissue : what it is, where the user knows, one of LESION_TISSUES; default: by its look. What enhances is "tumour"
        with "necrosis" in it, in "oedema"; what is bright in T2 or FLAIR, or dark in T1, is "tumour". A cyst, a cavity
        or a necrosis without a rim has to be called so, since it looks like CSF.

    Raises SimulationError, saying what is there, for a point outside the image or the brain, in CSF, in a vessel or in
    tissue that looks healthy. With `tissue`, a region is a lesion also if it looks like a vessel, a ventricle or the
    other side; what has no border is refused, and what contradicts the tissue: fluids and oedema do not enhance,
    "enhancing" does, and a tumour is no fluid.

    Takes 1 to 4 seconds.
    """
    evidence = with_fissure(segmentation.evidence)
    named = None if tissue is None else lesion_tissue(tissue)
    seed = require_in_image(segmentation.labels, seed_ras_mm)
    index = _require_in_brain(evidence, seed)
    doubts: list[str] = []
    contradiction, doubtful = None, None
    for grown in _regions_at(evidence, index, named):
        why = why_no_lesion(evidence, grown.look, grown.region, grown.window)
        why = why or _why_not_meant(evidence, grown, index)
        if named is not None and _contradicts(grown, named):
            contradiction = contradiction or _contradiction(evidence, grown, named, why)
            if named in FLUIDS and why is None:
                break
        elif why is None or (named in FLUIDS and grown.look.name in (_FLUID, _CORE)):
            return proposal_of(segmentation, grown, seed, named)
        else:
            doubts.append(why)
            doubtful = doubtful or grown
    if named is not None and named not in FLUIDS and doubtful is not None:
        return proposal_of(segmentation, doubtful, seed, named)
    what = contradiction or _what_is_at(segmentation, index, doubts, named)
    raise SimulationError(f"the seed {place(seed)} is in {what}")


def _regions_at(evidence: Evidence, index: np.ndarray, named: str | None) -> Iterator[Grown]:
    """The regions around a place (k, j, i in the box), of each look, the likeliest for a tissue first."""
    looks = enhancing, watery, fluid
    if named in FLUIDS:
        looks = fluid, enhancing, watery
    elif named == "oedema":  # it begins at the border of what enhances
        looks = watery, enhancing, fluid
    for look in looks:
        # A piece of a large rim looks like a vessel; all of it does not
        for reaches in (_REACHES_MM, _REACHES_MM[1:]) if look is enhancing else (_REACHES_MM,):
            grown = grown_by(look, evidence, index, reaches, with_rim=named not in FLUIDS)
            if grown is None:
                break
            core = _core_of(evidence, grown, index) if named in FLUIDS and look is enhancing else None
            yield core or grown


def _why_not_meant(evidence: Evidence, grown: Grown, index: np.ndarray) -> str | None:
    """Words for why what enhances beside a point (k, j, i in the box) in fluid is not meant by it; None if it may be.

    Fluid within a rim is: veins that cross a cistern do not enclose the point.
    """
    nearest = np.rint(index).astype(int)
    if grown.look.name != "enhancing" or not evidence.fluid[tuple(nearest)]:
        return None
    point = nearest - [part.start for part in grown.window]
    iterations = max(round(_RIM_MM / float(evidence.spacing_mm.max())), 1)
    padded = np.pad(grown.region.inside, iterations)
    closed = np.asarray(ndimage.binary_closing(padded, iterations=iterations))
    enclosed = np.asarray(ndimage.binary_fill_holes(closed))
    return None if enclosed[tuple(point + iterations)] else "beside the point, which is in fluid"


def lesion_tissue(name: str) -> str:
    """One of LESION_TISSUES, by any of its names. Raises SimulationError that lists them for another.

    >>> from SlicerUSSim.Logic.mri.lesions.seeded import lesion_tissue
    >>> lesion_tissue("Edema")
    'oedema'
    """
    expected = f"expected a lesion: {either(LESION_TISSUES)}"
    try:
        tissue = tissue_to_add(name)
    except SimulationError:
        raise SimulationError(f"no tissue is called {name!r}, {expected}") from None
    require(tissue in LESION_TISSUES, f"{name!r} is no lesion, {expected}")
    return tissue


def _contradicts(grown: Grown, named: str) -> bool:
    """Whether a region does not look as this tissue must."""
    look = grown.look.name
    if look == "enhancing":
        return named in FLUIDS or named == "oedema"
    if look == _FLUID:
        return named not in FLUIDS + _MAYBE_FLUIDS
    return named == "enhancing"


def _contradiction(evidence: Evidence, grown: Grown, named: str, doubt: str | None) -> str:
    """The rest of the sentence "the seed is in ..."; `doubt` is why the region is no lesion, if it is none."""
    look, size = grown.look.name, millilitres(grown.region.volume_ml(evidence.spacing_mm))
    if look == "enhancing" and doubt is not None:
        return f"what enhances {doubt}, and {named} does not: expected a point in the {named}"
    if look == "enhancing":
        return f"what enhances ({size}), and {named} does not: expected a point in the {named}, or {SAY_WHAT}: a tumour"
    if look == _FLUID:
        return f"fluid ({size}), and {named} is none: expected a point in the {named}, or {_FLUID_NAMES}"
    if evidence.channel("t1gd") is None:
        return (
            f"an MRI without contrast agent, in which nothing is enhancing: it is {look} ({size}); {SAY_WHAT}, such as "
            "tumour"
        )
    return f"what does not enhance, but is {look} ({size}); {SAY_WHAT}, such as tumour or oedema"


def _core_of(evidence: Evidence, grown: Grown, index: np.ndarray) -> Grown | None:
    """What does not enhance within a region that does, near a place (k, j, i in the box); None if there is nothing."""
    core = _necrosis_in(evidence, grown)[grown.window]
    place_in_window = index - [part.start for part in grown.window]
    near = core & (distance_from(place_in_window, core.shape, evidence.spacing_mm) <= SNAP_MM)
    if not near.any() or core.sum() * evidence.voxel_ml < _LEAST_PART_ML:
        return None
    return replace(
        grown, look=replace(grown.look, name=_CORE), region=replace(grown.region, inside=core)
    )  # fmt: skip


def grown_by(
    look: Callable[[Evidence, Window, np.ndarray], Look | None], evidence: Evidence, index: np.ndarray,
    reaches_mm: Sequence[float] = _REACHES_MM, with_rim: bool = True,
) -> Grown | None:  # fmt: skip
    """The region of one look around a place (k, j, i in the box); None if it does not look so, or has no border.

    Regions that end within the first reach are taken, and otherwise within the next. Of fluid `with_rim`, the region of
    the rim that enhances around it.
    """
    for reach in _REACHES_MM[-1:] if look is watery else reaches_mm:
        window = window_around(evidence, index, reach + 2.0)
        seen = look(evidence, window, index)
        if seen is None:
            return None
        region = grow(seen.likeness, seen.allowed, seen.seed, evidence.spacing_mm, largest_mm=reach)
        if region is not None:
            if seen.name == "enhancing":
                region = with_foot(region, seen.likeness, seen.allowed, evidence.spacing_mm)
                region = _with_enclosed_fluid(evidence, region, window)
            grown = Grown(seen, region, window)
            rim = _with_rim(evidence, grown) if with_rim and seen.name == "fluid" else None
            return rim or grown
    return None


def _with_enclosed_fluid(evidence: Evidence, region: Region, window: Window) -> Region:
    """A region that enhances with the necrosis in its rim, also where the rim has gaps."""
    inside = region.inside
    parts, count = ndimage.label(evidence.fluid[window] & ~inside)  # type: ignore[misc]
    near = cast(np.ndarray, ndimage.binary_dilation(inside, iterations=_BORDER_VOXELS))
    touched = np.unique(parts[near & (parts > 0)]) if count else ()
    for number in touched:
        part = parts == number
        around = cast(np.ndarray, ndimage.binary_dilation(part, iterations=_BORDER_VOXELS)) & ~part
        if float(near[around].mean()) >= _LEAST_ENCLOSED:
            inside = inside | part | (around & near)
    if inside is region.inside:
        return region
    inside = cast(np.ndarray, ndimage.binary_fill_holes(ndimage.binary_closing(inside, iterations=_BORDER_VOXELS)))
    depth = cast(np.ndarray, ndimage.distance_transform_edt(inside, sampling=evidence.spacing_mm.tolist()))
    return Region(inside, region.level, region.slope, float(depth.max()))


def _with_rim(evidence: Evidence, grown: Grown) -> Grown | None:
    """What enhances around a fluid region, with it; None if it has no such rim."""
    channel = evidence.channel("t1gd")
    if channel is None:
        return None
    inside = grown.region.inside
    apart = cast(np.ndarray, ndimage.distance_transform_edt(~inside, sampling=evidence.spacing_mm.tolist()))
    shell = (apart > 0.0) & (apart <= _RIM_MM) & evidence.inside[grown.window]
    image = smoothed(evidence.images[channel][grown.window], evidence.inside[grown.window], evidence.spacing_mm)
    bright = shell & (image > brighter_than_white(evidence, channel))
    # Of a rim of any thickness, how much of the way around
    seen = ndimage.binary_dilation(bright, iterations=_BORDER_VOXELS)
    border = ndimage.binary_dilation(inside) & ~inside
    if not bright.any() or float(seen[border].mean()) < _LEAST_ENCLOSED:
        return None
    peak = np.unravel_index(int(np.where(bright, image, -np.inf).argmax()), image.shape)
    for reaches in (_REACHES_MM, _REACHES_MM[1:]):  # a piece of it, or all
        rim = grown_by(enhancing, evidence, np.add(peak, [part.start for part in grown.window]), reaches)
        if rim is not None and (rim.in_box(evidence) & grown.in_box(evidence)).sum() >= 0.5 * inside.sum():
            return rim
    return None


def require_in_image(grid: Volume, seed_ras_mm: Sequence[float]) -> np.ndarray:
    """(3,) RAS mm of a seed. Raises SimulationError for one outside the grid of an MRI, and for what is no point."""
    seed = np.asarray(seed_ras_mm, float)
    require(
        seed.shape == (3,) and bool(np.isfinite(seed).all()),
        f"the seed is {seed_ras_mm!r}, expected three finite numbers: R, A and S in mm",
    )
    ijk = grid.ras_to_ijk[:3] @ [*seed, 1.0]
    size = np.array(grid.array.shape[::-1])
    beyond = float((np.maximum(np.maximum(-0.5 - ijk, ijk - size + 0.5), 0.0) * grid.spacing_mm).max())
    require(
        beyond == 0.0,
        f"the seed {place(seed)} is {max(beyond, 1.0):.0f} mm outside the image, expected a point in the lesion in RAS "
        "mm of the MRI; is it in voxels, or in LPS?",
    )
    return seed


def _require_in_brain(evidence: Evidence, seed: np.ndarray) -> np.ndarray:
    """(3,) k, j, i in the box of the brain of a point in RAS mm. Raises SimulationError for one outside the brain."""
    index = evidence.index_of(seed)
    nearest = np.rint(index).astype(int)
    within = bool((nearest >= 0).all() and (nearest < evidence.inside.shape).all())
    if not (within and evidence.inside[tuple(nearest)]):
        voxels = np.argwhere(evidence.inside)
        apart = float(np.linalg.norm((voxels - index) * evidence.spacing_mm, axis=1).min())
        raise SimulationError(
            f"the seed {place(seed)} is {max(apart, 1.0):.0f} mm outside the brain, expected a point in the lesion; if "
            "the lesion is outside the brain mask, give it with --add"
        )
    return index


def proposal_of(segmentation: Segmentation, grown: Grown, seed: np.ndarray, named: str | None) -> Proposal:
    """The parts of a region, and what belongs to it."""
    evidence = with_fissure(segmentation.evidence)
    inside = grown.in_box(evidence)
    parts: dict[str, np.ndarray] = {}
    if named is not None:
        parts[named] = inside
    elif grown.look.name == "enhancing":
        core = _necrosis_in(evidence, grown)
        parts = {"oedema": _oedema_around(evidence, grown, inside), "tumour": inside & ~core, "necrosis": core}
    elif grown.look.name == "fluid":
        parts["cyst"] = inside
    else:
        within = _enhancing_in(evidence, inside)
        if within is None:
            parts["tumour"] = inside
        else:
            core, both = _necrosis_in(evidence, within), within.in_box(evidence)
            parts = {"oedema": inside & ~both, "tumour": both & ~core, "necrosis": core}
    least = _LEAST_PART_ML / evidence.voxel_ml
    main = max(parts, key=lambda name: int(parts[name].sum()) if name != "oedema" else 0)
    labels, tissues = np.zeros(inside.shape, np.uint8), []
    for name, part in parts.items():
        if name == main or part.sum() >= least:
            tissues.append(name)
            labels[part] = len(tissues)
        elif name != "oedema":
            labels[part] = len(tissues) or 1
    warnings = []
    beside = float(distance_from(evidence.index_of(seed), labels.shape, evidence.spacing_mm)[labels > 0].min())
    if beside >= _BESIDE_MM:
        warnings.append(f"the point is {beside:.0f} mm beside what is proposed: look whether that is meant")
    if evidence.atlas is None:
        warnings.append("without an atlas, the other hemisphere was not compared: look whether it is healthy tissue")
    if named is None and grown.look.name not in ("enhancing", "fluid") and "oedema" not in tissues:
        warnings.append(_WATERY_MEANS)
    return Proposal(
        segmentation.labels.with_array(evidence.to_whole(labels)),
        tuple(tissues),
        grown.look.name,
        seed,
        tuple(warnings),
    )


def _necrosis_in(evidence: Evidence, grown: Grown) -> np.ndarray:
    """(k, j, i) bool: not enhancing, within the rim: darker than half-way to grey matter's contrast."""
    result = np.zeros(evidence.inside.shape, bool)
    likeness, inside = grown.look.likeness, grown.region.inside
    depth = cast(np.ndarray, ndimage.distance_transform_edt(inside, sampling=evidence.spacing_mm.tolist()))
    dark = inside & (smoothed(likeness, grown.look.allowed, evidence.spacing_mm) < 0.3) & (depth > 2.0)
    result[grown.window] = ndimage.binary_opening(dark)
    return result


def _enhancing_in(evidence: Evidence, inside: np.ndarray) -> Grown | None:
    """The largest region that enhances in a watery one (k, j, i), or at its border; None if none does."""
    channel = evidence.channel("t1gd")
    if channel is None:
        return None
    window = ndimage.find_objects(ndimage.binary_dilation(inside, iterations=_BORDER_VOXELS).astype(np.uint8))[0]
    near = ndimage.binary_dilation(inside[window], iterations=_BORDER_VOXELS) & evidence.inside[window]
    smooth = smoothed(evidence.images[channel][window], evidence.inside[window], evidence.spacing_mm)
    parts, count = ndimage.label(near & (smooth > brighter_than_white(evidence, channel)))  # type: ignore[misc]
    found: Grown | None = None
    for number in np.argsort(-np.bincount(parts.ravel())[1:], kind="stable")[:_MOST_BLOBS] + 1 if count else ():
        peak = np.unravel_index(int(np.where(parts == number, smooth, -np.inf).argmax()), parts.shape)
        grown = grown_by(enhancing, evidence, np.add(peak, [part.start for part in window]))
        if grown is None or why_no_lesion(evidence, grown.look, grown.region, grown.window) is not None:
            continue
        if found is None or grown.region.inside.sum() > found.region.inside.sum():
            found = grown
    return found


def _oedema_around(evidence: Evidence, grown: Grown, inside: np.ndarray) -> np.ndarray:
    """(k, j, i) bool: the watery region that begins at the border of what enhances; empty if there is none."""
    empty = np.zeros(inside.shape, bool)
    centre = np.array(ndimage.center_of_mass(inside))
    window = window_around(evidence, centre, _REACHES_MM[-1] + 2.0)
    core = inside[window]
    apart = cast(np.ndarray, ndimage.distance_transform_edt(~core, sampling=evidence.spacing_mm.tolist()))
    tissue = evidence.inside[window] & ~evidence.fluid[window]
    shell = tissue & (apart > 1.0) & (apart <= _OEDEMA_MM)
    if not shell.any():
        return empty
    # Of a shell that is partly healthy, the watery half
    here = np.array([float(np.median(image[window][shell])) for image in evidence.images])
    weights = watery_weights(evidence, here)
    if weights is None:
        return empty
    allowed = (tissue | core) & ~evidence.is_between_hemispheres(window)
    look = watery_look(evidence, window, weights, allowed, centre)
    likeness = np.where(core, np.float32(1.0), look.likeness)
    # From the most watery place at the border of the core
    seed = np.array(np.unravel_index(int(np.where(shell, look.likeness, -np.inf).argmax()), core.shape))
    region = grow(likeness, allowed, seed, evidence.spacing_mm, largest_mm=_REACHES_MM[-1])
    if region is None or why_no_lesion(evidence, look, region, window) is not None:
        return empty
    empty[window] = region.inside & ~core
    return empty


def _what_is_at(segmentation: Segmentation, index: np.ndarray, doubts: list[str], named: str | None) -> str:
    """The rest of the sentence "the seed is in ..."."""
    evidence = segmentation.evidence
    window, ball = around(evidence, index)
    if float(evidence.fluid[window][ball].mean()) >= 0.5:
        return f"fluid that looks like CSF, expected a point in a lesion; for a fluid lesion {_FLUID_NAMES}"
    nearest = tuple(int(n) for n in np.rint(index).astype(int) + evidence.start)
    label = int(segmentation.labels.array[nearest])
    name = segmentation.tissue_names[label - 1] if label else "the background"
    if doubts and name == "enhancing":
        return f"what enhances {doubts[0]}, expected a point in a lesion"
    why = f" ({doubts[-1]})" if doubts else ""
    remedy = f"; if it is a lesion all the same, {SAY_WHAT}, such as tumour"
    if named is not None:
        remedy = f"; what looks like its surroundings has no border: draw a mask, and add it as {named}"
    if evidence.had_field and evidence.atlas is None:
        remedy += (
            "; without an atlas a large lesion can be taken for a bias field, which was removed: try without bias "
            "correction"
        )
    return f"{name} that looks healthy{why}, expected a point in a lesion{remedy}"


# ---- the fissure between the hemispheres as a border, where no atlas says where it is --------------------------------

#: From the fissure, whose points are 1 mm apart, to its sides
_SIDE_MM = 1.0
#: What was found, since several seeds are tried
_known: WeakKeyDictionary[Evidence, Evidence] = WeakKeyDictionary()


def with_fissure(evidence: Evidence) -> Evidence:
    """The evidence with the fissure (sheets/falx_of_part.py); as it is with an atlas, which has it."""
    if evidence.atlas is not None or evidence.fissure is not None:
        return evidence
    if evidence not in _known:
        _known[evidence] = replace(evidence, fissure=_fissure(evidence))
    return _known[evidence]


def _fissure(evidence: Evidence) -> np.ndarray:
    """(k, j, i) bool: around the fissure; nowhere if none is found."""
    inside, spacing = evidence.inside, evidence.spacing_mm
    result = np.zeros(inside.shape, bool)
    channel = evidence.channel("t1", "t1gd", "t2")
    if channel is None:
        return result
    contrast = evidence.contrasts[channel]
    sign = np.float32(-1.0 if contrast == "t2" else 1.0)
    means = sign * evidence.means[:, channel]
    if not means[0] < means[1] < means[2]:
        return result
    image = Volume(sign * evidence.images[channel], evidence.ijk_to_ras)
    head = Head.of_part(image, inside, means.tolist(), float(evidence.deviations[channel]), contrast == "t1gd")
    if min(head.brain.shape) < LEAST_VOXELS:
        return result
    places = fissure_of_part(head)
    index = np.rint((places @ image.ras_to_ijk[:3, :3].T + image.ras_to_ijk[:3, 3])[:, ::-1]).astype(int)
    index = index[((index >= 0) & (index < inside.shape)).all(axis=1)]
    if not len(index):
        return result
    result[tuple(index.T)] = True
    away = np.asarray(ndimage.distance_transform_edt(~result, sampling=spacing.tolist()))
    return away < _SIDE_MM + 0.5 * float(spacing.max())
