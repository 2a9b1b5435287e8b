"""Lesions proposed from an MRI: grown from a point, refused with a reason, never applied, never replacing edits."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import ndimage

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Command.seeds import split_seeds, write_proposals
from SlicerUSSim.Logic import Segmentation, SimulationError, Volume, grow_lesion, segment_mri
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.lesions.growth import grow
from SlicerUSSim.Logic.mri.lesions.proposal import Proposal
from SlicerUSSim.Logic.tissue.presets import TISSUES
from validation.brain_phantoms import (
    phantom,
    tissue_maps,
    with_low_grade_tumour,
    with_ring_tumour,
)

needs_atlas = pytest.mark.skipif(mni152() is None, reason="the atlas comes with nilearn")
CENTRE = (28.0, -22.0, 28.0)


def dice(a: np.ndarray, b: np.ndarray) -> float:
    return 2 * float((a & b).sum()) / float(a.sum() + b.sum())


# ---- the region of a likeness ----------------------------------------------------------------------------------------


def ball_in(size: int, centre, radius: float) -> np.ndarray:
    grid = np.indices((size,) * 3)
    return np.sqrt(sum((axis - place) ** 2 for axis, place in zip(grid, centre, strict=True))) < radius


def test_a_region_ends_at_the_sharpest_border_in_noise():
    true = ball_in(50, (25, 25, 25), 9.0)
    likeness = true + np.random.default_rng(0).normal(0.0, 0.25, true.shape).astype(np.float32)
    region = grow(likeness, np.ones_like(true), np.array([25, 20, 27]), np.ones(3), largest_mm=22.0)
    assert region is not None and dice(region.inside, true) > 0.93
    assert region.radius_mm == pytest.approx(9.0, abs=1.5)


def test_what_hangs_on_a_region_by_a_thin_bridge_stays_out():
    true = ball_in(50, (25, 17, 25), 8.0)
    other = ball_in(50, (25, 38, 25), 7.0)
    bridge = np.zeros_like(true)
    bridge[24:27, 17:38, 24:27] = True
    likeness = (true | other | bridge).astype(np.float32)
    region = grow(likeness, np.ones_like(true), np.array([25, 17, 25]), np.ones(3), largest_mm=24.0)
    assert region is not None and (region.inside & other).sum() == 0 and dice(region.inside, true) > 0.9


def test_the_radius_of_a_region_ends_at_its_own_border():
    sheet = np.zeros((40, 40, 40), bool)
    sheet[8:32, 19:22, 8:32] = True
    region = grow(sheet.astype(np.float32), np.ones_like(sheet), np.array([20, 20, 20]), np.ones(3), largest_mm=24.0)
    assert region is not None and region.radius_mm < 3.0


def test_a_region_stays_where_it_is_allowed_and_within_reach():
    likeness = ball_in(50, (25, 25, 25), 9.0).astype(np.float32)
    allowed = np.ones(likeness.shape, bool)
    allowed[:, :, 26:] = False
    region = grow(likeness, allowed, np.array([25, 25, 22]), np.ones(3), largest_mm=22.0)
    assert region is not None and not region.inside[:, :, 26:].any()
    assert grow(np.ones_like(likeness), allowed, np.array([25, 25, 22]), np.ones(3), largest_mm=15.0) is None


# ---- brains ----------------------------------------------------------------------------------------------------------


@cache
def brain(kind: str) -> tuple[Segmentation, np.ndarray]:
    """(segmentation, (k, j, i) bool of the lesion) of an MNI152 phantom of 2 mm."""
    maps = tissue_maps("mni152")
    assert maps is not None
    maps = maps.coarser(2)
    if kind == "ring":
        maps, contrast, parts = with_ring_tumour(maps, CENTRE, 12.0), "t1gd", (3, 4)
    elif kind == "low":
        maps, contrast, parts = with_low_grade_tumour(maps, CENTRE, 14.0), "flair", (5,)
    else:
        contrast, parts = "t1", ()
    image = phantom(maps, contrast, noise=0.03, bias=0.0)
    true = sum((maps.shares[part] for part in parts), np.zeros(maps.mask.shape)) > 0.5
    return segment_mri(image.mri, contrast=contrast, mask=image.mask, thin_sulci=False), true


def core(proposal: Proposal) -> np.ndarray:
    return np.isin(proposal.labels.array, [n for n, name in enumerate(proposal.tissues, 1) if name != "oedema"])


@needs_atlas
@pytest.mark.parametrize("kind", ["low", pytest.param("ring", marks=pytest.mark.slow)])
def test_one_seed_grows_the_lesion_and_not_what_is_outside(kind):
    segmentation, true = brain(kind)
    before = segmentation.labels.array.copy()
    proposal = grow_lesion(segmentation, CENTRE)
    assert dice(core(proposal), true) >= 0.75
    assert 0.6 < core(proposal).sum() / true.sum() < 1.4
    assert np.linalg.norm(proposal.centre_ras_mm - CENTRE) < 4.0
    assert (segmentation.labels.array == before).all()
    assert "proposed, not applied" in proposal.message
    assert set(proposal.tissues) <= set(TISSUES)
    assert ("necrosis" in proposal.tissues) == (kind == "ring")


@needs_atlas
@pytest.mark.long
def test_a_point_in_a_ventricle_beside_what_enhances_is_refused():
    """A seed in a cistern does not give the veins beside it as a tumour."""
    maps = tissue_maps("mni152")
    assert maps is not None
    centre = (18.0, 8.0, 18.0)  # beside the frontal horn
    maps = with_ring_tumour(maps, centre, 9.0).coarser(2)
    image = phantom(maps, "t1gd", noise=0.03, bias=0.0)
    segmentation = segment_mri(image.mri, contrast="t1gd", mask=image.mask, thin_sulci=False)
    assert "necrosis" in grow_lesion(segmentation, centre).tissues
    apart = np.asarray(ndimage.distance_transform_edt(maps.shares[3] + maps.shares[4] < 0.5, sampling=2.0))
    fluid = np.where((apart > 2.5) & (apart < 5.0), ndimage.uniform_filter(maps.shares[0], 3), 0.0)
    beside = np.unravel_index(np.argmax(fluid), fluid.shape)[::-1] @ maps.ijk_to_ras[:3, :3].T + maps.ijk_to_ras[:3, 3]
    assert fluid.max() > 0.8
    with pytest.raises(SimulationError, match="fluid that looks like CSF"):
        grow_lesion(segmentation, beside)


@pytest.mark.slow
@needs_atlas
@pytest.mark.parametrize(
    ("seed", "words"),
    [
        ((28.0, -22.0, 28.0), "white matter that looks healthy"),
        ((0.0, 0.0, -70.0), "mm outside the brain"),
        ((4.0, 8.0, 16.0), "fluid that looks like CSF"),
        ((float("nan"), 0.0, 0.0), "three finite numbers"),
    ],
)
def test_a_seed_in_no_lesion_says_what_is_there(seed, words):
    with pytest.raises(SimulationError, match=words) as error:
        grow_lesion(brain("healthy")[0], seed)
    assert "\n" not in str(error.value)


@pytest.mark.slow
@needs_atlas
def test_a_tissue_that_the_user_names_is_taken_at_his_word():
    segmentation, _ = brain("healthy")
    cavity = grow_lesion(segmentation, (4.0, 8.0, 16.0), "cavity")  # a ventricle, called so by the user
    assert cavity.tissues == ("cavity",) and cavity.volume_ml() > 0.5
    with pytest.raises(SimulationError, match="tissue"):
        grow_lesion(segmentation, CENTRE, "tumuor of sorts")


def test_proposals_are_files_and_earlier_ones_are_named(tmp_path, capsys):
    true = ball_in(20, (10, 10, 10), 6.0)
    part = Volume(true.astype(np.uint8), np.diag([2.0, 2.0, 2.0, 1.0]))
    proposals = (Proposal(part, ("tumour",), "bright in T2", np.array([20.0, 20.0, 20.0])),)
    labels, mask = tmp_path / "labels.nii.gz", tmp_path / "labels_proposed_tumour.nii.gz"
    write_proposals(proposals, labels)
    told = capsys.readouterr().err
    assert "proposed, not applied" in told and f"--add tumour={mask}" in told
    assert (Volume.read(mask).array == true).all()
    write_proposals((), labels)
    assert f"{mask} of an earlier run stays" in capsys.readouterr().err


@needs_atlas
@pytest.mark.long
def test_a_lesion_grows_also_under_a_name_that_fits_its_look():
    ring, _ = brain("ring")
    rim = (CENTRE[0] + 13.0, *CENTRE[1:])
    free = grow_lesion(ring, rim)
    for name in ("tumour", "enhancing", "haematoma"):
        named = grow_lesion(ring, rim, name)
        assert named.tissues == (name,) and dice(core(named), core(free)) > 0.95
    with pytest.raises(SimulationError, match=r"in what enhances \([0-9.]+ ml\), and cyst does not: expected a point"):
        grow_lesion(ring, (CENTRE[0] + 15.0, *CENTRE[1:]), "cyst")
    oedema = grow_lesion(ring, (CENTRE[0] + 15.0, *CENTRE[1:]), "oedema")  # around it
    assert oedema.tissues == ("oedema",) and oedema.volume_ml() > 20
    assert not (oedema.labels.array[core(free)] > 0).mean() > 0.1
    necrosis = grow_lesion(ring, CENTRE, "necrosis")  # within the rim, and not with it
    assert necrosis.tissues == ("necrosis",)
    assert dice(necrosis.labels.array > 0, free.mask("necrosis").array > 0) > 0.6
    low, _ = brain("low")
    free = grow_lesion(low, CENTRE)
    for name in ("oedema", "haematoma", "cyst"):
        named = grow_lesion(low, CENTRE, name)
        assert named.tissues == (name,) and dice(named.labels.array > 0, core(free)) > 0.95
    with pytest.raises(SimulationError, match="an MRI without contrast agent, in which nothing is enhancing"):
        grow_lesion(low, CENTRE, "enhancing")
    with pytest.raises(SimulationError, match=r"fluid .*, and tumour is none: .*say what it is: a cyst"):
        grow_lesion(brain("healthy")[0], (4.0, 8.0, 16.0), "tumour")


@pytest.mark.parametrize("name", ["liver", "brats"])
def test_only_lesions_are_grown(name):
    with pytest.raises(SimulationError, match="expected a lesion: tumour, oedema, necrosis, cyst") as error:
        split_seeds([f"1,2,3={name}"])
    assert f"--seed 1,2,3={name}: " in str(error.value) and "\n" not in str(error.value)


@needs_atlas
@pytest.mark.long
def test_a_refused_seed_costs_neither_the_labels_nor_the_other_seeds(tmp_path):
    maps = tissue_maps("mni152")
    assert maps is not None
    image = phantom(with_low_grade_tumour(maps, CENTRE, 14.0).coarser(2), "flair", noise=0.03, bias=0.0)
    mri, mask, labels = (tmp_path / f"{name}.nii.gz" for name in ("mri", "mask", "labels"))
    image.mri.write(mri)
    image.mask.write(mask)

    def segment(*options: str):
        command = ["segment", mri, "--contrast", "flair", "--mask", mask, "-o", labels, "--overwrite", *options]
        return CliRunner().invoke(main, [str(part) for part in command])

    proposal = tmp_path / "labels_proposed_tumour.nii.gz"
    result = segment("--seed", "-12,-20,8", "--seed", "28,-22,28")
    assert result.exit_code == 2 and "looks healthy" in result.stderr, result.output
    assert result.stderr.splitlines()[-1].endswith(f"{labels} is written, with all that was not refused")
    assert labels.exists() and proposal.exists()
    result = segment("--seed", "28,-22,28=oedema")
    assert result.exit_code == 0 and f"{proposal} of an earlier run stays" in result.stderr


@pytest.mark.parametrize("text", ["1,2", "1,2,x", "1,2,3="])
def test_a_seed_that_is_no_point_is_refused_with_an_example(text):
    with pytest.raises(SimulationError, match=r"--seed is .*expected R,A,S in mm"):
        split_seeds([text])
    assert split_seeds(["1,-2.5,3=Edema"]) == [((1.0, -2.5, 3.0), "oedema")]


def test_seeds_are_points_of_a_file_of_slicer(tmp_path):
    path = tmp_path / "points.mrk.json"

    def write(kind: str, *points: tuple[float, float, float], status: str = "defined") -> str:
        placed = [{"position": list(point), "positionStatus": status} for point in points]
        path.write_text(
            json.dumps({"markups": [{"type": kind, "coordinateSystem": "LPS", "controlPoints": placed}]}),
        )
        return str(path)

    text = write("Fiducial", (-1.0, 2.5, 3.0), (4.0, 5.0, 6.0))
    assert split_seeds([text]) == [((1.0, -2.5, 3.0), None), ((-4.0, -5.0, 6.0), None)]
    assert split_seeds([f"{text}=Edema"])[1] == ((-4.0, -5.0, 6.0), "oedema")
    with pytest.raises(SimulationError, match=r"points\.mrk\.json: is a markup of type 'Line', expected"):
        split_seeds([write("Line", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))])
    with pytest.raises(SimulationError, match=r"points\.mrk\.json: has no point that was placed"):
        split_seeds([write("Fiducial", (0.0, 0.0, 0.0), status="undefined")])
    with pytest.raises(SimulationError, match=r"none\.mrk\.json: cannot be read \(No such file"):
        split_seeds([str(tmp_path / "none.mrk.json")])


@pytest.mark.parametrize(("named", "sign"), [("LPS", -1.0), ("0", 1.0)])
def test_seeds_are_points_of_a_list_of_slicer_before_5(named, sign, tmp_path):
    """The frame by its name, or as 4.10 numbered them; a label may have a comma, in quotes."""
    path = tmp_path / "F.fcsv"
    head = f"# Markups fiducial file version = 4.11\n# CoordinateSystem = {named}\n"
    columns = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    rows = '1,-1.5,2.5,3,0,0,0,1,1,1,0,"F-1, rim",,\n2,4,5,6.25,0,0,0,1,1,1,0,F-2,,vtkMRMLScalarVolumeNode1\n'
    path.write_text(head + columns + rows)
    assert split_seeds([str(path)]) == [((-1.5 * sign, 2.5 * sign, 3.0), None), ((4.0 * sign, 5.0 * sign, 6.25), None)]
    path.write_text(head)
    with pytest.raises(SimulationError, match=r"F\.fcsv: has no point that was placed"):
        split_seeds([str(path)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3,4\n", "names no CoordinateSystem"),
        ("# CoordinateSystem = IJK\n1,2,3,4\n", "CoordinateSystem is 'IJK', expected one of RAS, LPS, 0, 1"),
        ("# CoordinateSystem = RAS\n1,2,3\n", "has a row without x, y and z"),
        ("# CoordinateSystem = RAS\n1,2,nan,3\n", "has a point that is not finite"),
        ("\xff\xff", "is no text"),
    ],
)
def test_a_list_of_points_that_is_none_is_refused(text, message, tmp_path):
    (tmp_path / "F.fcsv").write_bytes(text.encode("latin-1"))
    with pytest.raises(SimulationError, match=message):
        split_seeds([str(tmp_path / "F.fcsv=oedema")])
