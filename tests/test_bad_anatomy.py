"""Bad input for anatomy, at every door: seeds in no lesion, craniotomies off the head, CTs in other units, MRIs as CT.

The page has the same presenter as the panel; tests/test_workstation.py has some of these there.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Command.cli import main  # noqa: E402
from SlicerUSSim.Logic import SimulationError, Volume, segment_ct, segment_mri  # noqa: E402
from SlicerUSSim.Logic.mri.craniotomy import disc_opening, file_opening, opened  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import write_volume  # noqa: E402
from SlicerUSSim.Logic.probe.placement import pose_looking_at  # noqa: E402
from SlicerUSSim.Logic.tissue.own_files import write_label_files  # noqa: E402
from SlicerUSSim.Logic.tissue.table import TissueTable  # noqa: E402
from tests.conftest import coarse_chest  # noqa: E402
from tests.test_craniotomy import NAMES, head  # noqa: E402, F401
from tests.test_craniotomy_nodes import TURN, Bench  # noqa: E402
from tests.test_lesion_nodes import Scene  # noqa: E402
from tests.test_lesion_proposals import needs_atlas  # noqa: E402
from validation.brain_phantoms import phantom, tissue_maps  # noqa: E402


def refused(*arguments: object) -> str:
    """The one line with which the command refuses arguments."""
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code == 2, done.output
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("ussim: ")]
    assert "Traceback" not in done.output
    return line


# ---- seeds -----------------------------------------------------------------------------------------------------------


@needs_atlas
@pytest.mark.slow
def test_the_command_refuses_seeds_outside_the_brain_and_in_csf_and_writes_the_labels_alone(tmp_path):
    maps = tissue_maps("mni152")
    assert maps is not None
    image = phantom(maps.coarser(2), "t1", noise=0.03, bias=0.0)
    image.mri.write(tmp_path / "t1.nii.gz")
    image.mask.write(tmp_path / "mask.nii.gz")
    line = refused(
        "segment", tmp_path / "t1.nii.gz", "--mask", tmp_path / "mask.nii.gz", "--seed", "0,0,-70", "--seed", "4,8,16",
        "-o", tmp_path / "labels.nii.gz",
    )  # fmt: skip
    assert "mm outside the brain" in line and "fluid that looks like CSF" in line
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == ["labels.json", "labels.nii.gz", "mask.nii.gz", "t1.nii.gz"]


# ---- craniotomies ----------------------------------------------------------------------------------------------------

AWAY = pose_looking_at((300.0, 0.0, 0.0), (300.0, 100.0, 0.0))


def far_mask(labels: Volume) -> Volume:
    """Of voxels 400 mm beside the head."""
    matrix = labels.ijk_to_ras.copy()
    matrix[0, 3] += 400.0
    return Volume(np.ones((5, 5, 5), np.uint8), matrix)


def far_curve(path: Path) -> Path:
    points = [{"position": [x + 400.0, y, 78.0]} for x, y in ((-20, -20), (20, -20), (20, 20), (-20, 20))]
    markup = {"type": "ClosedCurve", "coordinateSystem": "RAS", "coordinateUnits": "mm", "controlPoints": points}
    path.write_text(json.dumps({"markups": [markup]}))
    return path


@pytest.mark.parametrize("what", ["disc", "mask", "curve"])
def test_a_craniotomy_off_the_head_is_one_line_at_every_door(head, tmp_path, what):  # noqa: F811
    words = "is empty, or lies outside of the patient" if what == "mask" else "there is no brain under the craniotomy"
    path, pose = tmp_path / "head.nii.gz", tmp_path / "pose.json"
    write_label_files(path, head, TissueTable.brain().for_names(NAMES))
    pose.write_text(json.dumps(AWAY.tolist()))
    given: object = "disc:30"
    if what == "mask":
        far_mask(head).write(given := tmp_path / "mask.nii.gz")
    elif what == "curve":
        given = far_curve(tmp_path / "curve.mrk.json")
    assert words in refused("simulate", path, "--pose", pose, "--craniotomy", given, "-o", tmp_path / "o.png")
    assert not (tmp_path / "o.png").exists()

    with pytest.raises(SimulationError, match=words) as error:
        is_disc = what == "disc"
        opened(head, NAMES, disc_opening(head, NAMES, AWAY, 30.0) if is_disc else file_opening(head, NAMES, str(given)))
    assert "\n" not in str(error.value)

    bench = Bench(head)
    bench.move(AWAY)
    if what == "mask":
        bench.logic.parameters.opening = node = bench.add("LabelMapVolume", "mask")
        write_labels(node, far_mask(head), ("opening",), bench.whole)
    elif what == "curve":
        bench.logic.parameters.opening = node = bench.add("MarkupsClosedCurve", "curve")
        for x, y in ((-20, -20), (20, -20), (20, 20), (-20, 20)):
            node.AddControlPointWorld(*(TURN @ [x + 400.0, y, 78.0, 1.0])[:3])
    bench.presenter.openCraniotomy()
    (line,) = bench.view.errors
    assert words in line and "\n" not in line and bench.labels is bench.whole


# ---- CT --------------------------------------------------------------------------------------------------------------


def wrong_image(what: str) -> tuple[Volume, str]:
    """(image, contrast as which it is given)"""
    ct = coarse_chest().ct
    values = ct.array.astype(np.float32)
    if what == "a CT in 8 bits":
        return ct.with_array(np.clip((values + 1000.0) / 8.0, 0, 255).astype(np.uint8)), "ct"
    if what == "a CT in 1/mm":
        return ct.with_array((0.02 * (1.0 + values / 1000.0)).astype(np.float32)), "ct"
    if what == "a CT 5000 too high":
        return ct.with_array(values + np.float32(5000.0)), "ct"
    return (head_mri(3.0), "ct") if what == "an MRI called CT" else (ct, "t1")


@pytest.mark.parametrize(
    "what",
    [
        "a CT in 8 bits",
        pytest.param("a CT in 1/mm", marks=pytest.mark.slow),
        pytest.param("a CT 5000 too high", marks=pytest.mark.slow),
        "an MRI called CT",
        "a CT called MRI",
    ],
)
def test_a_ct_in_another_unit_and_an_mri_called_ct_are_one_line_at_every_door(tmp_path, what):
    image, contrast = wrong_image(what)
    words = "expected Hounsfield units (air -1000, water 0, bone 1000)" if contrast == "ct" else "as CT has (Hounsfield"
    remedy = "for an MRI leave --ct out and choose its contrast" if contrast == "ct" else "segment a CT with --ct"
    path = tmp_path / "image.nii.gz"
    image.write(path)
    line = refused("segment", path, "--contrast", contrast, "-o", tmp_path / "labels.nii.gz")
    assert words in line and remedy in line
    with pytest.raises(SimulationError) as error:
        segment_ct(image) if contrast == "ct" else segment_mri(image)
    assert words in str(error.value) and "\n" not in str(error.value)
    bench = Scene("LabelMapVolume")
    write_volume(bench.mri, image)
    presenter = bench.presenter(label_maps=True)
    presenter.setValue("scene.contrast", contrast)
    presenter.segment()
    (line,) = presenter.view.errors
    assert words in line and remedy in line and bench.logic.parameters.labels is None
