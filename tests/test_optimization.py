"""The optimisation on twins with known parameters: accuracy, identifiability, and errors for invalid input."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.twins import make_twin
from SlicerUSSim.Logic import (
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    SimulationError,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    optimize_appearance,
    segment_mri,
)
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings
from SlicerUSSim.Logic.fitting.identifiability import variance_db
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
from SlicerUSSim.Logic.fitting.optimization import (
    AGAIN,
    FIRST_STEP,
    AppearanceCost,
    _identifiability,
    _restarted,
    patch_statistics,
    search_axes,
)
from SlicerUSSim.Logic.fitting.parameters import FreeParameters
from SlicerUSSim.Logic.fitting.search import Search
from SlicerUSSim.Logic.probe import pose_looking_at
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.tissue import Tissue
from tests.test_label_maps import head_tissues

SMALL = PhasedProbe(70.0, 50.0, scan_lines=80)


@pytest.fixture(scope="module")
def brain():
    return head_tissues(2.0)


@pytest.fixture(scope="module")
def twin(brain):
    return make_twin(*brain, 3, probe=SMALL)


def optimise(twin, free, **options):
    options = {"max_evaluations": 200, "restarts": 0, "display": twin.display, **options}
    return optimize_appearance(twin.simulator, twin.probe, twin.poses, twin.references, free=free, **options)


def white(tissues):
    return tissues[tissues.label_of("white matter")]


@pytest.fixture(scope="module")
def result(twin):
    # The default number: with half of it restarts reach a higher cost, and identifiability cannot be determined.
    return optimise(twin, ["display", "white matter"], max_evaluations=600, restarts=2)


# ---- what it finds ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_images_become_alike(twin, result):
    assert result.cost_after < 0.75 * result.cost_before
    with twin.simulator.with_tissues(result.tissues):
        images = [twin.simulator.simulate(twin.probe, pose, result.display).image for pose in twin.poses]
    field = ImageGrid.for_probe(twin.probe, None).field(twin.probe)
    for image, reference, before in zip(images, twin.references, result.similarity_before, strict=True):
        assert abs(image[field].mean() - reference[field].mean()) < 5.0
        assert before.total > 0.0
    sources = white(result.tissues).sources
    assert sources["mu0"] == "fitted to tracked ultrasound" and "Szabo" in sources["speed_of_sound_m_s"]
    assert white(twin.simulator.medium.tissues).mu0 == 0.33 and twin.simulator.settings.seed == twin.seed  # as before


@pytest.mark.slow
def test_net_fall_with_depth_and_relative_echogenicity_are_recovered(twin, result):
    found, true = white(result.tissues), white(twin.true_tissues)
    fall = found.attenuation_db_cm_mhz - result.display.tgc_db_cm_mhz
    true_fall = true.attenuation_db_cm_mhz - twin.true_display.tgc_db_cm_mhz
    assert fall == pytest.approx(true_fall, abs=0.1)
    # Together with the display the echogenicity is flat about its optimum (0.5 to 10 dB off on different devices): what
    # the fit claims is the interval, and that holds the truth. Only a narrow one claims the value.
    spread = result.identifiability["Var of white matter re grey matter"]
    truth = spread.value + variance_db(true) - variance_db(found)
    assert spread.low - spread.tolerance <= truth <= spread.high + spread.tolerance
    assert spread.is_determined is False or abs(truth - spread.value) < 3.0


@pytest.mark.slow
def test_it_says_what_cannot_be_known(result):
    found = result.identifiability
    assert not found["white matter.mu1"].is_determined  # only Var shows
    assert found["net attenuation in white matter"].is_determined
    for spread in found.spreads:
        assert spread.low <= spread.value <= spread.high
    mu1, var = found["white matter.mu1"], found["Var of white matter re grey matter"]
    assert (mu1.high - mu1.low) / mu1.tolerance > 2.0 * (var.high - var.low) / var.tolerance
    assert found.restarts == 2 and 0 <= found.restarts_as_good <= 2 and found.solutions > 0
    assert json.loads(json.dumps(result.to_dict()))["identifiability"]["cost_tolerance"] > 0


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_restarts_reach_the_fit_and_its_interval_holds_the_truth(brain, seed):
    """Along the parameters restarts stopped in the valley of TGC and attenuation: 8 of 25 reached the fit's cost."""
    twin = make_twin(*brain, seed, probe=SMALL)
    result = optimise(twin, ["display", "white matter"], max_evaluations=600, restarts=2)
    assert result.identifiability.restarts_as_good > 0
    fall = result.identifiability["net attenuation in white matter"]
    true = white(twin.true_tissues).attenuation_db_cm_mhz - twin.true_display.tgc_db_cm_mhz
    assert fall.is_determined and fall.low - 0.1 <= 2 * SMALL.frequency_mhz * true <= fall.high + 0.1


