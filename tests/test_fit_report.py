"""What the report of a fit says of the fit of the speckle, and the names of a fit's steps."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    SimulationSettings,
    TissueTable,
    TrackedSequence,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.base.files import write_json
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.speckle_fit import SpeckleFit
from SlicerUSSim.Logic.fitting.texture_costs import TextureMisfit
from SlicerUSSim.Logic.probe import ImageGrid, tilt_sweep
from tests.conftest import block, rigid

PROBE = ConvexProbe(12.0, 60.0, 30.0, scan_lines=80)
LABELS = block(lambda x, y, z: 1 + (np.hypot(x - 3.0, y + 2.0) < 11.0), half_mm=(36, 32, 12))
TISSUES = TissueTable.named(["white matter", "csf"])
SHOWN = DisplaySettings(gain_db=4.0, noise_db=None, image_size=(140, 150))


def recorded() -> TrackedSequence:
    """Four images with other speckle than a fit's, as real images have."""
    made = UltrasoundSimulator(LABELS, TISSUES, SimulationSettings(seed=11, ring_down=False))
    poses = tilt_sweep(rigid(np.eye(3), [0.0, -24.0, 0.0]), 8.0, 4)
    to_probe = ImageGrid.for_probe(PROBE, SHOWN.image_size).image_to_probe
    transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses)
    return TrackedSequence(np.stack([made.simulate(PROBE, p, SHOWN).image for p in poses]), transforms, np.arange(4.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("fit")
    LABELS.write(place / "labels.nii.gz")
    TISSUES.write(place / "labels.json")
    recorded().write(place / "tracked.igs.mha")
    write_json(place / "probe.json", PROBE.to_dict())
    return place


def optimize(folder, *options):
    arguments = [
        "optimize", folder / "labels.nii.gz", "--sequence", folder / "tracked.igs.mha", "--probe",
        folder / "probe.json", "--frames", "1", "--free", "gain_db", "--set", "fit.evaluations=6",
        "--set", "fit.restarts=0", "-o",
        folder / "result.json", "--overwrite", *options,
    ]  # fmt: skip
    return CliRunner().invoke(main, list(map(str, arguments)))


def rows_of(report: str) -> list[list[str]]:
    """The texts of every row of every table."""
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", report, re.DOTALL)
    return [
        [unescape(re.sub("<[^>]*>", "", cell)) for cell in re.findall(r"<t[dh]>(.*?)</t[dh]>", row)] for row in rows
    ]


def test_a_fit_writes_what_was_asked_for(folder):
    pytest.importorskip("matplotlib", reason="reports need matplotlib: pip install '.[demo]'")
    places = [folder / name for name in ("report.html", "preset.json", "field.png")]
    done = optimize(folder, "--report", places[0], "--save-preset", places[1], "--set", f"recording.field={places[2]}")
    assert done.exit_code == 0, done.output
    assert all(str(place) in done.stderr.splitlines()[-1] for place in places)
    report = places[0].read_text("utf-8")
    assert "Fit of the speckle" not in report  # which was not asked for


@pytest.mark.slow
def test_the_report_says_what_the_fit_of_the_speckle_found(folder):
    pytest.importorskip("matplotlib", reason="reports need matplotlib: pip install '.[demo]'")
    report = folder / "predicted.html"
    done = optimize(folder, "--set", "fit.speckle=true", "--set", "fit.validate=2", "--report", report)
    assert done.exit_code == 0, done.output
    said = {row[0]: row[1] for row in rows_of(report.read_text("utf-8")) if len(row) == 2}
    assert "x " in said["texture of the tissues"]


def test_what_the_fit_of_the_speckle_found_is_reported():
    shown = replace(SHOWN, smoothing_axial_mm=0.044, smoothing_lateral_deg=0.31, map_black=0.5)
    found = SpeckleFit(shown, TISSUES, 1.4, TextureMisfit(0.2, 0.4), TextureMisfit(0.12, 0.5), True)
    rows = dict(found.rows())
    assert rows["smoothing of the envelope"] == "0.044 mm axially, 0.31° laterally"
    assert (
        rows["texture of the tissues"] == "x 1.4" and "slope 0.50 at black" in rows["grey map, from the images alone"]
    )
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["after"]["extrema"] == 0.5
    untold = replace(found, has_map=False).rows()
    assert "too few grey levels" in untold[0][1] and len(untold) == 5


def test_steps_of_a_fit_say_their_names():
    told: list[Progress] = []
    named = Progress.named("levels for the speckle", told.append)
    shares = Progress.shares("smoothing and texture", told.append)
    assert named is not None and shares is not None
    named(Progress("global", 3, 10, 0.5, 0.4, {}))
    shares(0.25)
    assert [step.in_words() for step in told] == [
        "levels for the speckle, global: cost 0.4000", "smoothing and texture"
    ]  # fmt: skip
    assert [step.share for step in told] == [0.3, 0.25]
    assert Progress.named("no one listens", None) is Progress.shares("no one listens", None) is None
