"""Lesions grown from a point: in two versions, beside the labels, never replacing what a user made."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Command.seeds import split_seeds
from SlicerUSSim.Logic import Segmentation, SimulationError, Volume, grow_lesion, segment_mri
from validation.brain_phantoms import phantom, tissue_maps, with_low_grade_tumour, with_ring_tumour

from .shared_data import SHARED

CENTRE = (28.0, -22.0, 28.0)


def dice(lesion, true: np.ndarray) -> float:
    found = lesion.labels.array > 0
    return 2 * float((found & true).sum()) / float(found.sum() + true.sum())


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


@pytest.mark.parametrize("kind", ["low", pytest.param("ring", marks=pytest.mark.slow)])
@pytest.mark.parametrize("aside_mm", [0.0, 9.0])
def test_one_seed_grows_the_lesion_and_a_larger_version(kind, aside_mm):
    segmentation, true = brain(kind)
    before = segmentation.labels.array.copy()
    lesion = grow_lesion(segmentation, (CENTRE[0] - aside_mm, *CENTRE[1:]))
    assert lesion.larger is not None and dice(lesion, true) >= 0.8 and dice(lesion.larger, true) >= 0.7
    assert not ((lesion.labels.array > 0) & (lesion.larger.labels.array == 0)).any()
    assert lesion.larger.volume_ml() > 1.02 * lesion.volume_ml()
    assert np.linalg.norm(lesion.centre_ras_mm - CENTRE) < 4.0
    assert (segmentation.labels.array == before).all()
    assert lesion.tissues == (("tumour", "necrosis") if kind == "ring" else ("tumour",))
    assert any("state which" in line for line in lesion.warnings) == (kind == "low")


@pytest.mark.long
@pytest.mark.skipif(not (SHARED / "clinical_t1gd").is_dir(), reason="clinical_t1gd is not here")
def test_a_tumour_in_thick_slices_grows_from_its_ends_too():
    """From its innermost voxel 5.2 of 16.4 ml were grown."""
    mri, true = (Volume.read(SHARED / "clinical_t1gd" / f"brain1_{name}.nrrd") for name in ("image", "label"))
    segmentation = segment_mri(mri, contrast="t1gd", thin_sulci=False)
    for seed in ((-41.0, -23.8, 26.0), (-39.5, -22.3, 26.0), (-55.9, -21.5, 6.5)):
        lesion = grow_lesion(segmentation, seed)
        assert lesion.larger is not None
        assert max(dice(lesion, true.array > 0), dice(lesion.larger, true.array > 0)) >= 0.65


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "words"),
    [
        ((28.0, -22.0, 28.0), "looks like its surroundings, .* expected a point in a lesion that stands out"),
        ((0.0, 0.0, -70.0), "mm outside the brain"),
        ((float("nan"), 0.0, 0.0), "three finite numbers"),
    ],
)
def test_a_seed_from_which_nothing_grows_says_why(seed, words):
    with pytest.raises(SimulationError, match=words) as error:
        grow_lesion(brain("healthy")[0], seed)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_user_is_taken_at_his_word_and_otherwise_warned():
    segmentation, _ = brain("healthy")
    ventricle = (4.0, 8.0, 16.0)
    cavity = grow_lesion(segmentation, ventricle, "cavity")
    assert cavity.tissues == ("cavity",) and cavity.volume_ml() > 0.5
    cyst = grow_lesion(segmentation, ventricle)
    assert cyst.tissues == ("cyst",) and "fluid looks alike in ventricles" in cyst.warnings[0]
    with pytest.raises(SimulationError, match="no tissue is called 'tumuor of sorts'"):
        grow_lesion(segmentation, CENTRE, "tumuor of sorts")


@pytest.mark.slow
def test_a_part_of_a_lesion_is_grown_by_its_name():
    ring, _ = brain("ring")
    free = grow_lesion(ring, CENTRE)
    necrosis = grow_lesion(ring, CENTRE, "necrosis")  # within the rim, and not with it
    assert necrosis.tissues == ("necrosis",) and dice(necrosis, free.mask("necrosis").array > 0) > 0.6
    oedema = grow_lesion(ring, (CENTRE[0] + 15.0, *CENTRE[1:]), "oedema")  # around it
    assert oedema.tissues == ("oedema",) and oedema.volume_ml() > 20
    assert (oedema.labels.array[free.labels.array > 0] > 0).mean() < 0.3


@pytest.mark.parametrize("name", ["liver", "brats"])
def test_only_lesions_are_grown(name):
    with pytest.raises(SimulationError, match="expected a lesion: tumour, oedema, necrosis, cyst") as error:
        split_seeds([f"1,2,3={name}"])
    assert f"--seed 1,2,3={name}: " in str(error.value) and "\n" not in str(error.value)


@pytest.mark.long
def test_a_refused_seed_costs_neither_the_labels_nor_the_other_seeds(tmp_path):
    maps = tissue_maps("mni152")
    assert maps is not None
    image = phantom(with_low_grade_tumour(maps, CENTRE, 14.0).coarser(2), "flair", noise=0.03, bias=0.0)
    mri, mask, labels = (tmp_path / f"{name}.nii.gz" for name in ("mri", "mask", "labels"))
    image.mri.write(mri)
    image.mask.write(mask)

    def segment(*options: str):
        command = ["segment", mri, "--contrast", "flair", "--mask", mask, "-o", labels, *options]
        return CliRunner().invoke(main, [str(part) for part in command])

    smaller, larger = (tmp_path / f"labels_grown_tumour{version}.nii.gz" for version in ("", "_larger"))
    result = segment("--seed", "-28,-22,28", "--seed", "28,-22,28")
    assert result.exit_code == 2 and "looks like its surroundings" in result.stderr, result.output
    assert result.stderr.splitlines()[-1].endswith(f"{labels} is written, with all lesions that were not refused")
    assert f"--add tumour={smaller}; larger: {larger}" in result.stderr
    assert labels.exists() and 0 < Volume.read(smaller).array.sum() < Volume.read(larger).array.sum()
    labels.unlink()
    labels.with_name("labels.json").unlink()
    result = segment("--seed", "28,-22,28")
    assert result.exit_code == 2 and "labels_grown_tumour" in result.stderr  # they may have been corrected
    result = segment("--seed", "28,-22,28=oedema", "--overwrite")
    assert result.exit_code == 0 and f"{smaller} of an earlier run stays" in result.stderr


@pytest.mark.parametrize("text", ["1,2", "1,2,x", "1,2,3="])
def test_a_seed_that_is_not_a_point_is_refused_with_an_example(text):
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