@pytest.mark.slow
def test_every_restart_has_other_scatterers(result):
    """The best fit, evaluated before each restart with that restart's seed, has another cost each time."""
    last = [entry for entry in result.history if entry.stage == "polish"]
    best = min(last, key=lambda entry: entry.cost)
    redrawn = [entry for entry in result.history if entry.stage in ("redraw 1", "redraw 2")]
    assert [entry.units for entry in redrawn] == [best.units] * 2
    assert len({best.cost, *(entry.cost for entry in redrawn)}) == 3


@pytest.mark.parametrize("offset", [-0.4, 0.4])
def test_a_restart_is_compared_with_the_best_fit_of_its_own_scatterers(offset):
    """With other scatterers all costs are higher or lower; a restart that finds the same place is as good."""
    display, tissues = DisplaySettings(), TissueTable.named(["liver"])
    parameters = FreeParameters.of(["gain_db"], tissues, display)
    best = parameters.units(tissues, display)
    simulator = SimpleNamespace(settings=SimulationSettings(seed=5))

    def cost(units):
        return 1.0 + float(((units - best) ** 2).sum()) + offset * (simulator.settings.seed != 5)

    search = Search(cost, lambda units: {}, 100)
    search.evaluate("polish", best)
    problem = SimpleNamespace(
        parameters=parameters, tissues=tissues, display=display, model=SimpleNamespace(probe=SMALL),
        axes=lambda units: np.eye(1), anchor=lambda units: None,
    )  # fmt: skip
    again = _restarted(problem, search, simulator, best, restarts=1, budget=40, algorithm="LN_SBPLX")
    found = _identifiability(problem, search, best, search.best_cost("polish"), again)
    assert found.cost_tolerance == pytest.approx(0.2)
    assert (found.restarts, found.restarts_as_good) == (1, 1)


def curved_valley(units):
    """(2,) what changes along a valley and across it; its direction at the ends is not that at the bottom."""
    return np.array([units[0] - 0.5, 25.0 * (units[1] - 0.5 - 2.0 * (units[0] - 0.5) ** 2)])


def restarted_in_a_curved_valley(budget):
    """Restarts as good of four, and the numbers of evaluations of each."""
    display, tissues = DisplaySettings(), TissueTable.named(["liver"])
    parameters = FreeParameters.of({"gain_db": (-12, 12), "dynamic_range_db": (40, 80)}, tissues, display)
    best = np.array([0.5, 0.5])
    search = Search(lambda units: 1.0 + float(np.linalg.norm(curved_valley(units))), lambda units: {}, 1000)
    search.evaluate("polish", best)
    problem = SimpleNamespace(
        parameters=parameters, tissues=tissues, display=display, model=SimpleNamespace(probe=SMALL),
        axes=lambda units: search_axes(curved_valley, units), anchor=lambda units: None,
    )  # fmt: skip
    simulator = SimpleNamespace(settings=SimulationSettings())
    again = _restarted(problem, search, simulator, best, restarts=4, budget=budget, algorithm="LN_BOBYQA")
    found = _identifiability(problem, search, best, search.best_cost("polish"), again)
    stages = [[entry for entry in search.history if entry.stage == f"restart {n}"] for n in range(1, 5)]
    return found.restarts_as_good, stages


def test_a_restart_that_stopped_above_the_fit_continues_along_its_axes():
    as_good, stages = restarted_in_a_curved_valley(300)
    assert as_good == 4
    assert all(len(stage) <= 300 for stage in stages)
    # What is as good already is not searched again.
    assert min(len(stage) for stage in stages) < 0.5 * max(len(stage) for stage in stages)
    as_good, stages = restarted_in_a_curved_valley(12)
    assert as_good < 4 and all(len(stage) <= 12 for stage in stages)


