"""A report of an optimisation as one self-contained HTML file: images, cost, parameters, identifiability."""

from __future__ import annotations

import html
import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory

import numpy as np

from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.fitting.control_costs import FITTED, UNIFORM, Prediction
from SlicerUSSim.Logic.fitting.identifiability import Spread
from SlicerUSSim.Logic.fitting.optimization import AGAIN, STAGES, AppearanceResult
from SlicerUSSim.Logic.fitting.parameters import Parameter
from SlicerUSSim.Logic.fitting.speckle_fit import SpeckleFit
from SlicerUSSim.Logic.fitting.texture_costs import TextureReference
from SlicerUSSim.Logic.imaging.figures import data_url, png_url, require_matplotlib
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tissue.presets import colour_of
from SlicerUSSim.Logic.tracked.imaged_field import draw_field
from SlicerUSSim.Logic.tracked.images import TrackedImages

_TEMPLATE = Path(__file__).parent / "report.html"
#: Stands for what the images of the fit are called
_REFERENCE = "\0reference\0"
_PAPER, _INK = "#161616", "#e4e4e4"
_BEFORE, _AFTER, _REAL = "#8a8a8a", "#ffc83d", "#6db3f2"


def write_report(
    path: str | os.PathLike,
    result: AppearanceResult,
    tracked: TrackedImages,
    before: list[np.ndarray],
    after: list[np.ndarray],
    simulator: UltrasoundSimulator,
    *,
    title: str | None = None,
    subtitle: str = "",
    provenance: str = "",
    prediction: Prediction | None = None,
    reference: str = "real",
    speckle: SpeckleFit | None = None,
) -> None:
    """Write the report; on failure an existing file is kept.

    `before` and `after` are the simulated images (rows, columns) for those of `tracked`; `prediction` adds the costs of
    other images with their controls, and the simulated ones. `reference` is what the images of `tracked` are called:
    those of a twin are not real. `speckle` adds what the fit of the speckle found.
    Raises SimulationError without matplotlib and if the file cannot be written.
    """
    require_matplotlib()
    images = [np.where(tracked.mask, image, 0).astype(np.uint8) for image in tracked.images]
    references = [TextureReference(image, tracked.grid.pixel_spacing_mm, tracked.mask) for image in tracked.images]
    textures = [
        [reference.misfit(image) for reference, image in zip(references, simulated, strict=True)]
        for simulated in (before, after)
    ]
    fill = {
        "title": html.escape(title or f"Simulated ultrasound fitted to {reference} ultrasound"),
        "subtitle": html.escape(subtitle),
        "cost_before": f"{result.cost_before:.4f}",
        "cost_after": f"{result.cost_after:.4f}",
        "change": f"{100.0 * (result.cost_after / max(result.cost_before, 1e-12) - 1.0):+.0f} %",
        "count": str(len(images)),
        "evaluations": str(result.evaluations),
        "seconds": f"{result.seconds:.1f}",
        "prediction": "" if prediction is None else _predicted(prediction, reference),
        "images": "\n".join(
            _trio(number, real, old, new, *misfits)
            for number, real, old, new, *misfits in zip(
                tracked.numbers,
                images,
                before,
                after,
                result.similarity_before,
                result.similarity_after,
                *textures,
                strict=True,
            )
        ).replace(_REFERENCE, html.escape(reference)),
        "reference": html.escape(reference),
        "histograms": _histograms(tracked, before, after, simulator, reference),
        "speckle": "" if speckle is None else _speckle(speckle),
        "curve": _curve(result),
        "parameters": "\n".join(_parameter_row(result, parameter) for parameter in result.parameters),
        "combinations": "\n".join(
            _combination_row(spread)
            for spread in result.identifiability.spreads
            if spread.name not in result.parameters.names
        ),
        "identifiability": html.escape(_in_words(result)),
        "geometry": _geometry(tracked),
        "provenance": html.escape(provenance),
    }
    template = Template(_TEMPLATE.read_text(encoding="utf-8"))
    with written_whole(path) as partial:
        partial.write_text(template.substitute(fill), encoding="utf-8")


def grey_levels_per_tissue(
    tracked: TrackedImages, images: list[np.ndarray], simulator: UltrasoundSimulator
) -> dict[str, np.ndarray]:
    """{tissue name: (pixels,) grey levels of these images where the labels have that tissue}, without the coupling."""
    medium = simulator.medium
    found: dict[str, list[np.ndarray]] = {}
    for pose, image in zip(tracked.poses, images, strict=True):
        labels = slice_under_probe(medium.labels, tracked.grid, pose, order=0)
        for label, tissue in medium.tissues.items():
            pixels = image[(labels == label) & tracked.mask]
            if label != 0 and pixels.size:
                found.setdefault(tissue.name, []).append(pixels)
    return {name: np.concatenate(pixels) for name, pixels in found.items()}


