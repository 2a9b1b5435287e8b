"""The declarations of parameters: complete and consistent, strict about types, and bad presets get good messages."""

from __future__ import annotations

import copy
import json
import math
import re
from dataclasses import MISSING, dataclass, fields, make_dataclass

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings as examples, strategies as st

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Command.options import rare_keys
from SlicerUSSim.Logic import DisplaySettings, Preset, SimulationError, SimulationSettings, Tissue
from SlicerUSSim.Logic.base.declaration import (
    Fit,
    Parameter,
    Shown,
    parameter,
    parameter_of,
    parameters_of,
)
from SlicerUSSim.Logic.imaging.preset import preset_parameters
from SlicerUSSim.Logic.probe import arrays
from SlicerUSSim.Logic.probe.arrays import PROBES, ConvexProbe, probe_kind
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.tissue import Membrane
from tests.test_parameter_docs import SECTIONS

#: By the end of a name, the longest that fits
UNITS = {
    "_db_cm_mhz": "dB/(cm MHz)", "_per_mm3": "1/mm³", "_m_s": "m/s", "_mrayl": "MRayl", "_mhz": "MHz", "_mm": "mm",
    "_deg": "°", "_db": "dB",
}  # fmt: skip
#: (class, parameter) of all that is declared
DECLARED = [(kind, entry) for _, kind, _ in SECTIONS for entry in parameters_of(kind)]
NUMBERS = [(kind, entry) for kind, entry in DECLARED if entry.type in (int, float)]