def test_a_fit_takes_the_evaluations_given_and_shows_its_best_image(twin):
    """It took more than twice as many: those of restarts came on top."""
    settings, shown = FitSettings(evaluations=80, restarts=2), []

    def told(step):
        assert step.evaluations <= step.limit <= settings.evaluations
        if step.stage == "polish":
            shown.append((step.best_cost, step.image()))

    found = optimise(twin, ["gain_db", "white matter"], max_evaluations=settings.of_search, restarts=2, progress=told)
    assert settings.of_search < found.evaluations <= settings.evaluations
    cost, image = min(shown, key=lambda entry: entry[0])
    assert {entry.stage for entry in found.history} >= {"restart 1", "restart 2"}
    with twin.simulator.with_tissues(found.tissues):
        frame = twin.simulator.simulate(twin.probe, twin.poses[0], found.display)
    difference = np.abs(frame.image.astype(float) - image)
    assert image.dtype == np.uint8 and (found.cost_after < cost or difference.mean() < 2.0)


def test_the_last_search_sees_what_whole_simulations_show(twin):
    """Far from the presets the cost is approximate until it is recomputed at the best result of the previous search."""
    from SlicerUSSim.Logic import similarity

    found = optimize_appearance(
        twin.simulator, twin.probe, twin.poses[:1], twin.references[:1], display=twin.display, restarts=0,
        free={"white matter.attenuation_db_cm_mhz": (1.3, 1.6), "white matter.mu1": (1.0, 1.5)}, max_evaluations=12,
    )  # fmt: skip
    last = next(entry for entry in found.history if entry.stage == "polish")
    before = [entry.cost for entry in found.history if entry.stage == "local" and entry.units == last.units]
    tissues, display = found.parameters.apply(np.array(last.units), twin.simulator.medium.tissues, twin.display)
    with twin.simulator.with_tissues(tissues):
        frame = twin.simulator.simulate(twin.probe, twin.poses[0], display)
    field = ImageGrid.for_probe(twin.probe, None).field(twin.probe)
    whole = similarity(frame.image, twin.references[0], frame.pixel_spacing_mm, mask=field).total
    assert abs(before[0] - whole) > 1e-4
    assert last.cost == pytest.approx(whole, abs=1e-5)


def test_a_single_parameter_can_be_free(twin):
    result = optimise(twin, ["gain_db"], max_evaluations=20)
    assert result.cost_after < result.cost_before


def test_bounds_are_kept(twin):
    result = optimise(twin, {"gain_db": (-1, 1), "white matter.mu0": (0.2, 0.3)}, max_evaluations=24)
    assert -1 <= result.after["gain_db"] <= 1 and 0.2 <= result.after["white matter.mu0"] <= 0.3
    narrow = optimise(twin, {"gain_db": (20, 21)}, max_evaluations=16)
    assert narrow.at_bounds == ["gain_db"] and narrow.to_dict()["at_bounds"] == ["gain_db"]


# ---- the same again, and going on ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_problem_gives_the_same_answer(twin):
    one, other = (optimise(twin, ["display"], max_evaluations=40, restarts=1) for _ in range(2))
    assert one.after == other.after and one.history == other.history


def test_what_a_progress_function_raises_comes_through(twin):
    def fail(progress):
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        optimise(twin, ["display"], progress=fail)


@pytest.mark.parametrize("algorithm", ["GN_CRS2_LM", "GN_DIRECT_L", "G_MLSL_LDS", "LN_BOBYQA", "LN_NELDERMEAD"])
def test_search_finds_the_lowest_point_and_keeps_its_history(algorithm):
    goal = np.array([0.3, 0.8, 0.5])
    search = Search(lambda units: float(((units - goal) ** 2).sum()), lambda units: {}, 400)
    best = search.minimise(algorithm, "here", np.full(3, 0.1), 400)
    assert np.abs(best - goal).max() < 0.05
    assert len(search.history) <= 400
    assert search.best_cost("here") == min(entry.cost for entry in search.history)


def narrow_valley(units):
    """Two parameters that only differ in their effect together, and a third; rough as an image's grey levels are."""
    together, apart, third = units[0] + units[1] - 1.2, 30.0 * (units[0] - units[1]), units[2] - 0.9
    return float(np.sqrt(0.01 + apart**2 + together**2 + third**2)) + 1e-3 * float(np.sin(400.0 * units).sum())


def changes(units):
    return np.array([units[0] + units[1], 30.0 * (units[0] - units[1]), units[2]])