def _trio(
    number: int, real: np.ndarray, before: np.ndarray, after: np.ndarray, was, is_now, texture_was, texture
) -> str:
    before_png, after_png, real_png = (png_url(image) for image in (before, after, real))
    difference = png_url(np.clip(127.5 + 0.5 * (after.astype(float) - real), 0, 255).astype(np.uint8))
    caption = (
        f"Image {number}: cost {was.total:.4f} → {is_now.total:.4f} (histograms {was.bhattacharyya:.3f} → "
        f"{is_now.bhattacharyya:.3f}, difference {was.sad:.3f} → {is_now.sad:.3f}), texture T1 "
        f"{texture_was.autocorrelation:.3f} → {texture.autocorrelation:.3f}, "
        f"T2 {texture_was.extrema:.2f} → {texture.extrema:.2f}"
    )
    return f"""<figure class="case">
<figcaption>{caption}</figcaption>
<div class="trio"><figure><img alt="before" src="{before_png}"><figcaption>simulated, before</figcaption></figure>
<figure><img alt="after" src="{after_png}"><figcaption>simulated, after</figcaption></figure>
<figure><img alt="{_REFERENCE}" src="{real_png}"><figcaption>{_REFERENCE}</figcaption></figure></div>
<div class="compare"><img alt="simulated"><div class="top"><img alt="{_REFERENCE}"></div><div class="edge"></div>
<span class="name l">after</span><span class="name r">{_REFERENCE}</span></div>
<div class="controls"><input type="range" min="0" max="100" value="50" aria-label="divide simulated and {_REFERENCE}">
<select aria-label="simulated image"><option>after</option><option>before</option></select><button>Blink</button></div>
<details><summary class="dim">difference, after minus {_REFERENCE}</summary>
<img class="plot" alt="difference" src="{difference}"></details>
</figure>"""


def _predicted(prediction: Prediction, reference: str) -> str:
    """A table of the costs on fitted and predicted images, and what it says."""
    listed = [", ".join(map(str, numbers)) for numbers in (prediction.fitted_numbers, prediction.numbers)]
    heads = [
        "images", f"fitted ({listed[0]}): cost", "with texture", f"predicted ({listed[1]}): cost", "with texture"
    ]  # fmt: skip
    rows = [
        [_named(source, reference) + (", fitted" if source == UNIFORM else ""), *map(_number, values)]
        for source, *values in prediction.rows()
    ]
    return f"""<h2>Images that were not fitted</h2>
{_table(heads, rows)}
<p class="dim">The cost of the predicted images is {prediction.of_uniform:.2f} times the cost of one uniform tissue
without anatomy, fitted in the same way; {html.escape(reference)} neighbours are the images before and after. With
texture: + T1 + T2 / 2.</p>"""


def _named(source: str, reference: str) -> str:
    """The name of a source, where `reference` is what the real images are called."""
    return source.replace("real", reference)


def _number(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.3f}"


