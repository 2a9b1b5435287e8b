"""Presets: one value, one file, validated like its parts."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import ConvexProbe, LinearProbe, Preset, SimulationError, TissueTable
from SlicerUSSim.Logic.base.transforms import pose_of_angles
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.tracked.pose_files import read_pose


@given(
    probe=st.sampled_from(sorted(PROBES)),
    gain=st.floats(-60, 60),
    noise=st.none() | st.floats(-120, 0),
    size=st.none() | st.tuples(st.integers(8, 900), st.integers(8, 900)),
    seed=st.integers(0, 2**32 - 1),
    mu0=st.floats(0, 2),
)
def test_a_preset_survives_its_file(tmp_path_factory, probe, gain, noise, size, seed, mu0):
    preset = Preset(PROBES[probe], tissues=TissueTable.brain().replace("csf", mu0=mu0))
    preset = preset.changed("display", gain_db=gain, noise_db=noise, image_size=size).changed("settings", seed=seed)
    path = tmp_path_factory.mktemp("preset") / "preset.json"
    preset.write(path)
    assert Preset.read(path) == preset


def test_a_preset_may_carry_a_pose_and_one_without_is_as_before(tmp_path):
    pose = pose_of_angles([10.0, -20.0, 30.5], [10.0, 20.0, 30.0])
    assert "probe_to_ras" not in Preset().to_dict() and Preset().probe_to_ras is None
    preset = Preset(PROBES["convex"], probe_to_ras=pose)
    preset.write(tmp_path / "preset.json")
    again = Preset.read(tmp_path / "preset.json")
    assert again == preset and again.changed("display", gain_db=3).probe_to_ras == preset.probe_to_ras
    np.testing.assert_allclose(again.probe_to_ras, pose)
    np.testing.assert_allclose(read_pose(tmp_path / "preset.json"), pose)  # --pose takes it from there
    with pytest.raises(SimulationError, match="probe_to_ras is not rigid"):
        Preset.from_dict({**preset.to_dict(), "probe_to_ras": (2 * np.diag([1, 1, 1, 0.5])).tolist()})
    with pytest.raises(SimulationError, match="is a pose, not a preset; open it as a pose"):
        Preset.from_dict({"probe_to_ras": pose.tolist()})  # which would reset probe and tissues


def test_the_result_of_a_fit_is_not_a_preset():
    with pytest.raises(SimulationError, match="result of a fit, expected a preset, as ussim optimize --save-preset"):
        Preset.from_dict({"at_bounds": [], "parameters": [], "cost_before": 0.9, "cost_after": 0.4, "display": {}})
    with pytest.raises(SimulationError, match="has 'b', expected probe, display"):
        Preset.from_dict({"display": {}, "b": 1, "a": 2, "c": 3})


def test_changing_the_kind_of_probe_keeps_what_both_have():
    preset = Preset().changed("probe", depth_mm=70.0, frequency_mhz=4.0, focus_mm=30.0)
    convex = preset.changed("probe", kind="convex").probe
    assert isinstance(convex, ConvexProbe)
    assert (convex.depth_mm, convex.frequency_mhz, convex.focus_mm) == (70.0, 4.0, 30.0)
    assert convex.radius_mm == PROBES["convex"].radius_mm  # which a phased array does not have
    linear = preset.changed("probe", kind="linear", width_mm=25.0).probe
    assert isinstance(linear, LinearProbe) and linear.width_mm == 25.0


@pytest.mark.parametrize("focus_mm", [20.0, 85.0])
def test_a_chosen_focus_stays_at_another_depth_and_a_default_one_follows(focus_mm):
    preset = Preset(PROBES["linear"]).changed("probe", depth_mm=80.0, focus_mm=focus_mm)
    deeper = preset.changed("probe", depth_mm=100.0).probe
    assert deeper.focus_mm == focus_mm
    assert deeper.elevation_focus_mm == type(deeper).default_focus_mm(100.0) == pytest.approx(60.0)


def test_changed_refuses_what_it_does_not_know():
    with pytest.raises(SimulationError, match="no section 'tissue'"):
        Preset().changed("tissue", mu0=1)
    with pytest.raises(SimulationError, match="radius_mm is not a parameter of a phased probe"):
        Preset().changed("probe", radius_mm=3)
    with pytest.raises(SimulationError, match="kind is 'sector'"):
        Preset().changed("probe", kind="sector")


def test_a_table_for_other_labels_keeps_edited_tissues():
    table = TissueTable.brain().replace("white matter", mu0=0.9)
    other = table.for_names(["White_Matter", "tumor"])
    assert other[1].mu0 == 0.9 and other[2].name == "tumour" and other.membrane == table.membrane
    with pytest.raises(SimulationError, match="no tissue for 'Segment_1', 'foo'"):
        table.for_names(["Segment_1", "foo", "csf"])


PRESETS = [
    Preset(),
    *map(Preset, PROBES.values()),
    Preset().changed("probe", kind="linear", depth_mm=33).changed("display", image_size=(96, 64), grey_map="soft"),
    Preset().changed("settings", contact_gap_mm=1.5, partial_volume=True),
    Preset(tissues=TissueTable({})),
    Preset(tissues=Preset().tissues.with_membrane(None)),
    Preset(tissues=Preset().tissues.replace("leptomeninges", mu0=0.3)),
    Preset(tissues=TissueTable.named(["liver", "kidney"])),
]


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_as_texts_has_every_value(preset):
    texts = preset.to_texts()
    assert Preset.from_texts(texts) == preset and Preset.from_texts(texts).tissues == preset.tissues
    assert {f"display.{entry.name}" for entry in fields(preset.display)} <= texts.keys()
    sources = [tissue.sources for tissue in preset.tissues.all_tissues()]
    assert [tissue.sources for tissue in Preset.from_texts(texts).tissues.all_tissues()] == sources
