"""The numbers of docs/sheets.md: how near sheets are to what the images show, each with a control.

    python -m benchmarks.sheets [remind022 turned shifted colin27 mni152] [FILE=CONTRAST ...] [--keep FOLDER]

ReMIND-022 needs ../shared, Colin27 Debian's mricron-data; missing data are left out. About four minutes in all.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from benchmarks.brain_extraction import SHARED
from SlicerUSSim.Logic import Segmentation, Volume, segment_mri
from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.mri.coregistration import aligned
from SlicerUSSim.Logic.mri.sheets import STRUCTURES, Sheets, find_sheets
from SlicerUSSim.Logic.mri.sheets.falx import FREE_EDGE, falx
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.regions import hindbrain, in_tentorium, tentorium_height, ventricles
from SlicerUSSim.Logic.mri.sheets.sulcal import Ridges, large_parts, ridges
from SlicerUSSim.Logic.tissue import Surfels
from validation.brain_phantoms import COLIN27

_RNG = np.random.default_rng(0)


def disc_distance(surfels: Surfels, points: np.ndarray, count: int = 12) -> np.ndarray:
    """(n,) mm from points to the nearest surfel, a disc of its area."""
    _, nearest = KDTree(surfels.place).query(points, count)
    apart = points[:, None] - surfels.place[nearest]
    across = np.abs((apart * surfels.normal[nearest]).sum(-1))
    aside = np.sqrt(np.maximum((apart**2).sum(-1) - across**2, 0.0)) - np.sqrt(surfels.area[nearest] / np.pi)
    return np.hypot(across, np.maximum(aside, 0.0)).min(axis=1)


def plane_distance(surfels: Surfels, points: np.ndarray) -> np.ndarray:
    """(n,) mm from points to the plane of the nearest surfel."""
    _, nearest = KDTree(surfels.place).query(points)
    return np.abs(((points - surfels.place[nearest]) * surfels.normal[nearest]).sum(axis=1))


def moved(surfels: Surfels, places: np.ndarray) -> Surfels:
    return replace(surfels, place=places.astype(np.float32))


def mirrored(head: Head, surfels: Surfels) -> Surfels:
    """Reflected at the atlas's midsagittal plane."""
    points, tips = (head.to_atlas(p) * [-1, 1, 1] for p in (surfels.place, surfels.place + surfels.normal))
    normal = head.from_atlas(tips) - head.from_atlas(points)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return replace(moved(surfels, head.from_atlas(points)), normal=normal.astype(np.float32))


def timed(name: str, mri: Volume, found: Segmentation, contrast: str, **options) -> Sheets:
    start, cpu = perf_counter(), process_time()
    sheets = find_sheets(mri, found, contrast=contrast, **options)
    print(f"{name}: {perf_counter() - start:.0f} s, {process_time() - cpu:.0f} s of CPU; {'; '.join(sheets.notes)}")
    return sheets


def coverage(name: str, head: Head, sheets: Surfels) -> None:
    """Visible sulcal CSF: more fluid than grey matter, deeper than 2 mm, not in or near ventricles and hindbrain.

    And what of it is in sulci: a ball of 4 mm does not fit into its fluid, as it does into that of cisterns, of which
    half is further than 1 mm from any sheet in its middle.
    """
    away = distance_to(ventricles(head), head.image.spacing_mm) >= 3.0
    fluid = head.brain & (head.fluid(head.image.array) > 0.5) & (head.depth > 2.0) & ~hindbrain(head) & away
    kji = np.argwhere(fluid)
    some_kji = _RNG.permutation(kji)[:20000]
    points = head.to_ras(some_kji.astype(float))
    every = head.brain & (head.fluid(head.image.array) > 0.5)
    middles = distance_to(~every, head.image.spacing_mm) >= 2.0
    narrow = (distance_to(middles, head.image.spacing_mm) > 2.0)[tuple(some_kji.T)]
    controls = {"": sheets, "mirrored": mirrored(head, sheets), "5 mm aside": moved(sheets, sheets.place + 2.9)}
    for control, surfels in controls.items():
        away_mm = disc_distance(surfels, points)
        for which, some in (("", np.ones(len(points), bool)), (" where less than 4 mm wide", narrow)):
            shares = ", ".join(f"{(away_mm[some] <= mm).mean():.1%} within {mm} mm" for mm in (0.9, 1.0, 1.5))
            millilitres = some.mean() * len(kji) * head.voxel_mm3 / 1000
            print(f"{name} sulcal CSF{which} ({millilitres:.0f} ml) {control or 'sheets'}: {shares}")


