"""Train a small U-Net of MONAI on a set of `ussim dataset`: python examples/train_unet.py FOLDER [TISSUE]

    pip install "SlicerUSSim[datasets]" monai
    ussim dataset ventricles -o FOLDER && python examples/train_unet.py FOLDER ventricle

The last tenth of the images is for the test; prints the mean Dice coefficient there after each epoch.
"""

from __future__ import annotations

import sys
from pathlib import Path

from SlicerUSSim.Logic.datasets import SimulatedImages


def train(folder: Path, tissue: str = "ventricle", epochs: int = 10) -> float:
    """The mean Dice coefficient of the last epoch on the test images."""
    import torch  # type: ignore[import-not-found]
    from monai.data import Dataset  # type: ignore[import-not-found]
    from monai.losses import DiceCELoss  # type: ignore[import-not-found]
    from monai.metrics import DiceMetric  # type: ignore[import-not-found]
    from monai.networks.nets import UNet  # type: ignore[import-not-found]
    from monai.transforms import Compose, EnsureChannelFirstd, Lambdad, ScaleIntensityRanged, ToTensord  # type: ignore[import-not-found]

    label = next(number for number, name in SimulatedImages(folder).labels.items() if name == tissue)
    steps = Compose([
        EnsureChannelFirstd(["image", "labels"], channel_dim="no_channel"),
        ScaleIntensityRanged("image", 0, 255, 0, 1),
        Lambdad("labels", lambda labels: (labels == label).astype("float32")),
        ToTensord(["image", "labels"]),
    ])  # fmt: skip
    images = Dataset(SimulatedImages(folder, ["image", "labels"]), steps)
    first = len(images) - max(len(images) // 10, 1)
    train_part, test_part = (
        torch.utils.data.Subset(images, part) for part in (range(first), range(first, len(images)))
    )
    network = UNet(2, 1, 1, channels=(16, 32, 64, 128), strides=(2, 2, 2), num_res_units=2)
    optimizer, loss = torch.optim.Adam(network.parameters(), 1e-3), DiceCELoss(sigmoid=True)
    metric = DiceMetric(ignore_empty=False)
    for epoch in range(epochs):
        network.train()
        for batch in torch.utils.data.DataLoader(train_part, batch_size=8, shuffle=True):
            optimizer.zero_grad()
            loss(network(batch["image"]), batch["labels"]).backward()
            optimizer.step()
        network.eval()
        with torch.no_grad():
            for batch in torch.utils.data.DataLoader(test_part, batch_size=8):
                metric((network(batch["image"]) > 0).float(), batch["labels"])
        score = float(metric.aggregate())
        metric.reset()
        print(f"epoch {epoch + 1}: Dice {score:.2f}", file=sys.stderr)
    return score


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    train(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "ventricle")
