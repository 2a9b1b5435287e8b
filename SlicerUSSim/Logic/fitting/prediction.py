"""Prediction: the cost of a fit on images that it has not seen, beside controls (docs/realism.md#fit-and-predict).

A cost on the images that were fitted flatters whatever has many parameters. So parameters found on some images are
judged on others, and the same is done with one uniform tissue without anatomy: fitted to the same images in the same
way, and judged on the same others. The floor is what real neighbours cost, which nothing needs to go below.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from SlicerUSSim.Logic.fitting.control_costs import FITTED, UNIFORM, Cost, mean_cost


@dataclass(frozen=True, eq=False)
class Prediction:
    """Costs of a fit and of its controls, on the images that were fitted and on others."""

    #: Numbers of the images in the recording
    fitted_numbers: list[int]
    numbers: list[int]
    #: {source: costs}; of the simulated images and the uniform tissue one per image, of real neighbours up to two
    fitted: dict[str, list[Cost]]
    predicted: dict[str, list[Cost]]
    #: {source: (rows, columns) uint8 images of `numbers`}
    images: dict[str, list[np.ndarray]] = field(repr=False)

    def mean(self, source: str, name: str = "paper", *, fitted: bool = False) -> float:
        """Mean of a source's "paper", "t1", "t2" or "sum"; NaN where there is none."""
        return mean_cost((self.fitted if fitted else self.predicted).get(source, []))[name]

    @property
    def of_uniform(self) -> float:
        """The predicted images' cost as a part of the uniform tissue's: below 1, the anatomy tells something."""
        return self.mean(FITTED) / self.mean(UNIFORM)

    def rows(self) -> list[tuple[str, float, float, float, float]]:
        """(source, the paper's cost and the sum on the fitted images, the same on the predicted ones)."""
        return [
            (
                source, self.mean(source, fitted=True), self.mean(source, "sum", fitted=True), self.mean(source),
                self.mean(source, "sum"),
            )
            for source in self.predicted
        ]  # fmt: skip

    def lines(self) -> list[str]:
        """A table as lines of text, and what it says."""
        listed = [", ".join(map(str, numbers)) for numbers in (self.fitted_numbers, self.numbers)]
        found = [f"cost (with texture)   fitted: images {listed[0]}   predicted: images {listed[1]}"]
        found += [
            f"{source:20s}  {row[0]:.3f} ({row[1]:.3f})   {row[2]:.3f} ({row[3]:.3f})" for source, *row in self.rows()
        ]
        return [*found, f"predicted images cost {self.of_uniform:.2f} of the uniform tissue's"]

    def to_dict(self) -> dict:
        """Plain values for JSON; what could not be measured is None."""

        def plain(costs: dict[str, list[Cost]]) -> dict:
            return {
                source: [
                    {name: value if np.isfinite(value) else None for name, value in cost.to_dict().items()}
                    for cost in each
                ]
                for source, each in costs.items()
            }

        return {
            "fitted_images": self.fitted_numbers,
            "images": self.numbers,
            "of_uniform": self.of_uniform if np.isfinite(self.of_uniform) else None,
            "fitted": plain(self.fitted),
            "predicted": plain(self.predicted),
        }