def confirmed(t2: Volume, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Whether a T2 is 20 % brighter within 1 mm of a place than at its darkest 2 to 3.5 mm aside, on both sides."""
    steps = np.arange(-3.5, 3.51, 0.5)
    points = place[:, None] + steps[:, None] * normal[:, None]
    index = points @ t2.ras_to_ijk[:3, :3].T + t2.ras_to_ijk[:3, 3]
    values = ndimage.map_coordinates(t2.array.astype(np.float32), np.moveaxis(index[..., ::-1], -1, 0), order=1)
    sides = np.maximum(values[:, steps <= -2].min(axis=1), values[:, steps >= 2].min(axis=1))
    return values[:, np.abs(steps) <= 1].max(axis=1) > 1.2 * sides


def t2_confirms(head: Head, sulci: Surfels, t2: Volume) -> None:
    kji = np.argwhere(head.brain & (head.depth > 2) & (head.white_distance > 1.2) & (head.white_distance < 5.0))
    anywhere = head.to_ras(kji[_RNG.integers(len(kji), size=20000)] + _RNG.uniform(-0.5, 0.5, (20000, 3)))
    ways = _RNG.normal(size=(20000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    some = sulci.chosen(_RNG.integers(len(sulci), size=20000))
    beside = some.place + _RNG.uniform(3, 6, (20000, 1)) * ways
    in_cortex = head.at(beside, (head.brain & (head.depth > 2) & (head.white_distance > 1.2)).astype(np.float32)) > 0.5
    seen = confirmed(t2, some.place, some.normal)
    sure = ", ".join(
        f"{seen[(some.confidence >= low) & (some.confidence < high)].mean():.0%} at {low} to {high}"
        for low, high in ((0.4, 0.6), (0.6, 0.8), (0.8, 1.01))
    )
    weighted = np.average(seen, weights=some.confidence)
    aside = confirmed(t2, beside[in_cortex], some.normal[in_cortex]).mean()
    chance = confirmed(t2, anywhere, ways).mean()
    print(
        f"T2 confirms {seen.mean():.1%} of sulci, weighted by confidence {weighted:.1%} ({sure}); moved 3 to 6 mm "
        f"within cortex and CSF {aside:.1%}, any place and direction in cortex {chance:.1%}"
    )


def falx_shown(head: Head, least_depth_mm: float = 1.0) -> np.ndarray:
    """(n, 3) RAS mm of the enhancing falx: bright ridges that stand upright above the free edge, near the midline."""
    x, _, _ = head.in_atlas
    where = (np.abs(x) < 12) & (head.depth > least_depth_mm) & (head.smoothed(0.5) > head.white + 2 * head.noise)
    found = large_parts(ridges(head.image.array, head.spacing, where, 0.8, 5.0), where.shape, 30.0)
    points, normal = atlas_places(head, found)
    edge = np.interp(-points[:, 1], [-y for y, _ in FREE_EDGE], [float(z) for _, z in FREE_EDGE])
    return head.from_atlas(points[(np.abs(normal[:, 0]) > 0.85) & (points[:, 2] > edge + 1)])


def falx_by_height(label: str, head: Head, surfels: Surfels) -> None:
    """How many surfels are more than 2 mm off the enhancing falx, up to the sinus, by how far they are below the top.

    Of those more than 40 mm above the atlas's origin with an enhancing place within 1.5 mm in y and z.
    """
    places, shown = head.to_atlas(surfels.place), head.to_atlas(falx_shown(head, -12.0))
    column = np.rint(places[:, 1]).astype(int)
    top = {y: places[np.abs(column - y) <= 1, 2].max() for y in np.unique(column)}
    below = np.array([top[y] for y in column]) - places[:, 2]
    near = KDTree(shown[:, 1:]).query_ball_point(places[:, 1:], 1.5)
    off = np.array([abs(x - np.median(shown[n, 0])) if n else np.nan for x, n in zip(places[:, 0], near, strict=True)])
    lines = []
    for low, high in ((-1, 3), (3, 6), (6, 10), (10, 100)):
        band = (below >= low) & (below < high) & (places[:, 2] > 40)
        some = off[band & np.isfinite(off)]
        if len(some):
            sure = surfels.confidence[band].mean()
            lines.append(f"{(some > 2).mean():.1%} of {len(some)} (confidence {sure:.2f}) from {max(low, 0)} mm")
    print(f"falx {label}, more than 2 mm off by mm below its top: {', '.join(lines)}")


def tentorium_shown(head: Head) -> np.ndarray:
    """(n, 3) RAS mm of the enhancing tentorium: bright ridges within 9 mm of the template's, as steep as that."""
    x, y, z = head.in_atlas
    where = in_tentorium(x, y) & (np.abs(z - tentorium_height(x, y)) < 9) & (head.depth > 0)
    where &= head.smoothed(0.5) > head.white + 2 * head.noise
    found = ridges(head.image.array, head.spacing, where, 0.8, 8.0)
    points, normal = atlas_places(head, found)
    slopes = [
        tentorium_height(points[:, 0] + a, points[:, 1] + b) - tentorium_height(points[:, 0] - a, points[:, 1] - b)
        for a, b in ((0.5, 0.0), (0.0, 0.5))
    ]
    up = np.stack([-slopes[0], -slopes[1], np.ones(len(points))], axis=1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    found = large_parts(found.chosen(np.abs((normal * up).sum(axis=1)) > 0.85), where.shape, 60.0)
    return head.to_ras(found.place)


def atlas_places(head: Head, found: Ridges) -> tuple[np.ndarray, np.ndarray]:
    points = head.to_atlas(head.to_ras(found.place))
    normal = head.to_atlas(head.to_ras(found.place + found.normal)) - points
    return points, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def sheet_errors(name: str, head: Head, truth: np.ndarray, sheets: dict[str, Surfels]) -> None:
    for label, surfels in sheets.items():
        away, middle = plane_distance(surfels, truth), np.abs(head.to_atlas(truth)[:, 0]) < 12
        apex = f", |x| < 12 mm {np.median(away[middle]):.2f}" if name == "tentorium" else ""
        print(f"{name} {label}: median {np.median(away):.2f} mm, 90 % {np.percentile(away, 90):.2f}{apex}")


def segmented(arguments, name: str, mri: Volume, **options) -> Segmentation:
    keep_at = arguments.keep / f"{name}-mask.nrrd" if arguments.keep else None
    return segment_mri(mri, keep_mask_at=keep_at, **options, thin_sulci=False)


def dura(head: Head, surfels: Surfels) -> None:
    """Falx and tentorium against those that enhance."""
    here = surfels.of_kind("falx")
    without = falx(head, use_intensity=False)
    flat = head.to_atlas(here.place) * [0, 1, 1]
    controls = {
        "with contrast": here, "without using it": without, "mirrored": mirrored(head, here),
        "x = 0 of the atlas": moved(here, head.from_atlas(flat)),
        "3 mm aside": moved(here, here.place + 3 * here.normal),
    }  # fmt: skip
    sheet_errors("falx", head, falx_shown(head), controls)
    for label in ("with contrast", "without using it"):
        falx_by_height(label, head, controls[label])
    here = surfels.of_kind("tentorium")
    flat = head.to_atlas(here.place)
    flat[:, 2] = tentorium_height(flat[:, 0], flat[:, 1])
    controls = {
        "found": here, "of the template": moved(here, head.from_atlas(flat)), "mirrored": mirrored(head, here),
        "3 mm aside": moved(here, here.place + 3 * here.normal),
    }  # fmt: skip
    sheet_errors("tentorium", head, tentorium_shown(head), controls)


def remind(arguments) -> None:
    t1, t2 = (Volume.read(SHARED / f"remind022/{name}.nii.gz") for name in ("t1_contrast", "t2"))
    found = segmented(arguments, "remind022", t1, contrast="t1gd")
    sheets = timed("ReMIND-022", t1, found, "t1gd")
    head = Head.of(t1, found, "t1gd")
    other, _ = aligned(t2, t1, found.brain.mask.array > 0, "t2")
    sulci = sheets.surfels.of_kind("sulcus")
    coverage("ReMIND-022", head, sheets.surfels.of_kind("sulcus", "falx", "tentorium"))
    t2_confirms(head, sulci, other)
    dura(head, sheets.surfels)
    # The same walls and sulci from the T2 alone
    by_t2 = segment_mri(other, contrast="t2", mask=found.brain.mask, thin_sulci=False)
    again = timed("ReMIND-022's T2", other, by_t2, "t2", kinds=["sulcus", "ependyma"]).surfels
    for kind in ("ependyma", "sulcus"):
        one, two = sheets.surfels.of_kind(kind), again.of_kind(kind)
        aside = moved(two, two.place + 2.9)
        print(
            f"{kind}: T1 to T2 median {np.median(disc_distance(two, one.place)):.2f} mm, "
            f"{(disc_distance(two, one.place) < 1).mean():.1%} within 1 mm; T2 5 mm aside "
            f"{np.median(disc_distance(aside, one.place)):.2f} mm, {(disc_distance(aside, one.place) < 1).mean():.1%}"
        )
    vessel = sheets.structures.array == 1 + list(STRUCTURES).index("vessels")
    away = distance_to(vessel)  # voxels
    around = (away >= 1.5) & (away <= 3.0) & (other.array > 0)
    dark = 0.75 * np.median(other.array[around])
    void = [(other.array[where] < dark).mean() for where in (vessel, around)]
    print(f"flow void in T2: {void[0]:.0%} of vessels, {void[1]:.0%} around")


def turned(arguments) -> None:
    """Turned by 10 degrees about (1, 1, 1), on 1 mm voxels, with noise, and found again."""
    t1 = Volume.read(SHARED / "remind022/t1_contrast.nii.gz")
    found = segmented(arguments, "remind022", t1, contrast="t1gd")
    first = find_sheets(t1, found, contrast="t1gd", kinds=["sulcus", "falx", "tentorium", "ependyma"]).surfels
    axis = np.ones(3) / np.sqrt(3.0)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    angle = np.radians(10.0)
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    inside = np.argwhere(found.brain.mask.array > 0)[:, ::-1]
    corners = inside @ t1.ijk_to_ras[:3, :3].T + t1.ijk_to_ras[:3, 3]
    middle = corners.mean(axis=0)
    size = np.ceil((corners - middle) @ turn.T).__abs__().max(axis=0) + 20
    matrix = np.eye(4)
    matrix[:3, 3] = -size
    shape = tuple((2 * size[::-1] + 1).astype(int))
    k, j, i = np.indices(shape)
    ras = np.stack([i, j, k], -1) + matrix[:3, 3]  # of the turned head, about its middle
    index = (ras @ turn + middle) @ t1.ras_to_ijk[:3, :3].T + t1.ras_to_ijk[:3, 3]
    index = np.moveaxis(index[..., ::-1], -1, 0)
    image = ndimage.map_coordinates(t1.array.astype(np.float32), index, order=3)
    image = np.maximum(image + _RNG.normal(0.0, found.noise, shape), 0.0).astype(np.float32)
    mask = ndimage.map_coordinates(found.brain.mask.array.astype(np.float32), index, order=1) > 0.5
    again = segment_mri(
        Volume(image, matrix), contrast="t1gd", mask=Volume(mask.astype(np.uint8), matrix), thin_sulci=False
    )
    second = find_sheets(Volume(image, matrix), again, contrast="t1gd").surfels
    back = replace(
        second,
        place=(second.place @ turn + middle).astype(np.float32),
        normal=(second.normal @ turn).astype(np.float32),
    )
    for kind in ("sulcus", "falx", "tentorium", "ependyma"):
        one, two = first.of_kind(kind), back.of_kind(kind)
        away = disc_distance(two, one.place)
        aside = disc_distance(moved(two, two.place + 2.9), one.place)
        print(
            f"turned {kind}: median {np.median(away):.2f} mm, {(away < 1.5).mean():.1%} within 1.5 mm; 5 mm aside "
            f"{np.median(aside):.2f} mm, {(aside < 1.5).mean():.1%}"
        )


def shifted(arguments) -> None:
    """A midline bent by 9 mm, as a mass does it."""
    t1 = Volume.read(SHARED / "remind022/t1_contrast.nii.gz")
    found = segmented(arguments, "remind022", t1, contrast="t1gd")
    head = Head.of(t1, found, "t1gd")
    truth = falx_shown(head)

    def bend(points: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(points, -1, 0)
        return 9.0 * np.exp(-0.5 * (((y - 25) / 25) ** 2 + ((z - 45) / 25) ** 2 + (x / 30) ** 2))

    k, j, i = np.indices(t1.array.shape)
    ras = np.stack([i, j, k], -1) @ t1.ijk_to_ras[:3, :3].T + t1.ijk_to_ras[:3, 3]
    back = np.linalg.inv(found.atlas.patient_to_atlas) if found.atlas else np.eye(4)
    direction = back[:3, 0] / np.linalg.norm(back[:3, 0])

    def source(points: np.ndarray) -> np.ndarray:
        """Where what is at points came from, by fixed-point iteration of p = s + bend(s)."""
        start = points.copy()
        for _ in range(8):
            start = points - bend(head.to_atlas(start.reshape(-1, 3)).reshape(start.shape))[..., None] * direction
        return start

    index = source(ras) @ t1.ras_to_ijk[:3, :3].T + t1.ras_to_ijk[:3, 3]
    index = np.moveaxis(index[..., ::-1], -1, 0)
    image = t1.with_array(ndimage.map_coordinates(t1.array.astype(np.float32), index, order=1))
    mask = ndimage.map_coordinates(found.brain.mask.array.astype(np.float32), index, order=1) > 0.5
    again = segment_mri(image, contrast="t1gd", mask=t1.with_array(mask.astype(np.uint8)), thin_sulci=False)
    bent = Head.of(image, again, "t1gd")
    here = falx(bent)
    flat = bent.to_atlas(here.place) * [0, 1, 1]
    sheets = {
        "with contrast": here, "without using it": falx(bent, use_intensity=False),
        "x = 0 of the atlas": moved(here, bent.from_atlas(flat)),
    }  # fmt: skip
    truth = truth + bend(head.to_atlas(truth))[:, None] * direction
    much = bend(head.to_atlas(truth)) > 3.0
    print(f"midline shift: {len(truth)} places, {much.mean():.0%} of them moved by more than 3 mm")
    sheet_errors("falx, shifted", bent, truth, sheets)


def colin(arguments) -> None:
    mri = Volume.read(COLIN27 / "ch2.nii.gz")
    found = segmented(arguments, "colin27", mri)
    sheets = timed("Colin27", mri, found, "t1")
    head = Head.of(mri, found, "t1")
    coverage("Colin27", head, sheets.surfels.of_kind("sulcus", "falx", "tentorium"))
    drawn = Volume.read(COLIN27 / "aal.nii.gz")
    tentorium = sheets.surfels.of_kind("tentorium")
    for label, up in (("found", 0), ("3 mm higher", 3), ("3 mm lower", -3)):
        sides = []
        for labels, sign in ((range(91, 109), -1), ((39, 40, 43, 44, 47, 48, 55, 56), 1)):
            points = np.argwhere(np.isin(drawn.array, list(labels)))[:, ::-1] @ drawn.ijk_to_ras[:3, :3].T
            points += drawn.ijk_to_ras[:3, 3] - np.array([0, 0, up])
            away, nearest = KDTree(tentorium.place).query(points)
            normal = tentorium.normal[nearest] * np.sign(tentorium.normal[nearest][:, 2:])
            side = ((points - tentorium.place[nearest]) * normal).sum(axis=1)[away < 8]
            sides.append((sign * side > 0).mean())
        print(
            f"AAL within 8 mm of the tentorium {label}: cerebellum below {sides[0]:.1%}, cerebrum above {sides[1]:.1%}"
        )
    callosum = sheets.structures.array == 1 + list(STRUCTURES).index("corpus callosum")
    jhu = Volume.read(COLIN27 / "JHU-WhiteMatter-labels-1mm.nii.gz")
    k, j, i = np.nonzero(callosum | (mri.array >= 0))
    ras = np.stack([i, j, k], -1) @ mri.ijk_to_ras[:3, :3].T + mri.ijk_to_ras[:3, 3]
    for label, up in (("found", 0.0), ("5 mm higher", 5.0)):
        index = (ras - [0, 0, up]) @ jhu.ras_to_ijk[:3, :3].T + jhu.ras_to_ijk[:3, 3]
        truth = (
            ndimage.map_coordinates(np.isin(jhu.array, (3, 4, 5)).astype(np.float32), index[:, ::-1].T, order=0) > 0.5
        )
        truth &= np.abs(ras[:, 0]) < 15
        mine = callosum.ravel()
        print(
            f"corpus callosum against JHU's {label}: Dice {2 * (mine & truth).sum() / (mine.sum() + truth.sum()):.2f}"
        )


def other(file: Path, contrast: str) -> None:
    """Another head: its visible CSF, and with contrast agent its falx and tentorium."""
    mri = Volume.read(file)
    found = segment_mri(mri, contrast=contrast, thin_sulci=False)
    sheets = timed(file.name, mri, found, contrast)
    head = Head.of(mri, found, contrast)
    coverage(file.name, head, sheets.surfels.of_kind("sulcus", "falx", "tentorium"))
    if head.is_enhanced:
        dura(head, sheets.surfels)


def mni(arguments) -> None:
    mri = demo_mri()[0]
    found = segment_mri(mri, thin_sulci=False)
    sheets = timed("MNI152", mri, found, "t1")
    head = Head.of(mri, found, "t1")
    coverage("MNI152", head, sheets.surfels.of_kind("sulcus", "falx", "tentorium"))
    here = sheets.surfels.of_kind("falx")
    x = np.abs(here.place[:, 0])
    print(f"falx of the symmetric template: |x| median {np.median(x):.2f} mm, largest {x.max():.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("what", nargs="*", default=["remind022", "turned", "shifted", "colin27", "mni152"])
    parser.add_argument("--keep", type=Path, help="folder for brain masks")
    arguments = parser.parse_args()
    steps = {"remind022": remind, "turned": turned, "shifted": shifted, "colin27": colin, "mni152": mni}
    for name in arguments.what:
        if "=" in name:
            file, contrast = name.split("=")
            other(Path(file), contrast)
            continue
        is_there = {"colin27": (COLIN27 / "ch2.nii.gz").exists(), "mni152": True}.get(
            name, (SHARED / "remind022").is_dir()
        )
        if is_there:
            steps[name](arguments)


if __name__ == "__main__":
    main()