@pytest.mark.parametrize("start", [(0.1, 0.2, 0.3), (0.9, 0.1, 0.2), (0.95, 0.9, 0.1)])
def test_along_its_axes_a_search_reaches_the_bottom_of_a_valley(start):
    start, lowest = np.array(start), narrow_valley(np.array([0.6, 0.6, 0.9]))
    axes = search_axes(changes, start)
    plain, along = Search(narrow_valley, lambda units: {}, 80), Search(narrow_valley, lambda units: {}, 80)
    plain.minimise("LN_BOBYQA", "here", start, 80)
    best = along.minimise("LN_BOBYQA", "here", start, 80, FIRST_STEP, axes)
    assert along.best_cost("here") < lowest + 0.01 < plain.best_cost("here")
    assert best == pytest.approx([0.6, 0.6, 0.9], abs=0.05)


def test_axes_are_steps_that_change_images_equally():
    def of(units):
        return np.array([[4.0 * (units[0] - units[1]), 2.0 * (units[0] + units[1])], [0.0, 0.0]])

    axes = search_axes(of, np.array([0.5, 0.99, 0.3]))  # the third has no effect, the second is near its bound
    for axis in axes.T[1:]:
        assert np.sqrt((of(axis) ** 2).mean()) == pytest.approx(1.0, rel=0.06)
    assert np.abs(axes[:, 0]) == pytest.approx([0.0, 0.0, 3.0], abs=1e-9)


def test_patches_have_means_and_standard_deviations_of_the_pixels_inside():
    image = np.random.default_rng(0).integers(0, 256, (20, 25)).astype(np.uint8)
    inside = np.ones(image.shape, bool)
    inside[:, 20:] = False
    inside[0, 0] = False
    mean, deviation = patch_statistics(image, inside, (10, 10))
    first = image[:10, :10].ravel()[1:] / 255
    assert (mean[0], deviation[0]) == pytest.approx((first.mean(), first.std()))
    last = image[10:, 10:20] / 255
    assert mean.shape == (4,) and (mean[3], deviation[3]) == pytest.approx((last.mean(), last.std()))


# ---- mistakes --------------------------------------------------------------------------------------------------------


def test_bad_input_is_one_clear_line(twin):
    black = [twin.references[0], np.zeros_like(twin.references[1]), twin.references[2]]
    outside = [~ImageGrid.for_probe(twin.probe, None).field(twin.probe)] * 3
    for change, message in (
        ({"references": black}, "reference image 1 is black inside the field"),
        ({"references": []}, "no reference image"),
        ({"references": twin.references[:1]}, "1 reference images and 3 poses"),
        ({"references": [r[:-1] for r in twin.references]}, "reference image 0 has shape"),
        ({"masks": outside}, "do not overlap"),
        ({"masks": outside[:1]}, "1 masks and 3 reference images"),
        ({"free": ["brilliance"]}, "no free parameter 'brilliance'"),
        ({"free": {"gain_db": (2, 1)}}, "bounds of gain_db"),
        ({"max_evaluations": 0}, "max_evaluations is 0"),
        ({"algorithms": ("GN_MAGIC", "LN_BOBYQA")}, "nlopt has no algorithm 'GN_MAGIC'"),
        ({"poses": [np.diag([2.0, 1, 1, 1])] * 3}, "pose 0"),
    ):
        arguments = {
            "simulator": twin.simulator, "probe": twin.probe, "poses": twin.poses, "references": twin.references,
            "free": ["display"], "display": DisplaySettings(), **change,
        }  # fmt: skip
        with pytest.raises(SimulationError) as caught:
            optimize_appearance(**arguments)
        assert message in str(caught.value) and "\n" not in str(caught.value)


# ---- fourteen patients -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real_brain(mni):
    segmentation = segment_mri(mni[0], thin_sulci=False)
    return segmentation.labels, TissueTable.brain(segmentation.tissue_names)


PATIENTS = PhasedProbe(75.0, 60.0, scan_lines=128)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(14))
def test_fourteen_patients_with_a_known_display(real_brain, seed):
    twin = make_twin(*real_brain, seed, probe=PATIENTS, display_is_known=True)
    result = optimise(twin, ["white matter"], max_evaluations=150)
    found, true = white(result.tissues), white(twin.true_tissues)
    assert result.cost_after < result.cost_before
    assert found.attenuation_db_cm_mhz == pytest.approx(true.attenuation_db_cm_mhz, abs=0.1)
    assert variance_db(found) == pytest.approx(variance_db(true), abs=1.5)