def ussim(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


# ---- what is declared ------------------------------------------------------------------------------------------------


def test_a_parameter_has_a_label_a_tip_and_the_unit_of_its_name():
    for _, entry in DECLARED:
        for text in (entry.label, entry.tip):
            assert text and text == text.strip() and "\n" not in text, entry.name
        assert not entry.label[0].islower() and not entry.label.endswith("."), entry.label
        # Formula signs and names of choices begin as they are written.
        assert entry.tip[0].isupper() or not entry.tip[0].isalpha() or re.match(r"\w+: |n in ", entry.tip), entry.tip
        for text in (entry.tip, entry.note, entry.source):
            assert not text.endswith("."), text
        suffix = next((suffix for suffix in UNITS if entry.name.endswith(suffix)), None)
        assert suffix is None or entry.unit == UNITS[suffix], entry.name


def test_a_default_is_a_value_that_is_accepted():
    for kind, entry in DECLARED:
        declared = next(field for field in fields(kind) if field.name == entry.name)
        if declared.default is not MISSING:
            assert entry.checked(kind.__name__, entry.default) == entry.default == declared.default
        elif declared.default_factory is not MISSING:
            assert entry.checked(kind.__name__, declared.default_factory()) == declared.default_factory()
        else:
            assert entry.is_required, entry.name


def test_what_is_shown_and_fitted_lies_within_the_bounds():
    for _, entry in NUMBERS:
        low, high = entry.bounds
        assert low < high and all(map(math.isfinite, entry.bounds)), entry.name
        if isinstance(entry.shown, Shown):
            shown = entry.shown
            assert shown.low < shown.high and shown.step > 0
            if shown.none_at is not None:
                assert entry.can_be_none and shown.low <= shown.none_at < shown.high
                assert shown.value(shown.none_at) is None and shown.number(None) == shown.none_at
            for number in (shown.low, shown.high):
                value = shown.value(number)
                assert value is None or (low <= value <= high and shown.number(value) == pytest.approx(number))
        else:
            assert entry.shown is None, entry.name
        if entry.fit is not None:
            assert low <= entry.fit.low < entry.fit.high <= high and entry.fit.tolerance > 0
            assert entry.fit.low > 0 or not entry.fit.is_logarithmic


def test_the_bounds_themselves_are_accepted_and_what_is_beyond_is_not():
    for kind, entry in NUMBERS:
        owner, (low, high) = kind.__name__, entry.bounds
        for value in (entry.type(low), entry.type(high)):
            assert entry.checked(owner, value) == entry.from_text(owner, repr(value)) == value
        step = 1 if entry.type is int else 1e-6 * max(abs(low), abs(high))
        for value in (entry.type(low - step), entry.type(high + step)):
            with pytest.raises(SimulationError, match=re.escape(f"{owner}: {entry.name} is {value!r}, expected ")):
                entry.checked(owner, value)


def test_options_and_names_of_those_that_have_one_are_unique():
    with_option = [entry for _, entry in DECLARED if entry.option]
    names = [name for entry in with_option for name in str(entry.option).split("/")]
    assert len(names) == len(set(names))
    assert len({entry.name for entry in with_option}) == len(with_option)
    for entry in with_option:
        assert len(str(entry.option).split("/")) == (2 if entry.type is bool else 1)


def test_one_parameter_by_name_and_the_names_there_are():
    assert parameter_of(DisplaySettings, "gain_db").full_label == "Gain [dB]"
    with pytest.raises(
        SimulationError, match="DisplaySettings has no 'gain', expected one of gain_db, dynamic_range_db"
    ):
        parameter_of(DisplaySettings, "gain")
    assert preset_parameters()["settings.seed"] == parameter_of(SimulationSettings, "seed")
    assert probe_kind().checked("probe", "convex") == "convex" and preset_parameters()["probe.kind"] == probe_kind()


# ---- strictness ------------------------------------------------------------------------------------------------------

WHOLE = Parameter(name="x", type=int, label="X", tip="X", bounds=(0, 2**32 - 1))
REAL = Parameter(name="x", type=float, label="X", tip="X", bounds=(-10, 10))
TICK = Parameter(name="x", type=bool, label="X", tip="X")
TEXT = Parameter(name="x", type=str, label="X", tip="X")
CHOICE = Parameter(name="x", type=str, label="X", tip="X", choices=("a", "b"))
PAIR = parameter_of(DisplaySettings, "image_size")
TEXTS = parameter_of(Membrane, "fluids")
OBJECT = parameter_of(Tissue, "sources")
OPTIONAL = parameter_of(DisplaySettings, "noise_db")
NO_NUMBERS = [True, False, "5", "false", "", None, [], [5], {}, math.nan, math.inf, -math.inf, 10**400, -(10**5000),
              5 + 0j, b"5", np.nan, np.bool_(True), np.eye(3)]  # fmt: skip


@pytest.mark.parametrize(
    ("entry", "values", "expected"),
    [
        (WHOLE, [*NO_NUMBERS, 3.0, 2.5, 1e300, -1, 2**32, 2**64, np.float64(3.0)],
         "a whole number between 0 and 4294967295"),
        (REAL, [*NO_NUMBERS, 11, -10.001], "a number between -10 and 10"),
        (TICK, [0, 1, 1.0, "true", "false", "", None, [], np.int64(1)], "true or false"),
        (TEXT, [5, True, None, [], b"x"], "text"),
        (CHOICE, ["c", "", "A", 0, True, None, ["a"]], "one of a, b"),
        (PAIR, [5, "8x8", [8], [8, 8, 8], [8, 8.0], [8, True], [8, "8"], [8, 7], [8, 8193], [8, 10**400], [8, None]],
         "2 whole numbers between 8 and 8192 or none"),
        (TEXTS, ["csf", {"csf": 1}, [5], [None], None, 5], "a list of texts"),
        (OBJECT, [[], "x", {"mu0": 5}, {"mu0": None}, None], "an object of texts"),
        (OPTIONAL, [True, "none", math.nan, 10**400], "a number between -300 and 100 or none"),
    ],
)  # fmt: skip
def test_what_is_of_another_type_is_refused(entry, values, expected):
    for value in values:
        with pytest.raises(SimulationError) as caught:
            entry.checked("here", value)
        message = str(caught.value)
        assert message.startswith(f"here: {entry.name} is ") and message.endswith(f", expected {expected}"), message
        assert "\n" not in message and len(message) < 200


@pytest.mark.parametrize(
    ("entry", "given_value", "value"),
    [
        (REAL, 5, 5.0), (REAL, np.float32(0.5), 0.5), (REAL, np.int16(5), 5.0), (REAL, np.array(5.0), 5.0),
        (WHOLE, np.int64(5), 5), (WHOLE, np.uint8(5), 5), (TICK, np.bool_(True), True), (TEXT, np.str_("x"), "x"),
        (PAIR, [8, 9], (8, 9)), (PAIR, (np.int64(8), np.int32(9)), (8, 9)), (PAIR, None, None), (OPTIONAL, None, None),
        (TEXTS, ["csf"], ("csf",)), (TEXTS, [], ()), (OBJECT, {"a": "b"}, {"a": "b"}),
    ],
)  # fmt: skip
def test_numpy_scalars_and_whole_numbers_are_the_numbers_that_they_are(entry, given_value, value):
    found = entry.checked("here", given_value)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("entry", "text", "value"),
    [
        (REAL, "5", 5.0), (REAL, " -1e-1 ", -0.1), (WHOLE, "5", 5), (TICK, "true", True), (TICK, "False", False),
        (CHOICE, "a", "a"), (TEXT, "", ""), (PAIR, "8, 9", (8, 9)), (PAIR, "none", None), (OPTIONAL, "None", None),
        (OPTIONAL, "-80", -80.0), (TEXTS, "csf, grey matter", ("csf", "grey matter")), (TEXTS, "", ()),
    ],
)  # fmt: skip
def test_a_text_stands_for_a_value(entry, text, value):
    found = entry.from_text("here", text)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("entry", "texts"),
    [
        (WHOLE, ["5.0", "1e3", "five", "", "true", "1_000", "none", "9" * 5000]),
        (REAL, ["nan", "-infinity", "five", "", "1_0", "0x10", "\u0663", "1e999", "none", "1,5"]),
        (TICK, ["1", "yes", "on", ""]),
        (CHOICE, ["A", "none", ""]),
        (PAIR, ["8", "8,9,10", "8,9.0", "a,b", ""]),
        (OBJECT, ["{}", ""]),
    ],
)
def test_a_text_that_stands_for_nothing_is_refused(entry, texts):
    for text in texts:
        with pytest.raises(SimulationError, match=f"^here: {entry.name} is .*, expected "):
            entry.from_text("here", text)


