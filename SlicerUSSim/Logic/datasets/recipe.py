"""Recipe: what a data set is made of, read from TOML and checked: errors name the line and the key."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from SlicerUSSim.Logic.base.declaration import Declared, Parameter, built, parameter, parameters_of, short
from SlicerUSSim.Logic.base.errors import SimulationError, about_file, either, require, require_package
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.datasets.draws import Draw, generator
from SlicerUSSim.Logic.imaging.batch import OUTPUTS as SIMULATED
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.quality import line_shape, worked
from SlicerUSSim.Logic.mri.pathology import LESIONS
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings
from SlicerUSSim.Logic.placement.views import VIEWS
from SlicerUSSim.Logic.probe.arrays import PROBE_KINDS, PROBES, Probe
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.tissue import Tissue

#: {output: what it is}; those of simulate_batch, and what is computed from the patient
OUTPUTS = {
    "image": "B-mode", "labels": "tissue of every pixel", "labels_as_imaged": "the same as displaced by travel time",
    "depth": "mm along the scan line", "iq": "baseband signal", "rf": "radio-frequency signal",
    "envelope": "envelope along the scan lines", "bmode": "grey levels along the scan lines",
    "clean": "mean of images with other speckle and noise", "mri": "MRI or CT in the image plane",
    "attenuation": "one-way dB along straight lines", "travel_time": "µs there and back along straight lines",
    "walls": "reflection coefficient of the border at a pixel",
}  # fmt: skip
#: Formats, each with the package that it needs, if any
FORMATS = {"zarr": "zarr", "hdf5": "h5py", "png": "", "tracked": ""}
#: Outputs of the formats of pictures
_PICTURES = ("image", "labels", "labels_as_imaged", "clean")
#: Recipes that come with the package, by name
READY = {path.stem: path for path in sorted((Path(__file__).parent / "recipes").glob("*.toml"))}
#: Bundled patients, which need no file
BUNDLED = ("mni152", "synthetic")
ALL = "all"
VENTRICLE = "ventricle"
#: Names of the labels in all sets: the label is the place; and the label of all other tissues
CLASSES, OTHER = (*TISSUES, VENTRICLE), 255
#: Probes that are drawn for a set: the record of a new one takes 20 ms
PROBE_POOL = 16
#: Images of a shard, and bytes of its arrays, of which an image has so many for each of its signals
_MOST_PER_SHARD, _SHARD_BYTES, _SIGNAL_BYTES = 64, 24e6, 1.6e6
#: Parameters that are fixed: all images have one size, and a simulator is built with them
_FIXED = (
    "display.image_size", "settings.quality", "settings.partial_volume", "settings.mri_modulation_db",
    "settings.reference_speed_m_s", "settings.samples_per_cycle", "pose.on", "pose.file", "pose.transform",
    "pose.within_deg", "pose.aim", "lesions.each",
)  # fmt: skip
_DEGREES = {"unit": "°", "bounds": (-180.0, 180.0)}


@dataclass(frozen=True)
class SetSettings(Declared):
    """What a recipe says before its tables."""

    images: int = parameter(label="Images", tip="Number of images", bounds=(1, 10**9))
    seed: int = parameter(0, "Seed", "Seed of all random draws", bounds=(0, 2**32 - 1))
    outputs: tuple[str, ...] = parameter(("image", "labels"), "Outputs", "Saved results of every image")
    format: str = parameter("zarr", "Format", "Format of the files", choices=tuple(FORMATS))
    shard: int | None = parameter(None, "Shard", "Images of a file; none: up to 64", bounds=(1, 100_000))
    title: str = parameter("Simulated ultrasound", "Title", "Title of the set")
    licence: str = parameter("", "Licence", "Licence of the set")


@dataclass(frozen=True)
class PatientSettings(Declared):
    """One of `[[patients]]`."""

    file: str = parameter(label="File", tip="MRI, CT or label map, beside the recipe, or mni152 or synthetic")
    ventricles: bool = parameter(False, "Ventricles", "Label the ventricles of an MRI apart from other CSF")
    add: Mapping[str, str] = parameter(
        label="Add", tip="Masks laid over the labels, by tissue: {tumour = mask.nii.gz}", default_factory=dict
    )
    licence: str = parameter("", "Licence", "Licence of the file")
    citation: str = parameter("", "Citation", "How the file is cited")
    segmentation: SegmentationSettings = field(default=SegmentationSettings())


@dataclass(frozen=True)
class PoseSettings(Declared):
    """Where a probe stands: `[pose]`; angles, places and `view` may be distributions."""

    on: str = parameter(
        "craniotomy", "On", "Where poses begin", choices=("craniotomy", "skin", "surface", "view", "path", "sequence")
    )
    view: str = parameter("temporal", "View", "Standard view", choices=tuple(VIEWS))
    file: str = parameter("", "File", "Curve (.mrk.json) of a path, or tracked sequence")
    transform: str = parameter("ProbeToReference", "Transform", "Pose of the probe in a tracked sequence")
    within_deg: float = parameter(90.0, "Within", "Largest angle from the top", unit="°", bounds=(0, 180))
    aim: str = parameter("", "Aim", "Tissue at which the probe looks, at its innermost voxel")
    right_deg: float = parameter(0.0, "Right", "Shift over the surface to the right", **_DEGREES)
    front_deg: float = parameter(0.0, "Front", "Shift over the surface to the front", **_DEGREES)
    rock_deg: float = parameter(0.0, "Rock", "Rotation in the image plane", **_DEGREES)
    tilt_deg: float = parameter(0.0, "Tilt", "Rotation out of the image plane", **_DEGREES)
    rotate_deg: float = parameter(0.0, "Rotate", "Rotation about the axis", **_DEGREES)
    lift_mm: float = parameter(0.0, "Lift", "Retraction along the axis", unit="mm", bounds=(-20, 50))


@dataclass(frozen=True)
class LesionSettings(Declared):
    """Balls with a rough surface, each in a part of the images: `[lesions]`; all but `each` may be distributions."""

    each: int = parameter(4, "Each", "Lesions of every patient, one at a time", bounds=(1, 10_000))
    tissue: str = parameter("tumour", "Tissue", "Its tissue", choices=tuple(n for n in LESIONS if n != "brats"))
    radius_mm: float = parameter(10.0, "Radius", "Mean radius", unit="mm", bounds=(2, 50))
    depth_mm: float = parameter(25.0, "Depth", "From the brain's surface to the centre", unit="mm", bounds=(0, 80))
    roughness: float = parameter(0.25, "Roughness", "Relative deviation of the radius", bounds=(0, 0.6))


def _entries(*kinds: type) -> dict[str, Parameter]:
    return {entry.name: entry for kind in kinds for entry in parameters_of(kind)}


_PROBE = Parameter(name="name", type=str, label="Name", tip="Probe", default="phased", choices=tuple(PROBES))
#: {table: {name: Parameter}} of draws that do not belong to a tissue; and what is drawn by default
_KNOWN = {
    "pose": _entries(PoseSettings), "probe": {"name": _PROBE, **_entries(*PROBE_KINDS.values())},
    "display": _entries(DisplaySettings), "settings": _entries(SimulationSettings), "lesions": _entries(LesionSettings),
}  # fmt: skip
_DEFAULTS = {
    **{name: {key: Draw(one, (one.default,)) for key, one in _KNOWN[name].items()} for name in ("pose", "lesions")},
    "probe": {"name": Draw(_PROBE, (_PROBE.default,))},
    "display": {"image_size": Draw(_KNOWN["display"]["image_size"], ((256, 256),))},
    "settings": {"seed": Draw(_KNOWN["settings"]["seed"], (0, 2**32 - 1), "uniform")},
}
_TABLES = ("patients", "tissues", *_KNOWN)


class Case(NamedTuple):
    """A patient, with one lesion or none, and the first image of it."""

    number: int
    patient: int
    image: int


@dataclass(frozen=True, eq=False)
class Recipe:
    """A checked recipe. Image i depends on (seed, i) alone; images of one patient follow each other."""

    settings: SetSettings
    patients: tuple[PatientSettings, ...]
    #: {section: {name: Draw}}
    draws: Mapping[str, Mapping[str, Draw]]
    #: {tissue or "all": {name: Draw}}
    tissues: Mapping[str, Mapping[str, Draw]]
    #: Of every patient, one at a time
    lesions: int
    text: str
    #: Files are beside it
    folder: Path

    @classmethod
    def read(cls, path: str | Path) -> Recipe:
        """From a file, or one of READY by its name. Raises SimulationError that names file, line and key."""
        path = READY.get(str(path), Path(path))
        require(path.is_file(), f"{path}: does not exist, expected a recipe in TOML, or one of {', '.join(READY)}")
        return cls.of_text(path.read_text(encoding="utf-8", errors="replace"), str(path), path.parent)

    @classmethod
    def of_text(cls, text: str, source: str = "recipe", folder: Path | None = None) -> Recipe:
        """From TOML; relative files are in `folder`."""
        return _Reader(text, source).recipe(folder or Path())

    def fixed(self, section: str, name: str) -> Any:
        """A value that is the same for all images."""
        return self.draws[section][name].values[0]

    @cached_property
    def shard(self) -> int:
        """Images of a shard, except for the last."""
        pixels, signals = np.prod(self.fixed("display", "image_size")), len(self.signals)
        image_bytes = 4 * pixels * (len(self.settings.outputs) - signals) + _SIGNAL_BYTES * signals
        most = min(_MOST_PER_SHARD, self.settings.images // self.cases, int(_SHARD_BYTES / image_bytes))
        return self.settings.shard or max(most, 1)

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.settings.images // self.shard)

    def images_of(self, shard: int) -> range:
        """Numbers of the images of a shard."""
        return range(shard * self.shard, min((shard + 1) * self.shard, self.settings.images))

    @property
    def cases(self) -> int:
        """Number of patients, or of their lesions, which have as many shards each."""
        return len(self.patients) * max(self.lesions, 1)

    def case_of(self, shard: int) -> Case:
        """The case of a shard."""
        number = ((shard + 1) * self.cases - 1) // self.shards
        return Case(number, number // max(self.lesions, 1), number * self.shards // self.cases * self.shard)

    def drawn(self, image: int) -> dict[str, dict[str, Any]]:
        """{section: {name: value}} of an image without its tissues; probe.number is its place in `probes`."""
        probe = int(generator(self.settings.seed, image, "probe").integers(len(self.probes)))
        numbers = {"probe": probe, "lesions": self.case_of(image // self.shard).number}
        found = {section: self._of(section, numbers.get(section, image)) for section in _KNOWN}
        return found | {"probe": {"number": probe, **found["probe"]}}

    def _of(self, section: str, number: int) -> dict[str, Any]:
        """What is drawn for an image; or for a probe, or the lesion of a case, which several images have."""
        draws, seed = self.draws[section], self.settings.seed
        return {
            name: draw.values[0] if draw.is_fixed else draw(generator(seed, number, f"{section}.{name}"))
            for name, draw in draws.items()
        }

    @cached_property
    def probes(self) -> tuple[Probe, ...]:
        """The probes of the set; one if none of their values is drawn."""
        is_fixed = all(draw.is_fixed for draw in self.draws["probe"].values())
        drawn = [self._of("probe", number) for number in range(1 if is_fixed else PROBE_POOL)]
        return tuple(Preset(PROBES[one.pop("name")]).changed("probe", **one).probe for one in drawn)

    @property
    def signals(self) -> tuple[str, ...]:
        """Outputs along the scan lines."""
        return tuple(name for name in self.settings.outputs if name in SIMULATED and not SIMULATED[name][2])

    @cached_property
    def worked(self) -> list[tuple[Probe, SimulationSettings]]:
        """Each probe as images are computed with it, and their fixed settings.

        Raises SimulationError if there are signals and they would not have one shape.
        """
        fixed = {name: draw.values[0] for name, draw in self.draws["settings"].items() if draw.is_fixed}
        columns = self.fixed("display", "image_size")[1]
        found = [worked(probe, replace(SimulationSettings(), **fixed), columns) for probe in self.probes]
        shapes = sorted({line_shape(*each) for each in found})
        require(
            not self.signals or len(shapes) == 1,
            f"{', '.join(self.signals)} would have {shapes[0]} to {shapes[-1]} scan lines and samples, expected one "
            "shape for all images; fix name, depth_mm, frequency_mhz and scan_lines",
        )
        return found


class _Reader:
    """Checks the values of a TOML text."""

    def __init__(self, text: str, source: str) -> None:
        self.text, self.source, self.lines = text, source, dict(_lines(text))
        if sys.version_info >= (3, 11):
            import tomllib
        else:
            require_package("tomli", "SlicerUSSim[datasets]", "a recipe")
            import tomli as tomllib  # type: ignore[import-not-found]
        try:
            self.values: dict[str, Any] = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise SimulationError(f"{source}: is not TOML ({error})") from None

    def at(self, *path: object) -> str:
        """File and line of a key, or of the table around it."""
        place = next((path[:n] for n in range(len(path), 0, -1) if path[:n] in self.lines), None)
        return f"{self.source}: line {self.lines[place]}" if place else self.source

    def items(self, given: Any, names: Collection[str], *path: object) -> Iterator[tuple[str, Any, str]]:
        """(name, value, where it is) of a table whose names are among these."""
        is_table = isinstance(given, dict)
        require(is_table, f"{self.at(*path)}: {' '.join(map(str, path))} is {short(given)}, expected a table")
        for name, value in given.items():
            where = self.at(*path, name)
            require(name in names, f"{where}: {short(name)} is unknown, expected one of {', '.join(names)}")
            yield name, value, where

    def plain(self, kind: type, given: Any, *path: object, tables: Collection[str] = ()) -> Any:
        """A `kind` of fixed values; beside them there may be tables."""
        known = _entries(kind)
        for name, value, where in self.items(given, [*known, *tables], *path):
            if name in known:
                known[name].checked(where, value)
        return built(kind, {name: value for name, value in given.items() if name in known}, self.at(*path))

    def drawn(self, kinds: Mapping[str, Parameter], given: Any, *path: str) -> dict[str, Draw]:
        """{name: Draw} of a table."""
        found = {}
        for name, value, where in self.items(given, kinds, *path):
            found[name] = Draw.of(value, kinds[name], where, may_be_relative=path[0] == "tissues")
            is_free = f"{path[0]}.{name}" not in _FIXED or found[name].is_fixed
            require(is_free, f"{where}: {name} is {short(value)}, expected one value for all images")
        return found

    def recipe(self, folder: Path) -> Recipe:
        settings = self.plain(SetSettings, self.values, tables=_TABLES)
        outputs = f"outputs are {short(settings.outputs)}, expected some of {', '.join(OUTPUTS)}"
        require(set(settings.outputs) <= set(OUTPUTS), f"{self.at('outputs')}: {outputs}")
        other = ", ".join(name for name in settings.outputs if name not in _PICTURES)
        holds = f"format {settings.format} holds {either(_PICTURES)}, and outputs have {other}, expected zarr or hdf5"
        require(FORMATS[settings.format] or not other, f"{self.at('format')}: {holds}")
        draws = {
            name: _DEFAULTS[name] | self.drawn(known, self.values.get(name, {}), name) for name, known in _KNOWN.items()
        }
        on, file = (draws["pose"][name].values[0] for name in ("on", "file"))
        needs = f"on is {on}, which needs {'no' if file else 'a'} file"
        require((on in ("path", "sequence")) == bool(file), f"{self.at('pose', 'on')}: {needs}")
        numbers = {name: entry for name, entry in _entries(Tissue).items() if entry.type is float}
        of_tissues = self.items(self.values.get("tissues", {}), (ALL, *TISSUES), "tissues")
        tissues = {name: self.drawn(numbers, values, "tissues", name) for name, values, _ in of_tissues}
        lesions = draws["lesions"]["each"].values[0] if "lesions" in self.values else 0
        made = Recipe(settings, tuple(self.patients()), draws, tissues, lesions, self.text, folder)
        with about_file(self.at("probe")):
            _ = made.worked  # says which probes cannot be
        require(
            made.cases <= made.shards,
            f"{self.at('images')}: {settings.images} images are {made.shards} shards for {made.cases} patients with "
            "their lesions, expected one for each at least; make more images, or lower shard or lesions.each",
        )
        return made

    def patients(self) -> Iterator[PatientSettings]:
        given = self.values.get("patients", [])
        is_list = isinstance(given, list) and bool(given) and all(isinstance(one, dict) for one in given)
        require(is_list, f"{self.at('patients')}: patients is {short(given)}, expected [[patients]] with file = ...")
        for number, table in enumerate(given):
            path = ("patients", number)
            segmentation = self.plain(SegmentationSettings, table.get("segmentation", {}), *path, "segmentation")
            yield replace(self.plain(PatientSettings, table, *path, tables=["segmentation"]), segmentation=segmentation)


def _lines(text: str) -> Iterator[tuple[tuple, int]]:
    """(path of a key or table, its line) of a recipe; patients have their number in the path."""
    table, patient = (), -1
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*(\[\[?)(.+?)\]", line)
        key = re.match(r"\s*(\"[^\"]*\"|[\w.-]+)\s*=", line)
        if header:
            table = tuple(name.strip("'\"") for name in re.findall(r"\"[^\"]*\"|'[^']*'|[\w-]+", header[2]))
            if table[:1] == ("patients",):
                patient += header[1] == "[["
                table = ("patients", patient, *table[1:])
            yield from ((table, number), (table[:1], number))
        elif key:
            yield (*table, *key[1].strip('"').split(".")), number
