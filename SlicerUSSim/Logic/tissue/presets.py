"""Preset tissues with the source of every parameter, and their colours."""

from __future__ import annotations

from SlicerUSSim.Logic.tissue.tissue import Membrane, Tissue

_ITIS = "IT'IS Foundation tissue properties database v4"
_SZABO = "Szabo, Diagnostic Ultrasound Imaging (2004), table B.1"
_UNCHECKED = f"{_SZABO}, not checked against the book"
_DUCK = "Duck, Physical Properties of Tissue (1990)"
_SHUNG = "Shung, Fei and Ballard, J. Clin. Ultrasound 14 (1986), on clots"
_SELBEKK = "saline, which images the brain behind it too bright: Selbekk et al., Acta Neurochir. 155 (2013)"
_MCGAHAN = "McGahan et al., Radiology 159 (1986)"
#: Table 3, with ranges from Goss et al. (J. Acoust. Soc. Am. 64, 1978 and 68, 1980), Mast (ARLO 1, 2000) and others
_RANGES = "ranges in Mech. Mater. 44 (2012) 174-188, table 3"
_HOFFMAN = "Hoffman et al. 2012, as listed in table I of PMC8243208 (J. Acoust. Soc. Am.)"
_SENSORS = "table A2 of Sensors 23(13):5942 (2023)"
_PAPER = "Salehi et al., MICCAI 2015, table 1 (mean after optimisation, rounded)"
_PAPER_BEFORE = "Salehi et al., MICCAI 2015, table 1 (before optimisation)"


def _level(text: str) -> str:
    return f"this project: {text}"


# How echogenicity varies within tissues of the brain, by trial: with a soft grey map and the envelope smoothed, these
# give the speckle of a real brain its size, number of grains, bright tail and deviation. No other organ was compared.
_FROM_SPECKLE = _level("by trial, from the speckle of a real sweep of a brain (docs/realism.md)")
_TEXTURE, _SHEET = {"texture_db": 3.5, "texture_mm": 0.8}, {"texture_db": 6.0, "texture_mm": 1.2}
_SPECKS = {"specks_per_mm3": 0.01, "speck_db": 22.0}
_UNEVEN: dict[str, dict[str, float]] = {
    # Vessels across the beam are dots: more of them, and brighter, in white matter
    "white matter": {**_TEXTURE, "specks_per_mm3": 0.015, "speck_db": 25.0},
    "grey matter": {**_TEXTURE, "specks_per_mm3": 0.01, "speck_db": 24.0},
    "corpus callosum": {**_TEXTURE, **_SPECKS, "specks_per_mm3": 0.005},
    "oedema": {**_TEXTURE, **_SPECKS, "specks_per_mm3": 0.005},
    "enhancing": {**_TEXTURE, **_SPECKS},
    "necrosis": {**_TEXTURE, **_SPECKS},
    "tumour": {"texture_db": 4.0, "texture_mm": 1.6, **_SPECKS},
    "leptomeninges": _SHEET,
    "falx": _SHEET,
}


def _tissue(name, c, c_source, z, z_source, alpha, alpha_source, mu0=0.0, mu1=0.0, sigma0=0.0, scatter="") -> Tissue:
    sources = {"speed_of_sound_m_s": c_source, "impedance_mrayl": z_source, "attenuation_db_cm_mhz": alpha_source}
    sources |= dict.fromkeys(("mu0", "mu1", "sigma0"), scatter or "no scatterers")
    uneven = _UNEVEN.get(name, {})
    sources |= dict.fromkeys(uneven, _FROM_SPECKLE)
    return Tissue(name, c, z, alpha, mu0, mu1, sigma0, **uneven, sources=sources)


_DENSITY = f"density ({_ITIS}) x speed of sound"


