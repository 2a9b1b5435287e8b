"""Train on simulated images of one head, find the ventricles in those of another.

    pip install "SlicerUSSim[datasets]" scikit-learn
    python examples/find_ventricles.py FOLDER [MRI] [IMAGES] [CONTRAST]

A random forest learns pixels of IMAGES (500) simulated images of the MNI152 brain, by the recipe `ventricles`, and is
tested on a tenth as many of another head: MRI, of CONTRAST t1 (default), t1gd or t2, or one that was drawn. Prints the
Dice coefficient of all pixels together, with that of the best single threshold on grey levels beside it.
"""

from __future__ import annotations

import re
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.datasets import Recipe, SimulatedImages, make_dataset

#: Widths of the filters, pixels; pixels of each image that are learnt
SIGMAS, PIXELS = (1.0, 2.0, 4.0, 8.0, 16.0), 300


def made(folder: Path, patient: str, images: int, seed: int, contrast: str = "t1") -> SimulatedImages:
    """The set of a patient, which is made unless it is there."""
    text = Recipe.read("ventricles").text
    for name, value in (("images", images), ("seed", seed), ("file", f'"{patient}"')):
        text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
    text = text.replace("ventricles = true", f'ventricles = true\nsegmentation = {{contrast = "{contrast}"}}')
    make_dataset(Recipe.of_text(text, folder=Path.cwd()), folder)
    return SimulatedImages(folder)


def features(item: dict[str, np.ndarray]) -> np.ndarray:
    """(rows, columns, features) of an image: means, deviations and gradients around each pixel, and its depth."""
    image, field = item["image"].astype(np.float32), np.isfinite(item["depth"])
    found = [np.nan_to_num(item["depth"])]
    for sigma in SIGMAS:
        weight = ndimage.gaussian_filter(field.astype(np.float32), sigma) + 1e-3
        mean = ndimage.gaussian_filter(image * field, sigma) / weight
        square = ndimage.gaussian_filter(image**2 * field, sigma) / weight
        found += [mean, np.sqrt(np.maximum(square - mean**2, 0.0)), ndimage.gaussian_gradient_magnitude(mean, 1.0)]
    bands = [found[1 + 3 * n] for n in range(len(SIGMAS))]
    found += [low - high for low, high in pairwise(bands)]
    return np.stack(found, axis=-1)


def dice(found: np.ndarray, true: np.ndarray) -> float:
    """Dice coefficient of two masks."""
    return float(2 * (found & true).sum() / max(found.sum() + true.sum(), 1))


def find_ventricles(train: SimulatedImages, test: SimulatedImages) -> tuple[float, float]:
    """(Dice of a random forest, Dice of the best threshold on smoothed grey levels) on `test`."""
    from sklearn.ensemble import RandomForestClassifier  # type: ignore[import-not-found]

    label = next(number for number, name in train.labels.items() if name == "ventricle")
    random, inputs, outputs = np.random.default_rng(0), [], []
    for item in (train[n] for n in range(len(train))):
        inside, is_true = np.isfinite(item["depth"]), item["labels"] == label
        places = np.flatnonzero(inside & (is_true | (random.random(inside.shape) < 0.2)))
        places = random.choice(places, min(PIXELS, places.size), replace=False)
        inputs.append(features(item).reshape(inside.size, -1)[places])
        outputs.append(is_true.ravel()[places])
    forest = RandomForestClassifier(150, min_samples_leaf=8, class_weight="balanced", n_jobs=-1, random_state=0)
    forest.fit(np.concatenate(inputs), np.concatenate(outputs))
    shares, levels, truths = [], [], []
    for item in (test[n] for n in range(len(test))):
        inside, values = np.isfinite(item["depth"]), features(item)
        share = np.zeros(inside.shape)
        share[inside] = forest.predict_proba(values[inside])[:, 1]
        shares.append(ndimage.gaussian_filter(share, 2.0)[inside])
        levels.append(values[..., 4][inside])
        truths.append((item["labels"] == label)[inside])
    share, level, truth = map(np.concatenate, (shares, levels, truths))
    return dice(share > 0.5, truth), max(dice(level < limit, truth) for limit in range(2, 120, 2))


def main() -> None:
    folder = Path(sys.argv[1])
    patient = sys.argv[2] if len(sys.argv) > 2 else "synthetic"
    images = int(sys.argv[3]) if len(sys.argv) > 3 else 500
    contrast = sys.argv[4] if len(sys.argv) > 4 else "t1"
    train = made(folder / "train", "mni152", images, 1)
    test = made(folder / "test", patient, max(images // 10, 2), 2, contrast)
    forest, threshold = find_ventricles(train, test)
    print(f"Dice of the ventricles in {len(test)} images of {patient}: {forest:.2f}; by a threshold: {threshold:.2f}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main()