# ---- bad presets -----------------------------------------------------------------------------------------------------

GOOD = Preset().to_dict()
_TISSUE = {"name": "x", "speed_of_sound_m_s": 1540, "impedance_mrayl": 1.6, "attenuation_db_cm_mhz": 0.5}
_LINEAR = {"kind": "linear", "width_mm": 40, "depth_mm": 50}


def display(**values):
    return {"display": values}


def settings(**values):
    return {"settings": values}


def tissue(**values):
    return {"tissues": {"1": {**_TISSUE, **values}}}


def membrane(**values):
    return {"tissues": {}, "membrane": {"tissue": _TISSUE, **values}}


#: (what the file holds, the message after its name)
BAD = [
    # the whole file
    ("", "is not JSON (Expecting value: line 1 column 1 (char 0))"),
    ("[]", "is a list, expected an object"),
    ("[" * 17 + "]" * 17, "is nested deeper than 16 levels"),
    ('{"display": ' * 100_000, "is nested deeper than 16 levels"),
    (" " * (4 * 2**20 + 1), "has 4194305 bytes, expected at most 4194304"),
    ('{"display": {"gain_db": 1, "gain_db": 2}}', "is not JSON ('gain_db' is given twice)"),
    ('{"display": {"gain_db": NaN}}', "is not JSON (NaN is not a number)"),
    ('{"display": {"gain_db": 1e999}}', "display: gain_db is inf, expected a number between -200 and 200"),
    ('{"settings": {"seed": ' + "9" * 5000 + "}}", "is not JSON (Exceeds the limit"),
    ({"probes": {}}, "has 'probes', expected probe, display, settings, tissues, membrane"),
    ({"x" * 5000: {}}, "has 'xxx"),
    # display and settings
    (display(gain=3), "display: 'gain' is unknown, expected one of gain_db, dynamic_range_db, tgc_db_cm_mhz"),
    (display(gain_db="3"), "display: gain_db is '3', expected a number between -200 and 200"),
    (display(image_size=[512, 512.0]), "display: image_size is [512, 512.0], expected 2 whole numbers"),
    (settings(seed=3.0), "settings: seed is 3.0, expected a whole number between 0 and 4294967295"),
    # probe
    ({"probe": []}, 'probe: is a list, expected an object with a "kind"'),
    ({"probe": {"depth_mm": 70}}, "probe: lacks kind, expected one of linear, convex, phased"),
    ({"probe": {**_LINEAR, "radius_mm": 4}}, "probe: radius_mm is not a parameter of a linear probe, expected one of "),
    # tissues
    ({"tissues": {"٣": _TISSUE}}, "tissue label is '٣', expected a whole number from 0 to 62"),
    ({"tissues": {"1": {"name": "x"}}}, "tissue 1: lacks speed_of_sound_m_s, impedance_mrayl, attenuation_db_cm_mhz"),
    (tissue(name="a\nb"), "tissue 1: tissue name is 'a\\nb', expected one line of printable text"),
    (tissue(speed_of_sound_m_s=15), "tissue 1: speed_of_sound_m_s is 15, expected a number between 100 and 10000"),
    # membrane
    ({"membrane": {"tissue": _TISSUE}}, 'lacks tissues, expected {"tissues": {"1": {...}}}'),
    ({"tissues": {}, "membrane": {}}, "membrane: lacks tissue"),
    (membrane(fluids="csf"), "membrane: fluids is 'csf', expected a list of texts"),
]  # fmt: skip