def net_fall(tissue: Tissue, display: DisplaySettings) -> float:
    """dB/(cm MHz) by which the level falls to the depth of the image, with the pulse's frequency (docs/physics.md)."""
    path = 0.2 * PATIENTS.frequency_mhz * PATIENTS.depth_mm  # cm MHz
    loss_db = tissue.attenuation_db_cm_mhz * path
    nepers = loss_db * np.log(10.0) / 20.0
    gained_db = 20.0 / np.log(10.0) * 0.5 * (PATIENTS.fractional_bandwidth / FWHM_PER_SIGMA * nepers) ** 2
    return (loss_db - gained_db) / path - display.tgc_db_cm_mhz


@pytest.mark.long
@pytest.mark.parametrize("seed", range(14))
def test_fourteen_patients_with_everything_free(real_brain, seed):
    twin = make_twin(*real_brain, seed, probe=PATIENTS)
    result = optimise(twin, ["display", "white matter"], max_evaluations=600)  # the default number
    found, true = white(result.tissues), white(twin.true_tissues)
    assert result.cost_after < result.cost_before
    assert net_fall(found, result.display) == pytest.approx(net_fall(true, twin.true_display), abs=0.05)
    # Grey matter is as it was. Together with the display the cost is flat: of seed 1, 0.212 at +1.6 dB (PoCL) and 0.213
    # at -0.6 dB (Intel's runtime); all others end within 1 dB.
    assert variance_db(found) == pytest.approx(variance_db(true), abs=2.5)


# ---- what a search of all parameters leaves ------------------------------------------------------------------------


def _fit_of_a_thin_sheet(evaluations: int, restarts: int):
    """(Fit, {level: least change of the cost when it alone changes by 2 dB}) of a brain with a falx of two voxels."""
    labels = np.ones((50, 50, 50), np.uint8)
    labels[:, :, 22:24], labels[20:22], labels[12] = 2, 3, 4
    simulator = UltrasoundSimulator(
        Volume(labels, np.eye(4)), TissueTable.named(["grey matter", "falx", "white matter", "tumour"])
    )
    tissues, factor = simulator.medium.tissues, 10.0 ** (8.0 / 20.0)
    falx = tissues.tissue("falx")
    brighter = tissues.with_tissue(replace(falx, mu0=falx.mu0 * factor, sigma0=falx.sigma0 * factor))
    probe, pose = LinearProbe(width_mm=30, depth_mm=40, scan_lines=64), pose_looking_at((25, 25, 49), (25, 25, 0))
    with simulator.with_tissues(brighter):
        real = simulator.simulate(probe, pose, DisplaySettings(gain_db=5.0, dynamic_range_db=50.0)).image
    simulator.settings = replace(simulator.settings, seed=simulator.settings.seed + 5)  # other speckle
    found = optimize_appearance(
        simulator, probe, [pose], [real], free=["display", "tissues"], max_evaluations=evaluations, restarts=restarts
    )  # fmt: skip
    model = AppearanceModel(simulator, probe, [pose], found.parameters.varied())
    cost = AppearanceCost(model, found.parameters, [real], None, tissues, DisplaySettings(), SimilaritySettings())
    best = found.parameters.units(found.tissues, found.display)
    cost.anchor(best)
    changes = {}
    for place, free in enumerate(found.parameters):
        if free.attribute == "echogenicity_db":
            beside = [best + step * (np.arange(len(best)) == place) for step in (-1.0 / 12.0, 1.0 / 12.0)]
            within = [units for units in beside if 0.0 < units[place] < 1.0]
            changes[free.name] = min((cost(units) for units in within), default=1.0) - cost(best)
    return found, changes


@pytest.mark.slow
def test_the_level_of_no_tissue_is_left_where_a_search_has_carried_it():
    """A falx ended 5 dB too dark, and was not to be seen, though a brighter one cost less."""
    _, changes = _fit_of_a_thin_sheet(150, 0)
    assert len(changes) == 4 and min(changes.values()) > -5e-3, changes


@pytest.mark.slow
def test_a_restart_that_fits_better_is_gone_on_from_and_no_other():
    once, again = (_fit_of_a_thin_sheet(60, restarts)[0] for restarts in (0, 2))
    assert again.cost_after <= once.cost_after + 1e-6
    went_on = any(entry.stage == AGAIN for entry in again.history)
    assert went_on or again.cost_after == pytest.approx(once.cost_after, abs=1e-6)
    assert again.identifiability.restarts == 2
