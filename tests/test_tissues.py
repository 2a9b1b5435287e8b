"""Tissues and tables: sources of parameters, reading and writing JSON, errors that name tissue and value."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import Membrane, SimulationError, Tissue, TissueTable
from SlicerUSSim.Logic.tissue.presets import TISSUES

PARAMETERS = {"speed_of_sound_m_s", "impedance_mrayl", "attenuation_db_cm_mhz", "mu0", "mu1", "sigma0"}
UNEVENNESS = {"texture_db", "texture_mm", "specks_per_mm3", "speck_db"}

tissues = st.builds(
    Tissue,
    st.text(min_size=1, max_size=200).filter(lambda name: name.strip() and name.isprintable()),
    st.floats(100, 10000),
    st.floats(1e-3, 50),
    st.floats(0, 50),
    st.floats(-5, 5),
    st.floats(-3, 3),
    st.floats(0, 5),
)


@pytest.mark.parametrize("name", list(TISSUES))
def test_every_number_of_a_preset_has_a_source(name):
    # Tissues that were not compared with real speckle are even, as in the paper's model
    extra = set(TISSUES[name].sources) - PARAMETERS
    assert extra <= UNEVENNESS and bool(extra) == (TISSUES[name].texture_db > 0.0)
    assert all(TISSUES[name].sources.values())


def test_white_matter_is_brighter_than_grey_and_leptomeninges_than_both():
    variance = {name: TISSUES[name].scatterer_variance for name in ("grey matter", "white matter", "leptomeninges")}
    assert 1.5 < variance["white matter"] / variance["grey matter"] < 6
    assert variance["leptomeninges"] > 4 * variance["white matter"]


def test_echogenicity_follows_the_formula():
    # mu1 = 0: half of the sites; Var = 1/4 mu0^2 + 1/2 sigma0^2
    assert Tissue("t", 1540, 1.6, 0.5, mu0=0.4, mu1=0.0, sigma0=0.2).scatterer_variance == pytest.approx(0.06)
    assert Tissue("t", 1540, 1.6, 0.5, mu0=1.0, mu1=-9.0, sigma0=0.0).scatterer_variance == pytest.approx(0, abs=1e-9)


@given(
    st.dictionaries(st.integers(0, 62), tissues, max_size=6),
    st.none() | st.builds(Membrane, tissues, st.floats(0, 5), diffuse_db=st.floats(-9, 9)),
)
def test_tables_survive_json(members, membrane):
    table = TissueTable(members, membrane)
    assert TissueTable.from_dict(json.loads(json.dumps(table.to_dict()))) == table


def test_replace_changes_every_label_of_a_name_and_the_membrane_with_them():
    """Left and right hemisphere have separate labels; sulci can be labelled and also be the membrane."""
    louder = replace(TISSUES["white matter"], speed_of_sound_m_s=1550.0)
    members = {1: TISSUES["white matter"], 2: TISSUES["leptomeninges"], 3: louder}
    table = TissueTable(members, Membrane(TISSUES["leptomeninges"], 0.7))
    changed = table.replace("white matter", mu0=0.5).replace("leptomeninges", sigma0=0.9)
    assert changed[1] == replace(members[1], mu0=0.5) and changed[3] == replace(louder, mu0=0.5)
    assert changed[2] == replace(members[2], sigma0=0.9) == changed.membrane.tissue
    assert changed.membrane.thickness_mm == 0.7 and changed[0] == table[0]
    assert changed == table.with_tissue(changed[2]).replace("white matter", mu0=0.5)  # the equivalent call


def test_a_name_means_the_same_tissue_to_labels_membrane_and_label_maps():
    quiet, loud = (replace(TISSUES["white matter"], mu0=mu0) for mu0 in (0.1, 0.9))
    table = TissueTable({1: quiet, 2: loud}).for_names(["White-Matter", "white matter"])
    assert table[table.label_of("white matter")] == table[1] == table[2] == quiet  # the first, for everybody
    tuned = TissueTable.brain().replace("leptomeninges", mu0=1.3).for_names(["csf", "leptomeninges"])
    assert tuned[2].mu0 == tuned.membrane.tissue.mu0 == 1.3
    both = TissueTable({1: quiet, 2: replace(loud, name="White Matter")}).for_names(["White Matter", "WHITE_MATTER"])
    assert (both[1].mu0, both[2].mu0) == (0.9, 0.1)  # an exact name has precedence over a similar one


@pytest.mark.parametrize(
    "change, message",
    [
        (
            {"speed_of_sound_m_s": -1},
            "tissue 'bone': speed_of_sound_m_s is -1, expected a number between 100 and 10000",
        ),
        ({"impedance_mrayl": 0}, "impedance_mrayl is 0"),
        ({"attenuation_db_cm_mhz": float("nan")}, "attenuation_db_cm_mhz is nan"),
        ({"sigma0": "much"}, "sigma0 is 'much'"),
        ({"name": " "}, "expected one line of printable text"),
    ],
)
def test_impossible_tissues_are_refused(change, message):
    values = {"name": "bone", "speed_of_sound_m_s": 3000, "impedance_mrayl": 6, "attenuation_db_cm_mhz": 5} | change
    with pytest.raises(SimulationError, match=message):
        Tissue(**values)


def test_tables_refuse_labels_and_files_they_cannot_use(tmp_path):
    with pytest.raises(SimulationError, match="tissue label is 63"):
        TissueTable({63: TISSUES["bone"]})
    with pytest.raises(SimulationError, match="no preset for tissue 'cheese'"):
        TissueTable.named(["cheese"])
    path = tmp_path / "tissues.json"
    for text, message in (
        ("{", "is not JSON"),
        ("[]", 'is a list, expected {"tissues"'),
        ('{"tissues": {"1": {"name": "x"}}}', "tissue 1: lacks speed_of_sound_m_s, impedance_mrayl"),
        ('{"tissues": {"1": {"name": "x", "speed_of_sound_m_s": 1, "impedance_mrayl": 1, "attenuation_db_cm_mhz": 1}}}',
         "tissue 1: speed_of_sound_m_s is 1, expected a number between 100 and 10000"),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(SimulationError, match=r"tissues\.json: .*" + message.replace("{", "\\{")):
            TissueTable.read(path)
    with pytest.raises(SimulationError, match="cannot be read"):
        TissueTable.read(tmp_path / "none.json")


def test_a_tissue_replaces_all_of_its_name_and_a_new_one_gets_a_free_label():
    table = TissueTable.brain(("csf", "leptomeninges"))
    louder = replace(TISSUES["leptomeninges"], mu0=1.5)
    changed = table.with_tissue(louder)
    assert changed[2] == louder == changed.membrane.tissue and changed[1] == table[1]
    assert [tissue.name for tissue in changed.all_tissues()] == ["coupling", "csf", "leptomeninges", "leptomeninges"]
    more = changed.with_tissue(TISSUES["tumour"])
    assert more[3].name == "tumour" and more.membrane == changed.membrane and len(more) == len(changed) + 1
    assert TissueTable({}).all_tissues() == [TISSUES["coupling"]]


def test_fluids_of_the_membrane_are_tissues_in_their_own_spelling():
    from SlicerUSSim.Command.set_option import Changes

    table = TissueTable.brain()
    changes = Changes.of(["membrane.fluids=CSF, Cyst"])
    assert changes.to_tissues(table).membrane.fluids == ("csf", "cyst")
    for text, message in (
        ("csf,nonsense", "--set: membrane.fluids: no tissue 'nonsense', expected coupling, csf, "),
        ("csf,cavitiy", "--set: membrane.fluids: no tissue 'cavitiy', expected cavity"),
    ):
        wrong = Changes.of([f"membrane.fluids={text}"])
        for check in (lambda: wrong.to_tissues(table), lambda: wrong.check_tissues(table.names())):  # noqa: B023
            with pytest.raises(SimulationError, match=message):
                check()