def _speckle(speckle: SpeckleFit) -> str:
    """What the fit of the speckle found, step by step."""
    return f"""<h2>Fit of the speckle</h2>
<p class="dim">The grey map comes from the images alone. Smoothing and texture are found by T1 + T2 / 2, and smoothing
once more with the width of the speckle. The fit by the paper's cost started from the values below.</p>
{_table(["step", "found"], speckle.rows(), "words")}"""


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table of texts; the rows of the simulated images stand out."""

    def row(cells: Sequence[str], tag: str = "td") -> str:
        shown = ' class="own"' if cells[0] == FITTED else ""
        return f"<tr{shown}>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "\n".join(row(cells) for cells in rows)
    return f'<table class="{kind}">{row(heads, "th")}\n{body}</table>'


def _explained(parameter: Parameter) -> str:
    """The tool tip."""
    declared = parameter.declaration
    return ". ".join(text for text in (declared.tip, declared.note, declared.source) if text) + "."


def _parameter_row(result: AppearanceResult, parameter: Parameter) -> str:
    spread, declared = result.identifiability[parameter.name], parameter.declaration
    note = ' <span class="no">at its bound</span>' if parameter.name in result.at_bounds else ""
    return (
        f'<tr title="{html.escape(_explained(parameter))}"><td>{html.escape(parameter.name)}{note}</td>'
        f"<td>{html.escape(f'{declared.label} {declared.symbol}'.strip())}</td><td>{html.escape(declared.unit)}</td>"
        f"<td>{parameter.low:.4g} to {parameter.high:.4g}</td>"
        f"<td>{result.before[parameter.name]:.3f}</td><td>{result.after[parameter.name]:.3f}</td>{_spread_cells(spread)}</tr>"
    )


def _combination_row(spread: Spread) -> str:
    name, unit = html.escape(spread.name), html.escape(spread.unit)
    return f"<tr><td>{name}</td><td>{unit}</td><td>{spread.value:.2f}</td>{_spread_cells(spread)}</tr>"


def _spread_cells(spread: Spread) -> str:
    restarts = "–" if np.isnan(spread.mean) else f"{spread.mean:.3f} ± {spread.standard_deviation:.3f}"
    answer = {True: '<td class="yes">yes</td>', False: '<td class="no">no</td>', None: "<td>?</td>"}[
        spread.is_determined
    ]
    if not spread.is_fitted:
        answer = '<td class="dim">not fitted</td>'
    return f"<td>{spread.low:.3f} to {spread.high:.3f}</td><td>{restarts}</td>{answer}"


def _in_words(result: AppearanceResult) -> str:
    found = result.identifiability
    text = (
        f"Speckle is random: another realisation changes the cost by about {found.cost_tolerance:.4f}, so smaller "
        f"differences are not significant. {found.solutions} solutions are equally good by this measure; "
    )
    if found.restarts:
        text += (
            f"{found.restarts_as_good} of {found.restarts} searches with other speckle and starts fit equally well. "
        )
    return text + (
        "mu0, sigma0 and mu1 determine the variance of developed speckle (Var), Var and gain the level, attenuation "
        "and TGC the net attenuation: such a combination can be determined although its parts are not. Not fitted "
        "is the net attenuation of a tissue whose attenuation was not free: it changes with TGC alone."
    )


def _curve(result: AppearanceResult) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.2), facecolor=_PAPER, dpi=110, layout="constrained")
    axis = _dark(figure.add_subplot())
    main = [entry for entry in result.history if entry.stage in (*STAGES, AGAIN)]
    costs = np.array([entry.cost for entry in main])
    axis.plot(costs, ".", color=_BEFORE, markersize=3, label="evaluation")
    axis.plot(np.minimum.accumulate(costs), color=_AFTER, label="best so far")
    for place in range(1, len(main)):
        if main[place].stage != main[place - 1].stage:
            axis.axvline(place, color="#555555", linewidth=0.8)
            axis.annotate(main[place].stage, (place + 2, costs.max()), color=_INK, fontsize=8, va="top")
    axis.set_xlabel("evaluation")
    axis.set_ylabel("cost")
    axis.legend(facecolor=_PAPER, labelcolor=_INK, edgecolor="#444444", fontsize=8)
    return _figure_png(figure)


def _histograms(
    tracked: TrackedImages, before: list, after: list, simulator: UltrasoundSimulator, reference: str
) -> str:
    from matplotlib.figure import Figure

    real = grey_levels_per_tissue(tracked, tracked.images, simulator)
    rows = {name: pixels for name, pixels in real.items() if pixels.size >= 200} or real
    simulated = [grey_levels_per_tissue(tracked, images, simulator) for images in (before, after)]
    columns = max(len(rows), 1)
    figure = Figure(figsize=(3.2 * columns, 2.6), facecolor=_PAPER, dpi=110, layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    for axis, name in zip(axes, rows, strict=False):
        _dark(axis)
        for pixels, colour, label in (
            (simulated[0][name], _BEFORE, "before"),
            (simulated[1][name], _AFTER, "after"),
            (real[name], _REAL, reference),
        ):
            share = np.bincount(pixels // 8, minlength=32) / pixels.size
            axis.stairs(share, np.arange(0, 257, 8), color=colour, label=label, linewidth=1.6)
        axis.set_title(name, color=colour_of(name), fontsize=10)
        axis.set_xlabel("grey level", fontsize=8)
        axis.set_yticks([])
    axes[-1].legend(facecolor=_PAPER, labelcolor=_INK, edgecolor="#444444", fontsize=8)
    return _figure_png(figure)


def _dark(axis):
    axis.set_facecolor("#101010")
    axis.tick_params(colors=_INK, labelsize=8)
    for spine in axis.spines.values():
        spine.set_color("#555555")
    axis.xaxis.label.set_color(_INK)
    axis.yaxis.label.set_color(_INK)
    return axis


def _geometry(tracked: TrackedImages) -> str:
    whole = np.zeros(tracked.field.mask.shape, np.uint8)
    whole[tracked.field.window] = tracked.images[0]
    with TemporaryDirectory() as folder:
        picture = Path(folder) / "field.png"
        draw_field(picture, whole, tracked.field)
        return data_url(picture.read_bytes())


def _figure_png(figure) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", facecolor=_PAPER)
    return data_url(data.getvalue())