# No measurement of the acoustic properties of these was found; they are estimates from what was measured. White matter,
# 70 % water, has 5 to 8 % more around glioblastomas ("Microgravimetric analysis of human brain tissue: correlation with
# computerized tomography scanning", 11 of 17 patients), 10 to 12 % at most (Ito et al., Acta Neurochir. 81 (1986)
# 53-60); CSF is 99 % water. Plasma: 1535 to 1549 m/s.
_WETTER = _level("estimate: white matter, a fifth of the way to CSF, as its water content")
_DEAD = _level("estimate: white matter, two fifths of the way to cyst")
_LIQUID = _level("estimate: CSF with protein, a quarter to a third of its way to plasma")

# A border between labels is smooth, and its echo misses the probe where it is oblique. Bone is a bright line at all
# angles, since its surface is rough; scatterers in its first millimetre stand for that.
_ROUGH_BONE = _level(
    "some 20 dB above soft tissue, for its rough surface, which is bright also where it is oblique to the beam: by eye "
    "as in real ultrasound of bone; attenuation hides what is deeper than a millimetre or two"
)

# Grey and white matter share Szabo's speed of sound for brain and one impedance: published differences between them are
# smaller than those between publications, and would refract rays at a border that is not a sharp interface.
# fmt: off
#: Tissues by name, each number with its source: TISSUES["white matter"].
TISSUES: dict[str, Tissue] = {
    tissue.name: tissue
    for tissue in (
        _tissue("coupling", 1504.5, "as CSF: saline over an open craniotomy", 1.515, "as CSF", 0.002, "as CSF"),
        _tissue("csf", 1504.5, _ITIS, 1.515, f"1007 kg/m3 {_DENSITY}", 0.002, "as water, " + _DUCK),
        _tissue("grey matter", 1541.0, f"brain, {_SZABO}", 1.607, f"brain, 1043 kg/m3 {_DENSITY}", 0.50,
                f"cortex is below white matter, {_DUCK}", 0.20, 0.0, 0.08, _level("about 5 dB below white matter")),
        _tissue("white matter", 1541.0, f"brain, {_SZABO}", 1.607, f"brain, 1043 kg/m3 {_DENSITY}", 0.54, _PAPER_BEFORE,
                0.33, 0.0, 0.15, _PAPER),
        _tissue("corpus callosum", 1541.0, "as white matter", 1.607, "as white matter", 0.54, "as white matter",
                0.20, 0.0, 0.09, _level("4 dB below white matter: dark between two bright lines, its surfaces")),
        _tissue("enhancing", 1550.0, "within the range for tumours, " + _DUCK, 1.63, "glioma, as for tumour", 0.60,
                "between brain and tumour", 0.70, 0.0, 0.35, _level("vessels, choroid plexus: 7 dB above white")),
        _tissue("tumour", 1550.0, "within the range for tumours, " + _DUCK, 1.63, "slightly denser than brain", 0.70,
                "more than brain, " + _DUCK, 1.13, 0.0, 0.53,
                _level(f"11 dB above white matter, 8 to 10 in the image; gliomas are echogenic ({_MCGAHAN}), the more "
                       "the denser their cells (Camp et al., J. Ther. Ultrasound 5:2, 2017)")),
        _tissue("oedema", 1534.0, _WETTER, 1.589, _WETTER, 0.43, _WETTER, 0.44, 0.0, 0.20,
                _level("2.5 dB above white matter, below tumour: brighter than brain, without a sharp border")),
        _tissue("necrosis", 1530.0, _DEAD, 1.58, _DEAD, 0.33, _DEAD, 0.27, 1.5, 0.16,
                _level("8 dB below white matter, few strong scatterers: dark with bright dots; necrosis may also be "
                       f"echogenic ({_MCGAHAN}), as tumour")),
        _tissue("cyst", 1515.0, _LIQUID, 1.538, _LIQUID, 0.02, _LIQUID),
        _tissue("cavity", 1504.5, "as CSF: a resection cavity full of saline", 1.515, "as CSF", 0.002, _SELBEKK),
        _tissue("falx", 1600.0, "collagenous membrane, " + _DUCK, 1.80, f"dura 1174 kg/m3 {_DENSITY}, softened", 1.0,
                "connective tissue, " + _DUCK, 0.90, 0.0, 0.45, _level("about 10 dB above white matter")),
        _tissue("leptomeninges", 1541.0, "as brain: too thin to matter", 1.607, "as brain", 0.54, "as brain",
                0.90, 0.0, 0.50, _level("about 9 dB above white matter: arachnoid, pia, vessels in sulci; ependyma")),
        _tissue("skull", 2814.0, f"skull, {_ITIS}", 5.37, f"1908 kg/m3 {_DENSITY}", 7.8, f"skull, {_DUCK}",
                5.0, 0.0, 3.0, _ROUGH_BONE),
        _tissue("scalp", 1624.0, f"skin, {_ITIS}", 1.80, f"skin 1109 kg/m3 {_DENSITY}", 0.80, f"skin, {_DUCK}",
                0.60, 0.0, 0.30, _level("echogenic skin and fat")),
        _tissue("skin", 1624.0, f"skin, {_ITIS}", 1.80, f"1109 kg/m3 {_DENSITY}", 0.80, f"skin, {_DUCK}",
                0.60, 0.0, 0.30, _level("as scalp: echogenic")),
        _tissue("blood", 1584.0, _SZABO, 1.679, f"1060 kg/m3, {_SZABO}", 0.14, _SZABO, 0.03, 0.0, 0.02,
                _level("flowing, some 20 dB below tissue at 5 MHz")),
        _tissue("haematoma", 1618.0, "34 m/s above flowing blood: Shung et al., J. Clin. Ultrasound 12 (1984), "
                "not checked", 1.715, "1060 kg/m3, as blood, x speed of sound", 0.43, f"slope at 3 to 8 MHz, {_SHUNG}",
                0.75, 0.0, 0.32,
                _level("7 dB above white matter: brighter than brain within minutes (canine model), fading after "
                       f"days; at least 18 dB above flowing blood ({_SHUNG})")),
        _tissue("water", 1524.0, "37 degrees C, " + _DUCK, 1.514, "993 kg/m3, " + _DUCK, 0.002, _DUCK),
        _tissue("gel", 1540.0, "coupling gel, matched to tissue", 1.57, "1020 kg/m3 x 1540 m/s", 0.05, "nearly water"),
        _tissue("air", 343.0, "20 degrees C", 0.0004, "1.2 kg/m3 x 343 m/s", 12.0, f"at 1 MHz, {_DUCK}"),
        _tissue("fat", 1430.0, _SZABO, 1.327, f"928 kg/m3, {_SZABO}", 0.60, _SZABO, 0.25, 0.0, 0.12,
                _level("hypoechoic lobules")),
        _tissue("muscle", 1580.0, _SZABO, 1.645, f"1041 kg/m3, {_SZABO}", 0.57, _SZABO, 0.28, 0.0, 0.14,
                _level("below liver across the fibres")),
        _tissue("liver", 1578.0, _SZABO, 1.657, f"1050 kg/m3, {_SZABO}", 0.45, _SZABO, 0.40, 0.0, 0.20,
                _level("reference for the abdomen")),
        _tissue("kidney", 1560.0, _SZABO, 1.638, f"1050 kg/m3, {_SZABO}", 1.0, f"kidney, {_DUCK}", 0.28, 0.0, 0.13,
                _level("cortex slightly below liver")),
        _tissue("spleen", 1567.0, f"{_SZABO}; 1567.6 in {_ITIS}, 1537 to 1597 in the {_RANGES}", 1.651,
                f"1054 kg/m3, {_SZABO} and {_RANGES}; 1089 in {_ITIS}", 0.40,
                f"{_UNCHECKED}; 0.29 at 0.5 MHz in {_ITIS}", 0.42, 0.0, 0.21,
                _level("slightly above liver")),
        _tissue("heart", 1554.0, f"heart muscle, {_SZABO}; 1561.3 in {_ITIS}, 1526 to 1623 in the {_RANGES}", 1.647,
                f"1060 kg/m3, {_SZABO} and {_RANGES}; 1081 in {_ITIS}", 0.52,
                f"{_UNCHECKED}; 0.28 at 0.5 MHz in {_ITIS}", 0.28, 0.0, 0.14, _level("as muscle")),
        _tissue("lung", 949.3, f"inflated, {_ITIS}", 0.374, f"inflated, 394 kg/m3 {_DENSITY}", 20.1,
                f"inflated, 115.5 Np/m at 0.5 MHz, {_ITIS}; measurements disagree (Ultrasound Med. Biol. 28 (2002) "
                "1209-1216)", 0.50, 0.0, 0.30, _level("masked by its own surface echo")),
        _tissue("bone", 3198.0, _SZABO, 6.364, f"1990 kg/m3, {_SZABO}", 3.54, _SZABO, 5.0, 0.0, 3.0,
                _ROUGH_BONE),
        _tissue("cancellous bone", 1675.0, f"fast wave in human calcaneus, {_HOFFMAN}", 1.973,
                f"1178 kg/m3 ({_ITIS}) x speed of sound", 20.0,
                f"4 (human calcaneus, {_HOFFMAN}) to 43 (human femur, Anderson et al. 2010, ibid.)",
                0.50, 0.0, 0.30, _level("masked by the cortex over it")),
        _tissue("metal", 6522.0, f"titanium alloy, {_SENSORS}", 27.1, f"titanium alloy, {_SENSORS}", 0.42,
                f"0.15 to 0.70, {_SENSORS}"),
    )
}
# fmt: on