def _id(case) -> str:
    text = case if isinstance(case, str) else json.dumps(case)
    return text if len(text) < 60 else f"{text[:57]}..."


@pytest.mark.parametrize(("content", "message"), BAD, ids=[_id(content) for content, _ in BAD])
def test_a_bad_preset_is_one_line_that_names_file_and_place(tmp_path, content, message):
    path = tmp_path / "bad.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    with pytest.raises(SimulationError) as caught:
        Preset.read(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < len(str(path)) + 500


def test_a_file_that_is_not_text_is_refused(tmp_path):
    path = tmp_path / "bad.json"
    for content in (b"\xff\xfe{}", b"\x00", b"\xef\xbb\xbf"):
        path.write_bytes(content)
        with pytest.raises(SimulationError, match=r"bad\.json: is not JSON \(") as caught:
            Preset.read(path)
    done = ussim("simulate", tmp_path / "no.nii", "--pose", "auto", "--preset", path, "-o", tmp_path / "o.png")
    assert done.exit_code == 2 and done.output == f"ussim: {caught.value}\n"


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.integers(2**63, 2**70),
    lambda values: st.lists(values, max_size=3) | st.dictionaries(st.text(max_size=8), values, max_size=3),
    max_leaves=6,
)


def _places(value, place=()) -> list[tuple]:
    """The way to everything in nested objects."""
    return [place] + [way for name in (value if isinstance(value, dict) else ())
                      for way in _places(value[name], (*place, name))]  # fmt: skip


@examples(max_examples=25)
@given(place=st.sampled_from(_places(GOOD)), name=st.none() | st.text(max_size=8), value=JSON_VALUES)
def test_any_value_anywhere_in_a_preset_is_taken_or_refused(tmp_path_factory, place, name, value):
    """Instead of what was there, or beside it under another name."""
    changed = copy.deepcopy({"preset": GOOD})
    *way, last = ("preset", *place)
    there = changed
    for step in way:
        there = there[step]
    if name is not None and isinstance(there[last], dict):
        there, last = there[last], name
    there[last] = value
    path = tmp_path_factory.mktemp("preset") / "preset.json"
    path.write_text(json.dumps(changed["preset"]), encoding="utf-8")
    try:
        preset = Preset.read(path)
    except SimulationError as error:
        assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
    else:
        assert Preset.from_dict(json.loads(json.dumps(preset.to_dict()))) == preset


# ---- options ---------------------------------------------------------------------------------------------------------


