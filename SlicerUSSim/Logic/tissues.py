"""Tissues, their acoustic and scattering parameters, and the presets with the source of every number.

Six parameters make a tissue (PHYSICS section 2): speed of sound, impedance, attenuation, and the scatterers' mu0, mu1
and sigma0. A scatterer exists where T1 >= mu1 and has amplitude mu0 + sigma0 T0, with T0, T1 ~ N(0, 1).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from statistics import NormalDist

import numpy as np

from SlicerUSSim.Logic.errors import SimulationError, require, require_between
from SlicerUSSim.Logic.volume import written_whole

MAX_LABEL = 62  # six bits in the device's label volume, and 63 is the membrane


@dataclass(frozen=True)
class Tissue:
    """One tissue. Raises SimulationError, naming the tissue and the value, for anything out of physical range."""

    name: str
    #: c [m/s]
    speed_of_sound_m_s: float
    #: Z [MRayl]
    impedance_mrayl: float
    #: alpha [dB/(cm MHz)], one way
    attenuation_db_cm_mhz: float
    #: Mean scatterer amplitude
    mu0: float = 0.0
    #: Existence threshold; the share of lattice sites that hold a scatterer is 1 - Phi(mu1)
    mu1: float = 0.0
    #: Standard deviation of the scatterer amplitude
    sigma0: float = 0.0
    #: Where the numbers come from, per parameter
    sources: Mapping[str, str] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        owner = f"tissue {self.name!r}"
        require(isinstance(self.name, str) and bool(self.name.strip()), f"tissue name is {self.name!r}, expected text")
        require_between(owner, "speed_of_sound_m_s", self.speed_of_sound_m_s, 100, 10000)
        require_between(owner, "impedance_mrayl", self.impedance_mrayl, 1e-5, 100)
        require_between(owner, "attenuation_db_cm_mhz", self.attenuation_db_cm_mhz, 0, 100)
        require_between(owner, "mu0", self.mu0, -100, 100)
        require_between(owner, "mu1", self.mu1, -10, 10)
        require_between(owner, "sigma0", self.sigma0, 0, 100)

    @property
    def scatterer_share(self) -> float:
        """p = 1 - Phi(mu1): the share of lattice sites that hold a scatterer."""
        return 1.0 - NormalDist().cdf(self.mu1)

    @property
    def scatterer_variance(self) -> float:
        """Var = p (1 - p) mu0^2 + p sigma0^2, which alone sets the echogenicity of developed speckle."""
        p = self.scatterer_share
        return p * (1.0 - p) * self.mu0**2 + p * self.sigma0**2


@dataclass(frozen=True)
class Membrane:
    """A thin scattering layer along the border between fluid and brain: leptomeninges outside, ependyma inside.

    An MRI shows it as partial volume at best, so the label map cannot hold it; the simulator finds it from the labels,
    at sub-voxel thickness.
    """

    tissue: Tissue
    #: Thickness of the layer, centred on the border
    thickness_mm: float = 1.0
    #: Names of the tissues on its fluid side; thin sulci, whose two sides meet, count as one sheet
    fluids: tuple[str, ...] = ("csf", "coupling", "leptomeninges")

    def __post_init__(self) -> None:
        require_between("membrane", "thickness_mm", self.thickness_mm, 0, 10)
        object.__setattr__(self, "fluids", tuple(self.fluids))


_ITIS = "IT'IS Foundation tissue properties database v4"
_SZABO = "Szabo, Diagnostic Ultrasound Imaging (2004), table B.1"
_DUCK = "Duck, Physical Properties of Tissue (1990)"
_PAPER = "Salehi et al., MICCAI 2015, table 1 (mean after optimisation, rounded)"
_PAPER_BEFORE = "Salehi et al., MICCAI 2015, table 1 (before optimisation)"


def _level(text: str) -> str:
    return f"this project: {text}"


def _tissue(name, c, c_source, z, z_source, alpha, alpha_source, mu0=0.0, mu1=0.0, sigma0=0.0, scatter="") -> Tissue:
    sources = {"speed_of_sound_m_s": c_source, "impedance_mrayl": z_source, "attenuation_db_cm_mhz": alpha_source}
    sources |= dict.fromkeys(("mu0", "mu1", "sigma0"), scatter or "no scatterers")
    return Tissue(name, c, z, alpha, mu0, mu1, sigma0, sources)


_DENSITY = f"density ({_ITIS}) x speed of sound"

# Grey and white matter share Szabo's speed for brain and one impedance: published differences between them are smaller
# than between publications, and a difference would bend rays at every voxel of a border that is not a sharp interface.
# fmt: off
TISSUES: dict[str, Tissue] = {
    tissue.name: tissue
    for tissue in (
        _tissue("coupling", 1504.5, "as CSF: saline over an open craniotomy", 1.515, "as CSF", 0.002, "as CSF"),
        _tissue("csf", 1504.5, _ITIS, 1.515, f"1007 kg/m3 {_DENSITY}", 0.002, "as water, " + _DUCK),
        _tissue("grey matter", 1541.0, f"brain, {_SZABO}", 1.607, f"brain, 1043 kg/m3 {_DENSITY}", 0.50,
                f"cortex is below white matter, {_DUCK}", 0.20, 0.0, 0.08, _level("about 5 dB below white matter")),
        _tissue("white matter", 1541.0, f"brain, {_SZABO}", 1.607, f"brain, 1043 kg/m3 {_DENSITY}", 0.54, _PAPER_BEFORE,
                0.33, 0.0, 0.15, _PAPER),
        _tissue("enhancing", 1550.0, "within the range for tumours, " + _DUCK, 1.63, "glioma, as for tumour", 0.60,
                "between brain and tumour", 0.70, 0.0, 0.35, _level("vessels, choroid plexus: 7 dB above white")),
        _tissue("tumour", 1550.0, "within the range for tumours, " + _DUCK, 1.63, "slightly denser than brain", 0.70,
                "more than brain, " + _DUCK, 0.60, 0.0, 0.28, _level("about 6 dB above white matter")),
        _tissue("falx", 1600.0, "collagenous membrane, " + _DUCK, 1.80, f"dura 1174 kg/m3 {_DENSITY}, softened", 1.0,
                "connective tissue, " + _DUCK, 0.90, 0.0, 0.45, _level("about 10 dB above white matter")),
        _tissue("leptomeninges", 1541.0, "as brain: too thin to matter", 1.607, "as brain", 0.54, "as brain",
                0.90, 0.0, 0.50, _level("about 9 dB above white matter: arachnoid, pia, vessels in sulci; ependyma")),
        _tissue("skull", 2814.0, f"skull, {_ITIS}", 5.37, f"1908 kg/m3 {_DENSITY}", 7.8, f"skull, {_DUCK}",
                0.50, 0.0, 0.30, _level("masked by its own surface echo")),
        _tissue("scalp", 1624.0, f"skin, {_ITIS}", 1.80, f"skin 1109 kg/m3 {_DENSITY}", 0.80, f"skin, {_DUCK}",
                0.60, 0.0, 0.30, _level("echogenic skin and fat")),
        _tissue("blood", 1584.0, _SZABO, 1.679, f"1060 kg/m3, {_SZABO}", 0.14, _SZABO, 0.03, 0.0, 0.02,
                _level("some 20 dB below tissue at 5 MHz")),
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
        _tissue("bone", 3198.0, _SZABO, 6.364, f"1990 kg/m3, {_SZABO}", 3.54, _SZABO, 0.50, 0.0, 0.30,
                _level("masked by its own surface echo")),
    )
}

# fmt: on

#: Other names for the same tissue, as label maps and segmentations use them.
_ALIASES = {
    "background": "coupling", "cerebrospinal fluid": "csf", "ventricles": "csf", "cyst": "csf",
    "gray matter": "grey matter",
    "gm": "grey matter", "wm": "white matter", "tumor": "tumour", "dura": "falx", "skin": "scalp", "vessels": "blood",
    "vessel": "blood", "cortical bone": "bone", "choroid plexus": "enhancing",
}  # fmt: skip


#: What a longer name, such as FreeSurfer's or a colleague's, is taken for by a word in it; the first that is found.
_WORDS = {
    "white matter": "white matter", "corpus callosum": "white matter", "ventricle": "csf", "csf": "csf",
    "choroid plexus": "enhancing", "grey matter": "grey matter", "gray matter": "grey matter", "cortex": "grey matter",
    "ctx": "grey matter", "thalamus": "grey matter", "caudate": "grey matter", "putamen": "grey matter",
    "pallidum": "grey matter", "hippocampus": "grey matter", "amygdala": "grey matter", "accumbens": "grey matter",
    "brain stem": "white matter", "tumor": "tumour", "tumour": "tumour", "glioma": "tumour", "metastasis": "tumour",
    "meningioma": "tumour", "falx": "falx", "tentorium": "falx", "dura": "falx", "artery": "blood", "vein": "blood",
    "vessel": "blood", "sinus": "blood", "skull": "skull", "scalp": "scalp", "skin": "scalp", "bone": "bone",
    "muscle": "muscle", "liver": "liver", "kidney": "kidney", "fat": "fat", "cyst": "csf", "air": "air",
}  # fmt: skip


def _plain_name(name: str) -> str:
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


def same_name(a: str, b: str) -> bool:
    """Whether two names differ only in case, hyphens and underscores."""
    return _plain_name(a) == _plain_name(b)


def tissue_named(name: str) -> Tissue:
    """The preset for a tissue name: case, usual synonyms, and words in a longer name ("Left-Cerebral-White-Matter").

    Raises SimulationError for a name that means none of them.
    """
    key = _plain_name(name)
    key = _ALIASES.get(key, key)
    if key not in TISSUES:
        texts = f" {key} ", f" {key} ".replace("s ", " ")  # as it stands, and without plurals
        key = next((tissue for word, tissue in _WORDS.items() if any(f" {word} " in text for text in texts)), key)
    require(key in TISSUES, f"no preset for tissue {name!r}, expected one of: {', '.join(TISSUES)}")
    return TISSUES[key]


#: Colours of tissues in pictures, label maps and segmentations: quiet and distinguishable; red, green, blue, 0 to 1.
_COLOURS = {
    "csf": (0.17, 0.37, 0.54), "grey matter": (0.55, 0.55, 0.55), "white matter": (0.91, 0.89, 0.85),
    "leptomeninges": (0.78, 0.35, 0.33), "enhancing": (0.85, 0.64, 0.25), "tumour": (0.37, 0.62, 0.43),
    "falx": (0.56, 0.42, 0.70), "blood": (0.75, 0.10, 0.10), "skull": (0.95, 0.93, 0.75), "bone": (0.95, 0.93, 0.75),
    "scalp": (0.87, 0.72, 0.63), "fat": (0.93, 0.83, 0.45), "muscle": (0.70, 0.33, 0.29), "liver": (0.52, 0.23, 0.19),
    "kidney": (0.65, 0.30, 0.25), "water": (0.30, 0.60, 0.85), "gel": (0.45, 0.75, 0.85), "air": (0.85, 0.95, 1.0),
}  # fmt: skip
_OTHER_COLOUR = (0.3, 0.75, 0.8)


def colour_of(tissue_name: str) -> tuple[float, float, float]:
    """Red, green, blue from 0 to 1 of a tissue in pictures, label maps and segmentations."""
    return _COLOURS.get(tissue_name, _OTHER_COLOUR)


class TissueTable(Mapping):
    """Which tissue every label stands for: a read-only mapping {label: Tissue}, and the membrane, if any.

    Label 0 is the coupling medium around the patient and is added when it is not given.
    Raises SimulationError for labels outside 0..62.
    """

    def __init__(self, tissues: Mapping[int, Tissue], membrane: Membrane | None = None) -> None:
        table = {}
        for label, tissue in tissues.items():
            require(
                isinstance(label, int | np.integer) and 0 <= label <= MAX_LABEL,
                f"tissue label is {label!r}, expected a whole number from 0 to {MAX_LABEL}",
            )
            require(isinstance(tissue, Tissue), f"label {label}: {tissue!r} is not a Tissue")
            table[int(label)] = tissue
        table.setdefault(0, TISSUES["coupling"])
        self._tissues = dict(sorted(table.items()))
        self.membrane = membrane

    def __getitem__(self, label: int) -> Tissue:
        return self._tissues[label]

    def __iter__(self):
        return iter(self._tissues)

    def __len__(self) -> int:
        return len(self._tissues)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TissueTable) and (self._tissues, self.membrane) == (other._tissues, other.membrane)

    def __repr__(self) -> str:
        names = ", ".join(f"{label}: {tissue.name}" for label, tissue in self.items())
        return f"TissueTable({names}{'' if self.membrane is None else '; ' + self.membrane.tissue.name})"

    # ---- presets -----------------------------------------------------------------------------------------------

    @classmethod
    def brain(cls, tissue_names: Iterable[str] = ("csf", "grey matter", "white matter")) -> TissueTable:
        """Presets for labels 1, 2, ... named `tissue_names`, with leptomeninges and ependyma as the membrane."""
        return cls.named(tissue_names, Membrane(TISSUES["leptomeninges"]))

    @classmethod
    def named(cls, tissue_names: Iterable[str], membrane: Membrane | None = None) -> TissueTable:
        """Presets for labels 1, 2, ... by name, for the body as for the brain. SimulationError for a new one."""
        return cls({label: tissue_named(name) for label, name in enumerate(tissue_names, 1)}, membrane)

    def label_of(self, name: str) -> int:
        """The label of a tissue by name. Raises SimulationError if the table has none of that name."""
        for label, tissue in self.items():
            if tissue.name == name:
                return label
        raise SimulationError(f"no tissue named {name!r} in the table, expected one of: {', '.join(self.names())}")

    def names(self) -> list[str]:
        """Tissue names in the order of their labels."""
        return [tissue.name for tissue in self.values()]

    def all_tissues(self) -> list[Tissue]:
        """Tissues in the order of their labels, the membrane's last."""
        return [*self.values(), *([] if self.membrane is None else [self.membrane.tissue])]

    def tissue(self, name: str) -> Tissue:
        """The tissue of that name, the membrane's too. Raises SimulationError that lists the names if there is none."""
        for tissue in self.all_tissues():
            if tissue.name == name:
                return tissue
        names = dict.fromkeys(tissue.name for tissue in self.all_tissues())
        raise SimulationError(f"no tissue named {name!r}, expected one of: {', '.join(names)}")

    def with_tissue(self, tissue: Tissue) -> TissueTable:
        """A new table in which everything of that name, the membrane too, is `tissue`; added if nothing is."""
        labels = [label for label, old in self.items() if old.name == tissue.name]
        membrane = self.membrane
        if membrane is not None and membrane.tissue.name == tissue.name:
            membrane = replace(membrane, tissue=tissue)
        elif not labels:
            labels = [next(label for label in range(MAX_LABEL + 1) if label not in self)]
        return TissueTable({**self, **dict.fromkeys(labels, tissue)}, membrane)

    def replace(self, name: str, **changes) -> TissueTable:
        """A new table in which the tissue `name` (the membrane's too) has the given parameters changed."""
        known = {field.name for field in fields(Tissue)}
        for parameter in changes:
            require(
                parameter in known,
                f"{parameter!r} is not a tissue parameter, expected one of: {', '.join(sorted(known))}",
            )
        if self.membrane is not None and name == self.membrane.tissue.name and name not in self.names():
            return TissueTable(self, replace(self.membrane, tissue=replace(self.membrane.tissue, **changes)))
        label = self.label_of(name)
        return TissueTable({**self, label: replace(self[label], **changes)}, self.membrane)

    def for_names(self, names: Iterable[str]) -> TissueTable:
        """A table for labels 1, 2, ... named `names`: every tissue from this table if it has one of that name, else
        from the presets; coupling medium and membrane stay.

        Raises SimulationError that lists the names nobody knows.
        """
        mine = {_plain_name(tissue.name): tissue for tissue in self.values()}
        table, unknown = {0: self[0]}, []
        for label, name in enumerate(names, 1):
            try:
                table[label] = mine.get(_plain_name(name)) or tissue_named(name)
            except SimulationError:
                unknown.append(name)
        require(
            not unknown,
            f"no tissue for {', '.join(map(repr, unknown))}, expected names among: {', '.join(TISSUES)}",
        )
        return TissueTable(table, self.membrane)

    def with_membrane(self, membrane: Membrane | None) -> TissueTable:
        """A new table with another membrane, or none."""
        return TissueTable(self, membrane)

    # ---- JSON --------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict:
        """Plain values; from_dict reads them back."""
        values = {"tissues": {str(label): _plain(tissue) for label, tissue in self.items()}}
        if self.membrane is not None:
            values["membrane"] = {
                "tissue": _plain(self.membrane.tissue),
                "thickness_mm": self.membrane.thickness_mm,
                "fluids": list(self.membrane.fluids),
            }
        return values

    @classmethod
    def from_dict(cls, values: dict, source: str = "tissues") -> TissueTable:
        """The table described by to_dict. Raises SimulationError naming `source` and what is wrong in it."""
        require(
            isinstance(values, dict) and isinstance(values.get("tissues"), dict),
            f'{source}: expected {{"tissues": {{"1": {{...}}}}}}',
        )
        try:
            table = {int(label): Tissue(**tissue) for label, tissue in values["tissues"].items()}
            membrane = values.get("membrane")
            if membrane is not None:
                membrane = Membrane(**{**membrane, "tissue": Tissue(**membrane["tissue"])})
            return cls(table, membrane)
        except SimulationError as error:
            raise SimulationError(f"{source}: {error}") from None
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise SimulationError(f"{source}: not a tissue table ({error})") from None

    @classmethod
    def read(cls, path: str | os.PathLike) -> TissueTable:
        """Read a table from JSON. Raises SimulationError for a missing, unreadable or wrong file."""
        return cls.from_dict(read_json(path), str(path))

    def write(self, path: str | os.PathLike) -> None:
        """Write the table as JSON, whole or not at all."""
        write_json(path, self.to_dict())


def _plain(tissue: Tissue) -> dict:
    return {**asdict(replace(tissue, sources={})), "sources": dict(tissue.sources)}


def tissues_beside(labels: Path) -> Path:
    """Where the tissue table of a label map lies: beside it, .json."""
    name = labels.name
    for suffix in (".nii.gz", labels.suffix):
        if suffix and name.endswith(suffix):
            return labels.with_name(name[: -len(suffix)] + ".json")
    return labels.with_name(name + ".json")


def read_json(path: str | os.PathLike):
    """The content of a JSON file. Raises SimulationError naming the file."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise SimulationError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise SimulationError(f"{path}: is not JSON ({error})") from None


def write_json(path: str | os.PathLike, values) -> None:
    """Write plain values as JSON, whole or not at all."""
    with written_whole(path) as partial:
        partial.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