#: Leptomeninges and ependyma: their lines break and fade as those of the real sweep (docs/realism.md#look)
MEMBRANE = Membrane(
    TISSUES["leptomeninges"], thickness_mm=0.35, diffuse_exponent=3.5, sheet_exponent=0.8, patch_db=7.0,
    roughness_octaves=1.0,
)  # fmt: skip

#: Colours of tissues in figures, label maps and segmentations: muted but distinguishable; red, green, blue, 0 to 1.
_COLOURS = {
    "csf": (0.17, 0.37, 0.54), "grey matter": (0.55, 0.55, 0.55), "white matter": (0.91, 0.89, 0.85),
    "corpus callosum": (0.80, 0.76, 0.66), "leptomeninges": (0.78, 0.35, 0.33), "enhancing": (0.85, 0.64, 0.25),
    "tumour": (0.37, 0.62, 0.43),
    "oedema": (0.72, 0.80, 0.42), "necrosis": (0.40, 0.30, 0.18), "cyst": (0.30, 0.72, 0.72),
    "cavity": (0.24, 0.24, 0.45), "haematoma": (0.48, 0.05, 0.16),
    "falx": (0.56, 0.42, 0.70), "blood": (0.75, 0.10, 0.10), "skull": (0.95, 0.93, 0.75), "bone": (0.95, 0.93, 0.75),
    "scalp": (0.87, 0.72, 0.63), "fat": (0.93, 0.83, 0.45), "muscle": (0.70, 0.33, 0.29), "liver": (0.52, 0.23, 0.19),
    "kidney": (0.65, 0.30, 0.25), "water": (0.30, 0.60, 0.85), "gel": (0.45, 0.75, 0.85),
    "spleen": (0.58, 0.30, 0.42), "heart": (0.72, 0.25, 0.25), "lung": (0.80, 0.85, 0.90), "air": (0.85, 0.95, 1.0),
    "skin": (0.87, 0.72, 0.63), "cancellous bone": (0.86, 0.76, 0.55), "metal": (0.60, 0.62, 0.70),
}  # fmt: skip
_OTHER_COLOUR = (0.3, 0.75, 0.8)


def colour_of(tissue_name: str) -> tuple[float, float, float]:
    """Red, green, blue from 0 to 1 of a tissue in figures, label maps and segmentations."""
    return _COLOURS.get(tissue_name, _OTHER_COLOUR)