def test_a_rare_parameter_is_a_key_of_set_and_preset(tmp_path):
    """An image took 36 options, and a fit 56; a tenth of them is used often."""
    for name, command in main.commands.items():
        said = ussim(name, "--help").output
        assert len(re.findall(r"^  -", said, re.MULTILINE)) <= 26, name
        assert all(known in " ".join(said.split()) for known in rare_keys(command))
    assert "Gain [dB]: brightness of all echoes (default: the preset's, 0)." in " ".join(
        ussim("simulate", "--help").output.split()
    )
    for old, key in (("--tgc-reach", "display.tgc_reach=VALUE"), ("--hard-labels", "settings.partial_volume=false")):
        assert options_of(old) == f"ussim: {old} is a key of the preset now: --set {key}\n"
    (tmp_path / "p.json").write_text('{"segmentation": {"classes": 3}, "patient": {"craniotomy": "auto"}}')
    found = patient_of("--preset", tmp_path / "p.json", "--set", "segmentation.thin_sulci=false")
    assert (found.segmentation.classes, found.segmentation.thin_sulci, found.craniotomy) == (3, False, "auto")
    found = patient_of("--preset", tmp_path / "p.json", "--craniotomy", "none", "--set", "segmentation.classes=4")
    assert (found.segmentation.classes, found.craniotomy) == (4, "none")
    (tmp_path / "p.json").write_text('{"segmentation": {"clases": 3}}')
    assert "p.json: no parameter 'segmentation.clases', expected segmentation.classes" in options_of(
        "--preset", tmp_path / "p.json"
    )


def options_of(*texts):
    """The preset that a command would use with these options, or what it says."""
    found = patient_of(*texts)
    return found if isinstance(found, str) else found.changed_preset()


def patient_of(*texts):
    """The PatientOptions of a command with these options, or what it says."""
    from SlicerUSSim.Command.patient_options import PatientOptions

    found = []
    kept = PatientOptions.changed_preset

    def keep(self):
        kept(self)
        found.append(self)
        raise SimulationError("enough")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PatientOptions, "changed_preset", keep)
        done = ussim("simulate", "no.nii", "--pose", "auto", "-o", "o.png", *texts)
    assert done.exit_code == 2
    return found[0] if found else done.output


def test_options_go_before_the_preset_and_set_before_them(tmp_path):
    assert options_of() == Preset()
    Preset(PROBES["linear"]).changed("display", gain_db=6.0, noise_db=-70.0).write(tmp_path / "p.json")
    found = options_of(
        "--preset", tmp_path / "p.json", "--gain", 3, "--set", "display.noise_db=none", "--set",
        "settings.partial_volume=true",
    )  # fmt: skip
    assert (found.display.gain_db, found.display.noise_db, found.settings.partial_volume) == (3.0, None, True)
    assert found.probe == PROBES["linear"]
    found = options_of(
        "--preset", tmp_path / "p.json", "--gain", 3, "--set", "display.gain_db=4", "--set", "display.gain_db = 5",
        "--set", "probe.radius_mm=30", "--set", "probe.kind=convex", "--set", "settings.max_ray_depth=4",
        "--set", "display.image_size=64,80",
    )  # fmt: skip
    assert found.display.gain_db == 5.0 and found.display.image_size == (64, 80) and found.settings.max_ray_depth == 4
    assert isinstance(found.probe, ConvexProbe) and found.probe.radius_mm == 30.0
    (tmp_path / "probe.json").write_text(json.dumps(PROBES["linear"].to_dict()))
    assert options_of("--probe", tmp_path / "probe.json", "--set", "probe.depth_mm=33").probe.depth_mm == 33.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--gain", "500"], "--gain: gain_db is 500.0, expected a number between -200 and 200"),
        (["--seed", "3.0"], "--seed: seed is '3.0', expected a whole number between 0 and 4294967295"),
        (["--contrast", "pd"], "--contrast: contrast is 'pd', expected one of t1, t1gd, t2, flair, ct"),
        (["--set", "gain_db"], "--set is 'gain_db', expected NAME=VALUE, such as display.gain_db=3"),
        (["--set", "display.gian_db=3"], "--set: no parameter 'display.gian_db', expected display.gain_db"),
        (["--set", "white matter.mu=3"], "--set: no parameter 'white matter.mu', expected white matter.mu1"),
        (["--set", "segmentation.clases=3"], "--set: no parameter 'segmentation.clases', expected segmentation.cl"),
        (["--set", "foo.bar=3"], "--set: no parameter 'foo.bar', expected probe, display, settings, membrane or"),
        (["--set", "membrane.thickness_mm=11"], "--set membrane.thickness_mm: thickness_mm is 11.0, expected a number"),
        (["--set", "probe.radius_mm=30"], "probe: radius_mm is not a parameter of a phased probe"),
    ],
)  # fmt: skip
def test_an_option_that_is_wrong_is_one_line_that_names_it(options, message):
    said = options_of(*options)
    assert said.startswith(f"ussim: {message}") and said.count("\n") == 1


