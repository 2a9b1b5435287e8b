"""The falx in a part of a brain, which no atlas leads, and lesions beside it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import Segmentation, SimulationError, Volume, segment_mri
from SlicerUSSim.Logic.mri.lesions.seeded import grow_lesion
from SlicerUSSim.Logic.mri.sheets import find_sheets
from SlicerUSSim.Logic.mri.sheets.falx_of_part import falx_of_part
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.sulcal import sulci
from SlicerUSSim.Logic.tissue import Surfels
from validation.brain_phantoms import COLIN27, cut_to, part_box

FLUID, GREY, WHITE, NOISE = 20.0, 100.0, 140.0, 4.0
#: Top of the corpus callosum and of the brain, and the deep end of other sulci, S mm
CALLOSUM, TOP, OTHER = 17.0, 62.0, 42.0


def midline(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """R mm of the fissure between the hemispheres: bent, and oblique to the slab."""
    return 2.0 * np.sin(z / 15.0) + 0.2 * y


def slab(has_fissure: bool = True, tumour: bool = False) -> tuple[Volume, np.ndarray]:
    """(image of a coronal slab of 14 mm in voxels of 1 mm, brain (k, j, i) bool): a fissure and sulci in cortex.

    The tumour, as dark as grey matter, lies at the right of the fissure and closes a part of it.
    """
    z, y, x = (axis.astype(float) for axis in np.indices((110, 14, 90)))
    z, y, x = z - 42.0, y - 7.0, x - 45.0
    brain = np.asarray(np.hypot(x / 42.0, (z - 10.0) / (TOP - 10.0)) < 1.0)
    depth = np.asarray(ndimage.distance_transform_edt(brain))
    banks = [np.where(z > OTHER, np.abs(x - side), 99.0) for side in (-22.0, -12.0, 14.0, 24.0)]
    if has_fissure:
        banks.append(np.where(z > CALLOSUM, np.abs(x - midline(y, z)), 99.0))
    near = np.minimum.reduce(banks)
    is_grey = (near < 3.2) | (depth < 3.0)
    if tumour:
        is_grey |= np.hypot(x - midline(y, z) - 9.5, z - 36.0) < 8.5
        # Grey matter at the other side, as far from the fissure as the tumour
        is_grey |= (np.abs(x - midline(y, z) + 5.0) < 5.0) & (np.abs(z - 36.0) < 10.0)
    image = np.where(is_grey, GREY, WHITE)
    share = np.clip(0.6 - near + 0.5, 0.0, 1.0)
    if tumour:  # it closes the fissure
        share = np.where((np.abs(z - 36.0) < 3.5) & (np.abs(x - midline(y, z)) < 5.0), 0.0, share)
    image = np.where(brain, image * (1.0 - share) + FLUID * share, 0.0)
    image += np.where(brain, np.random.default_rng(3).normal(0.0, NOISE, image.shape), 0.0)
    matrix = np.eye(4)
    matrix[:3, 3] = [-45.0, -7.0, -42.0]
    return Volume(image.astype(np.float32), matrix), brain


def falx_in(image: Volume, brain: np.ndarray) -> Surfels:
    head = Head.of_part(image, brain, (FLUID, GREY, WHITE), NOISE, is_enhanced=False)
    return falx_of_part(head, sulci(head, np.zeros(head.brain.shape, bool)))


def test_the_falx_is_the_deepest_straight_sulcus_down_to_its_free_edge():
    found = falx_in(*slab())
    x, y, z = found.place.T
    assert np.percentile(np.abs(x - midline(y, z)), 90) < 1.0
    assert np.abs(found.normal[:, 0]).min() > 0.9
    # From the hull to some millimetres above the callosum, everywhere in the slab and without holes
    assert z.max() > TOP - 5.0 and CALLOSUM + 3.0 < z.min() < CALLOSUM + 9.0
    truth_y, truth_z = np.meshgrid(np.arange(-5.0, 5.0), np.arange(CALLOSUM + 9.0, TOP - 6.0))
    truth = np.stack([midline(truth_y, truth_z), truth_y, truth_z], axis=-1).reshape(-1, 3)
    assert KDTree(found.place).query(truth)[0].max() < 2.0
    assert found.kinds() == ("falx",)


def test_sulci_of_one_hemisphere_are_no_falx():
    assert len(falx_in(*slab(has_fissure=False))) == 0
    empty = Volume(np.full((20, 20, 20), WHITE, np.float32), np.eye(4))
    assert len(falx_in(empty, np.ones((20, 20, 20), bool))) == 0


@pytest.mark.parametrize(
    ("axis", "degrees", "is_falx"),
    [("y", 10.0, True), ("z", 90.0, False), ("y", 40.0, False), ("y", 180.0, False)],
    ids=["rolled", "across front and back", "as steep as the tentorium", "from below, as cisterns"],
)
def test_a_plane_that_does_not_divide_left_from_right_is_no_falx(axis, degrees, is_falx):
    image, brain = slab()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    assert (len(falx_in(Volume(image.array, turn @ image.ijk_to_ras), brain)) > 100) == is_falx


def test_images_that_are_too_thin_are_refused():
    image, brain = slab()
    with pytest.raises(SimulationError, match="2 voxels of 1 mm thick, expected at least 3"):
        falx_in(Volume(np.ascontiguousarray(image.array[:, :2]), image.ijk_to_ras), brain[:, :2])


def test_find_sheets_has_the_falx_of_a_part_and_not_twice():
    image, brain = slab()
    mask = image.with_array(brain.astype(np.uint8))
    segmentation = segment_mri(image, mask=mask, thin_sulci=False)
    assert segmentation.atlas is None
    found = find_sheets(image, segmentation, contrast="t1", kinds=("sulcus", "falx"))
    falx, others = found.surfels.of_kind("falx"), found.surfels.of_kind("sulcus")
    assert len(falx) > 300 and len(others) > 300
    x, y, z = others.place.T
    beside = (np.abs(x - midline(y, z)) < 1.5) & (z > CALLOSUM + 9.0) & (z < TOP - 8.0)
    assert beside.mean() < 0.02
    assert any(line.startswith("falx: ") and "without an atlas" in line for line in found.notes)


def test_a_seed_does_not_grow_across_the_fissure():
    image, brain = slab(tumour=True)
    mask = image.with_array(brain.astype(np.uint8))
    proposal = grow_lesion(
        segment_mri(image, mask=mask, bias_correction=False, thin_sulci=False), (10.0, 0.0, 36.0), "tumour"
    )
    inside = proposal.labels.array > 0
    ras = np.argwhere(inside)[:, ::-1] + image.ijk_to_ras[:3, 3]
    across = ras[:, 0] < midline(ras[:, 1], ras[:, 2]) - 1.5
    assert inside.sum() > 2000 and across.mean() < 0.01


@cache
def colin27() -> tuple[Volume, Segmentation]:
    if not (COLIN27 / "ch2bet.nii.gz").exists():
        pytest.skip("mricron-data is not installed")
    mri = Volume.read(COLIN27 / "ch2bet.nii.gz")
    return mri, segment_mri(mri, thin_sulci=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "is_there"),
    [
        (((0.2, 1.0), (0.5, 1.0), (0.5, 1.0)), True),  # of the brain's extent along R, A and S
        (((0.0, 0.38), (0.3, 0.7), (0.0, 0.6)), False),
    ],
    ids=["quarter", "left temporal lobe"],
)
def test_the_falx_of_a_part_is_that_of_the_whole_head(part, is_there):
    """Control: the falx by the atlas; and parts that have none."""
    mri, whole = colin27()
    mask = whole.brain.mask
    box = part_box(mask, part)
    image, inside = cut_to(mri, box), cut_to(mask, box)
    segmentation = segment_mri(image, mask=inside, thin_sulci=False)
    assert segmentation.atlas is None
    found = find_sheets(image, segmentation, contrast="t1", kinds=("falx",)).surfels
    assert (len(found) > 0) == is_there
    if is_there:
        truth = find_sheets(mri, whole, contrast="t1", kinds=("falx",)).surfels
        away, _ = KDTree(truth.place).query(found.place)
        assert np.median(away) < 1.2 and (away < 5.0).mean() > 0.7
