"""Shared media and helpers. Everything runs on the device that `ussim devices` would use."""

from __future__ import annotations

import importlib.util
import locale
import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from SlicerUSSim.Logic import (
    DisplaySettings,
    PhasedProbe,
    SimulationSettings,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_mri,
)
from SlicerUSSim.Logic.base.files import write_json
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, tilt_sweep
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from tests.remembered import segment_once
from tests.shared_data import SHARED as SHARED, needs_shared as needs_shared
from validation.ct_phantoms import CtPhantom, lower_chest

_LOCALE = locale.setlocale(locale.LC_ALL)

hypothesis.settings.register_profile("ussim", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("ussim")

#: Even speckle without attenuation, so that statistics do not change with depth; and fluids without scatterers.
SPECKLE = replace(
    TISSUES["white matter"], name="speckle", attenuation_db_cm_mhz=0.0, texture_db=0.0, specks_per_mm3=0.0
)
FLUID = Tissue("fluid", 1540.0, 1.54, 0.0)
#: A display without a scanner's look
even_display = partial(DisplaySettings, look="even")


def rigid(rotation: np.ndarray, translation) -> np.ndarray:
    """(4, 4) matrix from a rotation (3, 3) and a translation (3,) in the rotated frame."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = rotation @ np.asarray(translation, float)
    return matrix


def block(label_function, half_mm=(30, 30, 30), spacing_mm=1.0) -> Volume:
    """A label volume centred at the RAS origin; `label_function(x, y, z)` of voxel centres in millimetres."""
    counts = [int(2 * h / spacing_mm) + 1 for h in half_mm]
    axes = [(np.arange(n) - (n - 1) / 2) * spacing_mm for n in counts]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    matrix = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    matrix[:3, 3] = [a[0] for a in axes]
    return Volume(np.asarray(label_function(x, y, z) * np.ones_like(x), np.uint8), matrix)


def simulator(
    labels: Volume, *tissues: Tissue, coupling: Tissue = FLUID, membrane=None, **settings
) -> UltrasoundSimulator:
    """A simulator for labels 1, 2, ... with `coupling` around them, without the probe's own ring-down."""
    table = TissueTable({0: coupling, **dict(enumerate(tissues, 1))}, membrane)
    return UltrasoundSimulator(labels, table, SimulationSettings(**{"ring_down": False, **settings}))


@cache
def coarse_chest() -> CtPhantom:
    """A CT of the lower chest in voxels of 4 mm, which no test changes."""
    return lower_chest((4.0, 4.0, 4.0))


def example(name: str):
    """The module examples/`name`.py."""
    path = Path(__file__).parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True, scope="session")
def _own_state(tmp_path_factory):
    """Workstations keep their state in a folder of the tests, not of the user."""
    before = os.environ.get("XDG_STATE_HOME")
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))
    yield
    if before is None:
        del os.environ["XDG_STATE_HOME"]
    else:
        os.environ["XDG_STATE_HOME"] = before


@pytest.fixture(autouse=True)
def _unchanged_locale():
    """ITK's DICOM writer, which some tests use, sets the C locale, in which Python reads text files as ASCII."""
    locale.setlocale(locale.LC_ALL, _LOCALE)  # fixtures of other scopes use that writer, too
    yield
    locale.setlocale(locale.LC_ALL, _LOCALE)


@pytest.fixture(scope="module")
def segmented_once():
    """Commands and scenes segment the same image with the same arguments once for all tests (tests.remembered)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("SlicerUSSim.Logic.mri.modality.segment_mri", segment_once)
        yield


@pytest.fixture(scope="session")
def mni():
    """(T1, grey map, white map) of the MNI152 template, 0 to 255."""
    atlas = mni152()
    maps = (volume.with_array(np.rint(255 * volume.array).astype(np.uint8)) for volume in (atlas.grey, atlas.white))
    return atlas.t1, *maps


def name_labels(path: Path, names: Iterable[str]) -> None:
    """Write the names of labels 1, 2, ... into the header of a NIfTI file, as TotalSegmentator does."""
    import nibabel

    image = nibabel.load(path)
    labels = "".join(f'<Label Key="{number}"><![CDATA[{name}]]></Label>' for number, name in enumerate(names, 1))
    extension = nibabel.nifti1.Nifti1Extension(0, f"<LabelTable>{labels}</LabelTable>".encode())
    image.header.extensions.append(extension)
    nibabel.save(nibabel.Nifti1Image(np.asarray(image.dataobj), image.affine, image.header), path)


@pytest.fixture(scope="session")
def files(tmp_path_factory) -> Path:
    """A head, its labels, and a sequence of images of it with more gain; tests write into folders of their own."""
    folder = tmp_path_factory.mktemp("patient")
    mri = head_mri(2.0)
    mri.write(folder / "head.nii.gz")
    segmentation = segment_mri(mri, thin_sulci=True)
    segmentation.labels.write(folder / "labels.nii.gz")
    name_labels(folder / "labels.nii.gz", segmentation.tissue_names)
    tissues = TissueTable.brain(segmentation.tissue_names)
    tissues.write(folder / "labels.json")
    probe = PhasedProbe(field_of_view_deg=75.0, depth_mm=70.0, scan_lines=96)
    write_json(folder / "probe.json", probe.to_dict())
    poses = tilt_sweep(craniotomy_pose(segmentation.labels, probe), 20.0, 6)
    louder = tissues.replace("white matter", mu0=0.6)
    images = [frame.image for frame in UltrasoundSimulator(segmentation.labels, louder).sweep(probe, poses)]
    to_probe = ImageGrid.for_probe(probe, None).image_to_probe
    transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses)
    TrackedSequence(np.stack(images), transforms, 0.1 * np.arange(6)).write(folder / "sweep.igs.mha")
    Volume(np.ones((4, 4, 4), np.uint8), np.diag([5.0, 5, 5, 1]) + 300 * np.eye(4, k=3)).write(folder / "far.nii.gz")
    (folder / "broken.nii.gz").write_bytes(b"this is not an image")
    return folder
