"""The pictures of docs/gallery.md: python examples/gallery.py [-o gallery] [--rows 300]"""

from __future__ import annotations

import argparse
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont

from SlicerUSSim.Logic import DisplaySettings, TissueTable, UltrasoundSimulator, Volume, segment_mri
from SlicerUSSim.Logic.datasets import Recipe, SimulatedImages, make_dataset
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.placement import view_pose
from SlicerUSSim.Logic.probe import PROBES, ImageGrid, craniotomy_pose, slice_under_probe, tilt_sweep, turned
from SlicerUSSim.Logic.tissue.presets import colour_of

DISPLAY = DisplaySettings(gain_db=8.0)


def save(path: Path, rows: int, images: dict[str, np.ndarray], aspect: float = 1.0) -> None:
    """Write uint8 images under their titles side by side; `aspect` is the width of a pixel by its height."""
    parts = []
    for title, image in images.items():
        width = round(rows * aspect * image.shape[1] / image.shape[0])
        parts.append(Image.new("RGB", (width + 6, rows + 30)))
        parts[-1].paste(Image.fromarray(image).resize((width, rows), Image.Resampling.LANCZOS), (0, 30))
        ImageDraw.Draw(parts[-1]).text((5, 3), title, fill="white", font=ImageFont.load_default(20))
    Image.fromarray(np.hstack(parts)).save(path, quality=80, optimize=True)


def grey(values: np.ndarray, white: float = 1.0) -> np.ndarray:
    """uint8 of values from 0 to `white`."""
    return (255.0 * (values / white).clip(0.0, 1.0)).astype(np.uint8)


def colours(labels: np.ndarray, names: dict[int, str]) -> np.ndarray:
    """(rows, columns, 3) from 0 to 1: colours of tissues; label 0 is black."""
    table = np.zeros((256, 3))
    for label in filter(None, names):
        table[label] = colour_of(names[label])
    return table[labels]


def third_of(recipe: str) -> tuple[dict[str, np.ndarray], dict[int, str], float]:
    """(outputs, tissues by label, aspect of pixels) of the third image of a recipe."""
    text = re.sub(r"^images = .*$", "images = 3", Recipe.read(recipe).text, flags=re.MULTILINE)
    text = re.sub(r"^each = .*$", "each = 1", text, flags=re.MULTILINE)  # tumours
    with tempfile.TemporaryDirectory() as folder:
        make_dataset(Recipe.of_text(text), folder, workers=1)
        images = SimulatedImages(folder)
        across, down, *_ = np.diag(images[2]["image_to_probe"])
        return images[2], images.labels, across / down


def abdomen() -> UltrasoundSimulator:
    """Skin, fat, muscle, and a liver with vessels, gallbladder and stone; y is depth."""
    x, y, z = np.meshgrid(np.arange(-110.0, 111.0), np.arange(-30.0, 170.0), np.arange(-15.0, 16.0), indexing="ij")
    from_face = np.hypot(x, y + 60.0) - 60.0  # the radius of the probe
    labels = np.digitize(from_face, [0.0, 2.0, 12.0, 20.0]).astype(np.uint8)
    vessels, gallbladder, stone = 5, 6, 7
    for label, right, deep, radii, turn in (
        (vessels, -8, 62, (34, 4, 8), 0.5), (vessels, 28, 38, (22, 3, 8), -0.5), (vessels, -45, 60, (5, 5, 99), 0),
        (vessels, -20, 118, (10, 10, 99), 0), (gallbladder, 35, 85, (14, 26, 16), 0.3), (stone, 30, 104, (4, 4, 4), 0),
    ):  # fmt: skip
        along = (x - right) * np.cos(turn) + (y - deep) * np.sin(turn)
        down = (y - deep) * np.cos(turn) - (x - right) * np.sin(turn)
        labels[np.square([along / radii[0], down / radii[1], z / radii[2]]).sum(axis=0) < 1.0] = label
    ijk_to_ras = np.eye(4) + np.outer([x.min(), y.min(), z.min(), 0.0], [0, 0, 0, 1])
    names = ("skin", "fat", "muscle", "liver", "blood", "cyst", "bone")
    return UltrasoundSimulator(Volume(labels.T, ijk_to_ras), TissueTable.named(names))


def main(out: Path, rows: int) -> None:
    out.mkdir(parents=True, exist_ok=True)
    mri, _ = demo_mri()
    found = segment_mri(mri, thin_sulci=True)
    names = found.tissue_names
    brain = UltrasoundSimulator(found.labels, TissueTable.brain(names), texture=found.texture())
    pose = craniotomy_pose(found.labels, PROBES["phased"])
    seen = {name: brain.simulate(PROBES[name], pose, DISPLAY).image for name in ("phased", "microconvex", "burr_hole")}
    grid = ImageGrid.for_probe(PROBES["phased"], None)
    mri, labels = slice_under_probe(mri, grid, pose), slice_under_probe(found.labels, grid, pose, order=0)
    tissues = colours(labels, dict(enumerate(names, 1)))
    save(out / "brain.jpg", rows, {"MRI": grey(mri, mri.max()), "tissues": grey(tissues), "image": seen["phased"]})
    save(out / "probes.jpg", rows, seen)
    views = {name: view_pose(found.labels, names, name)[0] for name in ("fontanelle", "fontanelle-sagittal")}
    images = {name: brain.simulate(PROBES["neonatal"], view, DISPLAY).image for name, view in views.items()}
    save(out / "views.jpg", rows, images)

    volume = brain.volume(PROBES["phased"], tilt_sweep(pose, angle_deg=80.0, frames=81), DISPLAY)
    level = pose @ [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 60.0], [0.0, 1.0, 0.0, -45.0], [0.0, 0.0, 0.0, 1.0]]
    planes = {"image plane": pose, "across": turned(pose, rotate_deg=90.0), "60 mm deep": level}
    cuts = {name: slice_under_probe(volume, grid, plane).astype(np.uint8) for name, plane in planes.items()}
    save(out / "volume.jpg", rows, cuts)
    liver, probe = abdomen(), PROBES["abdominal"]
    probes = {"3.5 MHz": probe, "harmonic of 1.75 MHz": replace(probe, frequency_mhz=1.75, harmonic=True)}
    images = {name: liver.simulate(probe, np.eye(4), DISPLAY).image for name, probe in probes.items()}
    save(out / "abdomen.jpg", rows, images)

    item, tissue_of, aspect = third_of("brain-tumour")
    over = 0.75 / 255.0 * item["image"][..., None] + 0.45 * colours(item["labels_as_imaged"], tissue_of)
    save(out / "tumour.jpg", rows, {"image": item["image"], "labels_as_imaged": grey(over)}, aspect)
    item, _, aspect = third_of("denoising")
    save(out / "denoising.jpg", rows, {name: item[name] for name in ("image", "clean")}, aspect)
    item, _, aspect = third_of("mri-registration")
    item["mri"] = grey(item["mri"], item["mri"].max())
    item["walls"] = grey(colormaps["inferno"](item["walls"] / 0.04)[..., :3])
    save(out / "registration.jpg", rows, {name: item[name] for name in ("image", "mri", "walls")}, aspect)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("gallery"))
    parser.add_argument("--rows", type=int, default=300, help="height of the images in pixels")
    main(**vars(parser.parse_args()))