def test_set_changes_tissues_and_membrane_by_name():
    from SlicerUSSim.Command.set_option import Changes

    changes = Changes.of(["White-Matter.mu0=0.5", "leptomeninges.sigma0=0.3", "membrane.thickness_mm=2",
                          "membrane.fluids=csf, coupling"])  # fmt: skip
    tissues = changes.to_tissues(Preset().tissues)
    assert tissues.tissue("white matter").mu0 == 0.5 and tissues.tissue("csf") == TISSUES["csf"]
    assert tissues.membrane is not None and tissues.membrane.tissue.sigma0 == 0.3
    assert (tissues.membrane.thickness_mm, tissues.membrane.fluids) == (2.0, ("csf", "coupling"))
    assert not changes.gives_geometry and not Changes.of(["probe.frequency_mhz=4"]).gives_geometry
    assert Changes.of(["probe.depth_mm=70"]).gives_geometry
    with pytest.raises(SimulationError, match="no tissue 'whte matter', expected white matter or grey matter"):
        Changes.of(["whte matter.mu0=0.5"]).to_tissues(Preset().tissues)
    with pytest.raises(SimulationError, match="no tissue 'liver', expected coupling, csf, grey matter"):
        Changes.of(["liver.mu0=0.5"]).to_tissues(Preset().tissues)
    with pytest.raises(SimulationError, match="the tissue table has no membrane"):
        Changes.of(["membrane.thickness_mm=2"]).to_tissues(Preset().tissues.with_membrane(None))


# ---- declarations that cannot be checked -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hint", "more", "message"),
    [
        (list[float], {}, r"Wrong\.value: the type is list\[float\], expected bool, int, float, str"),
        (bool, {"bounds": (0, 1)}, r"Wrong\.value: bounds are \(0, 1\) for <class 'bool'>"),
        (tuple[float, ...], {"bounds": (0, 1)}, r"Wrong\.value: bounds are"),
        (float, {"bounds": (1, 0)}, r"Wrong\.value: bounds are \(1, 0\)"),
        (int, {"choices": ("1", "2")}, r"Wrong\.value: has choices"),
        (bool, {"fit": Fit(0, 1, 0.1)}, r"Wrong\.value: has a fit"),
    ],
)
def test_a_declaration_that_cannot_be_checked_names_its_field(hint, more, message):
    kind = make_dataclass("Wrong", [("value", hint, parameter(label="Value", tip="A value", **more))])
    with pytest.raises(TypeError, match=message):
        parameters_of(kind)


@pytest.fixture
def kinds():
    """The kinds of probes, which are as before afterwards."""
    before = dict(arrays.PROBE_KINDS)
    yield arrays.PROBE_KINDS
    arrays.PROBE_KINDS.clear()
    arrays.PROBE_KINDS.update(before)


def test_a_kind_of_probe_is_taken_once(kinds):
    with pytest.raises(TypeError, match="kind is 'linear', which is LinearProbe already"):
        type("Second", (ConvexProbe,), {"kind": "linear"})
    type("Variant", (arrays.LinearProbe,), {})  # presets do not distinguish it
    assert type(arrays.probe_from_dict({"kind": "linear", "width_mm": 30, "depth_mm": 40})) is arrays.LinearProbe
    ring = dataclass(frozen=True)(type("Ring", (ConvexProbe,), {"kind": "ring", "geometry": "a closed ring"}))
    values = {"kind": "ring", "radius_mm": 10, "field_of_view_deg": 90, "depth_mm": 40}
    assert type(arrays.probe_from_dict(values)) is ring
    assert Preset().changed("probe", **values).probe.to_dict()["kind"] == "ring"
