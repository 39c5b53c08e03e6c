"""Proofs of stability: against eigenvalues of plants with 200 modes and of machines of the box."""

import json
from types import SimpleNamespace
from unittest import mock

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
import scipy.optimize

from jaxmodel import zero_exclusion
from jaxmodel.branch_and_bound import Cells, exclude_zeros, start_cells
from jaxmodel.controller import with_gains
from jaxmodel.discs import Disc, excludes_zero, interval, inverse_of
from jaxmodel.modal_loop import law_poles, law_response
from jaxmodel.mode_tail import bound_tail, static_rest
from jaxmodel.prepare import prepare
from jaxmodel.sampled_response import (
    SampledLoopResponse,
    command_gain,
    plant_images,
    plant_response,
)
from jaxmodel.zero_exclusion import NEAR, prepare_exclusion, return_difference
from studies.documents import schema
from studies.engine.controller import fixed_controller
from studies.engine.stability import gain_margin
from studies.results.document import json_text
from studies.show.pages import page
from studies.space.machines import BOX
from studies.spillover import ModelMismatch, certify
from studies.spillover import proofs as proofs_module
from studies.spillover.plants import (
    LARGEST,
    LoopBuilder,
    PlantVariant,
    pad_channels,
    plant_structure,
)
from studies.spillover.proofs import (
    KNOWN,
    SINES,
    AllModes,
    Proofs,
    ProvenBox,
    SpectralRadius,
    _delayed_loop,
    collect,
    proof_texts,
    prove_all_modes,
    prove_box,
    volume,
)
from studies.spillover.say import say
from tests.pages import text_of
from tests.proofs import ONE_MOVE, many_modes_loop, random_design, spectral_radius

STUDY = ONE_MOVE.change(link__stretch=False)


@pytest.fixture(scope="module")
def design(request):
    """Of links that lengthen, unless a test says otherwise."""
    return fixed_controller(STUDY.change(link__stretch=getattr(request, "param", True)))


@pytest.fixture(scope="module")
def law(design):
    return pad_channels(design.controller, design.n_patches)


@pytest.fixture(scope="module")
def loop(design, law):
    return collect(design, law, SINES, KNOWN)


def box_cells(count, seed, wide):
    """Cells of all shapes in the box and below twice the gains."""
    rng = np.random.default_rng(seed)
    ranges = np.array([(0.0, 3.1e4), *BOX, (0.0, 2.0)])
    width = ranges[:, 1] - ranges[:, 0]
    low = ranges[:, 0] + width * 0.9 * rng.uniform(size=(count, 5))
    size = width * 10 ** rng.uniform(-5, -1, (count, 5)) * wide
    return low, low + size


# --- discs ----------------------------------------------------------------------------------------


def test_discs_contain_the_results_of_their_members():
    rng = np.random.default_rng(0)

    def draw(*shape):
        mid = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        return Disc(mid, 0.1 * rng.uniform(size=shape))

    def member(x):
        angle = rng.uniform(0, 2 * np.pi, x.mid.shape)
        return x.mid + x.rad * np.exp(1j * angle)

    a, b = draw(200, 3, 3), draw(200, 3, 3)
    matrix = Disc(a.mid + 4 * np.eye(3), a.rad)
    for _ in range(20):
        one, other, third = member(a), member(b), member(matrix)
        for bound, value in (
            (a + b, one + other),
            (a * b, one * other),
            (a @ b, one @ other),
            (a.inverse(), 1 / one),
            (inverse_of(matrix), np.linalg.inv(third)),
        ):
            assert np.all(np.abs(value - bound.mid) <= bound.rad * (1 + 1e-12) + 1e-13)
    assert np.isinf(Disc(np.array(0.1 + 0j), np.array(1.0)).inverse().rad)


def test_a_disc_with_a_singular_member_is_not_excluded():
    """diag(1, d) with d in [-r, 2 - r]: singular if and only if r >= 0."""
    for r, is_excluded in ((-1e-6, True), (1e-6, False)):
        span = interval(np.array(-r), np.array(2 - r))
        mid = np.diag([1.0, span.mid]).astype(complex)
        rad = np.diag([0.0, span.rad])
        assert (excludes_zero(Disc(mid[None], rad[None]))[0] < 1) == is_excluded


def test_a_bound_is_the_spectral_radius_of_equal_radii():
    """|F0^-1| R of radii r everywhere about the identity has n r, in regular arithmetic."""
    mid, rad = np.eye(3, dtype=complex)[None], np.full((1, 3, 3), 0.1)
    with np.errstate(divide="raise", invalid="raise"):
        np.testing.assert_allclose(excludes_zero(Disc(mid, rad)), 0.3, rtol=1e-6)


@pytest.mark.parametrize("changed", ["omega", "zeta", "spring"])
def test_resonances_of_a_link_that_differs_are_its_own(changed):
    """1 + spring/E - x^2 + 2 i zeta x of three links, one of them slightly different."""
    loop = {name: np.full((3, 1), x) for name, x in (("omega", 5.0), ("zeta", 0.01), ("spring", 0))}
    loop[changed] = loop[changed] + np.array([[0.0], [0.02], [0.0]])
    setup, point = SimpleNamespace(loop=SimpleNamespace(**loop)), np.zeros(1)
    nu, stiffness = Disc(np.array([4.0]), point), Disc(np.array([1.1]), point)
    found = zero_exclusion._resonance(setup, nu, stiffness, 0, 1).denominator.mid[0]
    x = 4.0 / loop["omega"]
    wanted = 1 + loop["spring"] / 1.1 - x**2 + 2j * loop["zeta"] * x
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


# --- the return difference ------------------------------------------------------------------------


@pytest.mark.parametrize("design", [True, False], indirect=True)
@mock.patch.object(zero_exclusion, "NEAR", 12)  # part of no program
def test_the_return_difference_is_that_of_the_eigenvalue_problem(design, law, loop):
    """det F with and without gains, against det(z - A) of the exact discretisation.

    Nearly all images evaluated; what is left out of the sum then falls as their number cubed.
    """
    setup = prepare_exclusion(loop, LARGEST, BOX[0], BOX[2], has_tail=False)
    structure = plant_structure(design, SINES, LARGEST)
    case = design.case._replace(
        initial=design.case.initial._replace(modal=np.zeros((3, LARGEST))),
        n_modes=jnp.asarray(LARGEST),
    )
    pose, law = np.array(STUDY.motion.waypoints[0]), jax.tree.map(np.asarray, law)
    period, rng = float(loop.period), np.random.default_rng(1)
    for _ in range(3):
        stiffness, delay, payload = (rng.uniform(*ends) for ends in BOX)
        machine = case.machine
        changed = case._replace(
            machine=machine._replace(
                beam=machine.beam._replace(stiffness_factor=stiffness),
                masses=machine.masses._replace(payload_mass=payload),
            )
        )
        with_it, without = (
            np.asarray(
                _delayed_loop(structure, changed, pose, with_gains(law, factor), np.array(delay))
            )
            for factor in (1.0, 0.0)
        )
        for hertz in (8.0, 113.0, 460.0, 1200.0, 2860.0, 4700.0):
            z = np.exp(2j * np.pi * hertz * period)
            eye = z * np.eye(len(with_it))
            one, other = np.linalg.slogdet(eye - with_it), np.linalg.slogdet(eye - without)
            wanted = one[0] / other[0] * np.exp(one[1] - other[1])
            nu = 2 * np.pi * hertz / np.sqrt(stiffness)
            cell = np.array([[nu, stiffness, delay, payload, gain] for gain in (1.0, 0.0)])
            value = np.linalg.det(return_difference(setup, cell, cell).mid)
            # images beyond the near ones are bounded, not evaluated
            np.testing.assert_allclose(value[0] / value[1], wanted, rtol=2e-4)


def test_a_law_over_a_narrow_band_changes_by_its_slope(loop):
    """The response's disc grows with the band, and by no more than its square beyond the slope."""
    law, period = law_poles(loop.law), float(loop.period)
    omega, width = 2 * np.pi * np.array([30.0, 110.0, 450.0, 2000.0]), 1e-3

    def size(width):
        band = Disc(omega, np.full(omega.shape, width))
        return law_response(law, band, period).rad

    ends = [law_response(law, Disc(omega + x, 0 * omega), period).mid for x in (-width, width)]
    np.testing.assert_allclose(
        size(width), np.abs(ends[1] - ends[0]) / 2, rtol=1e-3, atol=1e-9 * np.abs(ends[0]).max()
    )
    np.testing.assert_allclose(size(width), size(width / 2) * 2, rtol=1e-3)


@pytest.mark.parametrize("image", [0, 1, -2])
def test_the_way_of_a_command_is_its_transfer_functions(loop, image):
    """Hold, delay, filter, amplifier and high-pass of the patches."""
    lag, corner = 1 / (2 * np.pi * 2e3), 2 * np.pi * 5.0
    loop = loop._replace(lag=np.array(lag), highpass=np.array(corner))
    period, antialias = float(loop.period), float(loop.antialias)
    omega, delay = 2 * np.pi * np.array([3.0, 110.0, 2500.0]), np.array([0.2, 0.0, 0.4])
    point = np.zeros(3)
    found = zero_exclusion._chain(loop, Disc(omega, point), Disc(delay, point), image)
    s = 1j * (omega + image * 2 * np.pi / period)
    wanted = (
        np.exp(-s * delay * period - 1j * omega * period)
        * (1 - np.exp(-1j * omega * period))
        / (s * period)
        * antialias**2
        / (s**2 + np.sqrt(2) * antialias * s + antialias**2)
        * s
        / (s + corner)
        / (1 + s * lag)
    )
    np.testing.assert_allclose(found.mid, wanted, rtol=1e-9)
    np.testing.assert_allclose(found.rad, 0.0, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("wide", [1.0, 0.01])
def test_cells_contain_their_points(loop, wide):
    setup = prepare_exclusion(loop, LARGEST, BOX[0], BOX[2], has_tail=True)
    low, high = box_cells(150, 2, wide)
    cell, rng = return_difference(setup, low, high), np.random.default_rng(3)
    for k in range(12):
        share = rng.uniform(size=low.shape).round(0 if k % 2 else 8)
        point = low + (high - low) * share
        value = return_difference(setup, point, point)
        # a point's own radius is the tail's, which both have
        size = np.abs(value.mid - cell.mid) + value.rad
        assert np.all(size <= cell.rad * (1 + 1e-9) + 1e-9 * (1 + np.abs(cell.mid)))


# --- all modes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("has_correction", [True, False])
def test_the_tail_covers_the_modes_left_out(design, law, has_correction):
    """F with 12 modes and a tail against F with 40, 90 and 200 modes of the same plant."""
    loop = collect(design, law, SINES, KNOWN)
    if not has_correction:
        loop = loop._replace(exact=None)
    one = (1.0, 1.0), (0.0, 0.0)
    setup = prepare_exclusion(loop, LARGEST, *one, has_tail=True)
    nu = np.linspace(10, 3.1e4, 400)
    cell = np.stack([nu, *(np.full(400, x) for x in (1.0, 0.0, 0.0, 1.0))], axis=1)
    bound = return_difference(setup, cell, cell)
    largest = 0.0
    for more in (40, 90, KNOWN):
        whole = prepare_exclusion(loop, more, *one, has_tail=False)
        whole = whole._replace(low=setup.low, rest=static_rest(loop, setup.low))
        other = return_difference(whole, cell, cell)
        size = np.abs(other.mid - bound.mid)
        assert np.all(size <= bound.rad + other.rad + 1e-12 * np.abs(bound.mid))
        share = size / np.where(bound.rad > 0, bound.rad, np.inf)
        largest = max(largest, share[:, -9:, -9:].max())
    assert largest > 0.05  # the bound is not idle


@pytest.fixture(scope="module")
def plant(design):
    """Its response with 200 modes a link."""
    structure = plant_structure(design, SINES, KNOWN)
    initial = design.case.initial._replace(modal=np.zeros((3, KNOWN)))
    case = design.case._replace(initial=initial, n_modes=jnp.asarray(KNOWN))
    pose = np.array(STUDY.motion.waypoints[0])

    @jax.jit
    def respond(case):
        return plant_response(structure, case, prepare(structure, case).loop, pose)

    return respond(case)


#: Frequencies at which single points are compared [Hz].
HERTZ = np.array([8.0, 113.0, 460.0, 1200.0, 1240.0, 2410.0, 4700.0])


def points(gain):
    """Cells without width at `HERTZ`, of the study's machine."""
    return np.stack([2 * np.pi * HERTZ, *(0 * HERTZ + x for x in (1.0, 0.0, 0.0, gain))], axis=1)


def test_the_return_difference_is_that_of_the_frequency_response(design, law, loop, plant):
    """det(I - law_v/z) det(I + L), but for images beyond the near ones."""
    setup = prepare_exclusion(loop, KNOWN, (1.0, 1.0), (0.0, 0.0), has_tail=False)
    law, period = jax.tree.map(jnp.asarray, law), float(loop.period)
    with_it, without = (
        np.linalg.det(return_difference(setup, points(gain), points(gain)).mid)
        for gain in (1.0, 0.0)
    )
    omega = 2 * np.pi * HERTZ
    response = SampledLoopResponse(plant, law)
    gains = jax.lax.map(lambda x: command_gain(response, x), omega)
    direct = law_response(setup.law, Disc(omega, 0 * omega), period).mid[:, :, 9:]
    late = np.exp(-1j * omega * period)[:, None, None]
    wanted = np.linalg.det(np.eye(9) - direct * late) * np.linalg.det(np.eye(9) + gains)
    np.testing.assert_allclose(with_it / without, wanted, rtol=3e-3)


@jax.jit
def sampled_response(plant):
    """Sum over 200 images on either side without delay, 200 modes, (points, 9, 9)."""
    order = np.arange(-200, 201)
    return jax.lax.map(lambda x: plant_images(plant, x, order).sensed.sum(0), 2 * np.pi * HERTZ)


def uncovered(loop, plant):
    """Entries of F of 200 modes and 200 images on either side, less its disc's centre over radii.

    For a law that commands what sensors read: then F has 1 less the plant's response as its Schur
    complement, and images beyond the near ones are what that lacks with 200 modes.
    """
    law = (np.zeros((1, 1)), np.zeros((1, 18)), np.zeros((9, 1)), np.eye(9, 18))
    one, cell = ((1.0, 1.0), (0.0, 0.0)), points(1.0)
    bounded = prepare_exclusion(loop._replace(law=law), LARGEST, *one, has_tail=True)
    known = prepare_exclusion(loop._replace(law=law), KNOWN, *one, has_tail=False)
    known = known._replace(low=bounded.low, rest=static_rest(loop, bounded.low))
    bound, exact = (return_difference(x, cell, cell) for x in (bounded, known))
    exact = exact.mid
    late = np.exp(-2j * np.pi * HERTZ * float(loop.period))[:, None, None]
    rigid, forced = exact[:, :-9, :-9], exact[:, :-9, -9:]
    schur = exact[:, -9:, -9:] - exact[:, -9:, :-9] @ np.linalg.solve(rigid, forced)
    exact[:, -9:, -9:] += np.eye(9) - late * sampled_response(plant) - schur
    # rounding of the frequency response
    return np.abs(exact - bound.mid) / (bound.rad + 1e-9 * np.abs(bound.mid) + 1e-12)


@pytest.mark.parametrize("has_correction", [True, False])
def test_the_tail_covers_modes_and_images(loop, plant, has_correction):
    """Against brute force; a part of the elongations' path that is left out is not covered."""
    held = {"exact": loop.exact - loop.held}
    if not has_correction:
        loop, plant = loop._replace(exact=None), plant._replace(direct=jnp.asarray(loop.held))
        held = {"held": 0 * loop.held}
    share = uncovered(loop, plant)
    assert share.max() <= 1 and share[:, -9:, -9:].max() > 0.1
    for name in ("push", "read", "axial_stiffness", "axial_damping"):
        without = loop._replace(**{name: 0 * getattr(loop, name)})
        assert uncovered(without, plant)[:, -9:].max() > 1, name
    assert uncovered(loop._replace(**held), plant).max() > 1


def with_known(loop, count):
    """The loop with fewer modes known one by one."""
    first = {name: getattr(loop, name)[:, :count] for name in ("omega", "spring", "zeta")}
    last = {name: getattr(loop, name)[..., :count] for name in ("enter", "leave", "sensor")}
    return loop._replace(**first, **last, actuator=loop.actuator[:, :count])


def test_patches_are_nowhere_steeper_than_their_bound(loop):
    """Over 200 modes a patch comes close to the antinodes of some."""
    order = np.arange(1, KNOWN + 1)
    sensor = np.max(np.abs(loop.sensor) / order, axis=2)
    actuator = np.max(np.abs(loop.actuator) / order[:, None], axis=1)
    for found, bound in zip((sensor, actuator), loop.steepest, strict=True):
        assert np.all((found <= bound * (1 + 1e-9)) & (found > 0.9 * bound))


@pytest.mark.parametrize("has_correction", [True, False])
def test_modes_that_are_not_known_are_covered_and_hardly_more(loop, has_correction):
    """A tail of 120 known modes and a bound on the others against one of 200."""
    if not has_correction:
        loop = loop._replace(exact=None)
    one = 1.0, 1.0
    known, bound = (bound_tail(x, LARGEST, NEAR, one, 0.0) for x in (loop, with_known(loop, 120)))
    for name, exact, found in zip(known._fields, known, bound, strict=True):
        is_there = exact > 1e-9 * exact.max()
        ratio = found[is_there] / exact[is_there]
        assert ratio.min() >= 1, name
        assert np.median(ratio) < 1.2 and ratio.max() < 5, name


def test_images_that_the_model_has_leave_less(loop):
    one = 1.0, 1.0
    none, few = (bound_tail(loop, LARGEST, near, one, 0.0).images for near in (0, NEAR))
    assert np.all(few <= none)
    assert np.median(few[few > 0] / none[few > 0]) < 0.5


def test_damping_that_falls_with_frequency_has_no_bound(loop):
    assert bound_tail(loop._replace(exponent=-1.0), LARGEST, NEAR, (1.0, 1.0), 0.0) is None
    with pytest.raises(ValueError, match="no bound of the modes"):
        prepare_exclusion(loop._replace(exponent=-1.0), LARGEST, (1.0, 1.0), (0.0, 0.0), True)


def test_nothing_is_proven_beyond_the_margin(design, law, loop):
    margin = gain_margin(LoopBuilder(design).loop(PlantVariant(SINES, LARGEST), law).poles)
    setup = prepare_exclusion(loop, LARGEST, (1.0, 1.0), (0.0, 0.0), has_tail=True)
    smallest = np.array([0.5, 1, 1, 1, 1e-3 * margin])
    for share, is_proven in ((0.9, True), (1.002, False)):
        ranges = np.array([(1.0, 1.0), (0.0, 0.0), (0.0, 0.0), (0.8 * margin, share * margin)])
        cells = start_cells(setup, ranges, 128)
        found = exclude_zeros(setup, cells, smallest, 5000, stops_at_first=True)
        assert (len(found.undecided.low) == 0) == is_proven


@pytest.mark.parametrize(("zero", "proven"), [(0.7, 0.6), (1.0, 0.99)])
def test_a_zero_between_two_shares_ends_the_proof(design, law, loop, zero, proven):
    """At 0.7 of the margin, of loops that have none at 0.8: 0.6 of it is proven."""

    def zero_within(setup, cells, *_, **__):
        is_there = (cells.low[:, 4] <= 4 * zero) & (cells.high[:, 4] >= 4 * zero)
        return SimpleNamespace(undecided=Cells(cells.low[is_there], cells.high[is_there]))

    with mock.patch.multiple(
        proofs_module,
        collect=lambda *_: loop,
        gain_margin=lambda _: 4.0,
        exclude_zeros=zero_within,
    ):
        found = prove_all_modes(design, law)
    assert found.margin == pytest.approx(4 * proven) and found.fault == ""


# --- the box --------------------------------------------------------------------------------------


def test_the_volume_of_undecided_cells():
    ranges = np.array(BOX)
    low = np.array([[10, 0.95, 0.0, 0.0, 1], [20, 0.95, 0.0, 0.0, 1], [30, 1.0, 0.5, 0.05, 1.0]])
    high = np.array([[11, 1.0, 0.5, 0.1, 1], [21, 0.975, 0.5, 0.1, 1], [31, 1.05, 1, 0.1, 1.0]])
    np.testing.assert_allclose(volume(Cells(low, high), ranges), 1 / 4 + 1 / 8)
    assert volume(Cells(low[:0], high[:0]), ranges) == 0


def test_a_box_with_an_unstable_corner_is_not_proven(design):
    """That of the difference estimator, which is unstable with seven modes."""
    study = STUDY.change(
        control__gain_factor=1.0,
        electronics__estimator="difference",
        electronics__antialias_hz=1000.0,
    )
    other = fixed_controller(study)
    box = prove_box(other, pad_channels(other.controller, other.n_patches), 20.0)
    assert not box.is_proven and box.unstable is not None


def test_a_box_of_stretching_links_under_a_steady_load_is_not_proven(design, law):
    """Their length at rest depends on their stiffness, which the bounds leave out."""
    pulled = design._replace(structure=design.structure._replace(has_wrench=True))
    box = prove_box(pulled, law, 20.0)
    assert not box.is_proven and "steady load" in box.fault


@pytest.mark.parametrize(("gain", "is_proven"), [(0.3, True), (1.0, False)])
def test_boxes_of_stretching_links_with_patches(design, gain, is_proven):
    """Proven where machines are stable; those of the default gains are not with a sample more."""
    changes = {"link__basis": "loaded", "control__gain_factor": gain}
    patched = fixed_controller(design.study.change(**changes))
    law = pad_channels(patched.controller, patched.n_patches)
    box = prove_box(patched, law, 30.0)
    radius, rng = SpectralRadius(patched, law, "loaded"), np.random.default_rng(0)
    radii = [radius(*(rng.uniform(*ends) for ends in BOX)) for _ in range(5)]
    assert box.is_proven == is_proven == (max(radii) < 1)


# --- designs --------------------------------------------------------------------------------------


def judged(design, n_modes):
    """Proven over true margin of a design, and the largest spectral radius up to the proven one."""
    law = pad_channels(design.controller, design.n_patches)
    found = prove_all_modes(design, law)
    without, gains = many_modes_loop(design, n_modes)
    radii = [spectral_radius(without + k * found.margin * gains) for k in (0.3, 0.7, 1.0)]
    return found.margin / found.base_margin, max(radii)


def test_what_is_proven_is_stable_with_many_modes(design):
    share, radius = judged(design, 40)
    assert radius < 1 and share > 0.9


@pytest.mark.long  # in short: one design, and bounds of single entries
def test_no_proven_design_is_unstable_with_200_modes():
    found = np.array([judged(random_design(seed), KNOWN) for seed in range(1000, 2000)])
    assert np.all(found[:, 1] < 1 + 1e-7)
    assert np.median(found[:, 0]) > 0.9


@pytest.mark.long  # in short: boxes that are not to be proven, and cells against their points
def test_boxes_of_random_designs():
    """No unstable machine in a proven box among samples; half of the boxes are proven."""
    proven, rng = [], np.random.default_rng(0)
    for seed in range(500, 520):
        design = random_design(seed)
        law = pad_channels(design.controller, design.n_patches)
        box = prove_box(design, law, 60.0)
        proven.append(box.is_proven)
        if box.is_proven:
            radius = SpectralRadius(design, law, design.study.link.basis)
            machines = [[rng.uniform(*ends) for ends in BOX] for _ in range(2000)]
            radii = [radius(*machine) for machine in machines]
            search = scipy.optimize.minimize(
                lambda machine, radius=radius: -radius(*machine),
                machines[int(np.argmax(radii))],
                method="L-BFGS-B",
                bounds=BOX,
                options={"maxfun": 60, "eps": 1e-4},
            )
            assert max(*radii, -search.fun) < 1 + 1e-7
    assert sum(proven) >= 10


# --- reports --------------------------------------------------------------------------------------

PROVEN = Proofs(
    AllModes(3.5, 3.7, LARGEST), ProvenBox(BOX, 0.0, True, LARGEST, cells=3282, seconds=4.0)
)


def test_statements_say_what_is_proven():
    first, second = proof_texts(PROVEN)
    assert first == (
        "proven for every number of modes from 12 on: stable with all gains scaled by up to 3.5 "
        "(12 modes alone: 3.7)"
    )
    assert second.startswith("proven: no unstable machine for stiffness of the links x 0.95 to")
    texts = [
        proof_texts(PROVEN.replace(box=PROVEN.box.replace(**changes)))[1]
        for changes in (
            {"undecided": 0.25},
            {"undecided": 1.0, "unstable": (0.95, 1.0, 0.1)},
            {"undecided": 1.0, "fault": "no bound"},
        )
    ]
    assert texts[0].startswith("undecided on 25 % of the box")
    assert texts[1].startswith("UNSTABLE machine in the box") and "x 0.95, 1 sample of" in texts[1]
    assert texts[2].endswith("no bound")
    none = PROVEN.replace(all_modes=AllModes(0.0, 0.19, LARGEST, "no bound"))
    assert proof_texts(none)[0] == "not proven for every number of modes: no bound"


def test_certificates_hold_their_proofs():
    found = certify(STUDY, sizes=(3,), bases=(SINES,), mismatches=(ModelMismatch(),))
    for proofs in (None, PROVEN):
        found = found.replace(proofs=proofs)
        data = json.loads(json_text(found))
        jsonschema.validate(data, schema("certify"))
        assert (data["proofs"] is None) == (proofs is None)
        assert ("roven: no unstable machine" in page(say(found))) == (proofs is not None)
    assert data["proofs"]["box"]["is_proven"] and data["proofs"]["all_modes"]["margin"] == 3.5


def with_box(found, **changes):
    """A certificate with proofs about a box."""
    return found.replace(proofs=PROVEN.replace(box=PROVEN.box.replace(**changes)))


#: Its plants have a gain margin of 1.5, its delay margin is below one sample.
LATE = {
    "electronics__sample_rate_hz": 16e3,
    "electronics__antialias_hz": 4e3,
    "control__gain_factor": 2.35,
}


@pytest.fixture(scope="module")
def near():
    """A certificate that passes on its plants, and what is known of its box."""
    study = STUDY.change(**LATE)
    plants = {"sizes": (3, LARGEST), "bases": (SINES,), "mismatches": (ModelMismatch(),)}
    other = fixed_controller(study)
    box = prove_box(other, pad_channels(other.controller, other.n_patches), 20.0)
    return certify(study, 1.2, **plants), box


def test_an_unstable_machine_of_the_box_fails_a_design_whose_plants_pass(near):
    found, box = near
    assert found.is_passed and found.unstable_machine is None
    assert box.unstable == (1.0, 0.5, 0.05)  # the first one tried
    failed = found.replace(proofs=PROVEN.replace(box=box))
    assert not failed.is_passed and failed.passes.all() and failed.fails_from == 0
    machine = "stiffness x 1, 0.5 samples of extra delay, 0.05 kg more payload"
    assert failed.verdict == (
        f"failed by an unstable machine in the box: {machine}; on the plants: gain margin 1.5, "
        "1.2 required"
    )
    data = json.loads(json_text(failed))
    jsonschema.validate(data, schema("certify"))
    assert not data["is_passed"] and data["verdict"] == failed.verdict
    assert data["fails_from"] == 0
    words = " ".join(text_of(page(say(failed))).split())
    first = words[: words.index("**Question:**")]
    assert "certificate failed" in first
    assert "2 of 2 plants pass" in words
    assert f"**Failed by an unstable machine in the box: {machine}; on the plants" in first
    assert "until `--prove` finds no unstable machine" in words and "studies export" not in words


def test_an_undecided_box_fails_nothing_and_is_said(near):
    for changes, said in (
        ({"undecided": 0.25}, "undecided on 25 % of the box"),
        ({"undecided": 1.0, "fault": "no bound"}, "nothing proven for stiffness"),
    ):
        found = with_box(near[0], **changes)
        assert found.is_passed and found.verdict.startswith("passed: ")
        words = " ".join(text_of(page(say(found))).split())
        assert said in words[: words.index("**Question:**")].lower()


def test_a_verdict_names_plant_and_machine_where_both_fail(near):
    found = with_box(near[0].replace(required_margin=2.0), unstable=(1.0, 0.5, 0.05))
    said = found.verdict
    assert said.startswith("failed by ") and "gain margin 1.5, 2 required; unstable machine" in said
    assert said.endswith("stiffness x 1, 0.5 samples of extra delay, 0.05 kg more payload")


def test_an_unstable_machine_of_one_mode_is_not_hidden_by_others():
    """Of a law that is judged mode by mode, one of which has no proof."""
    boxes = [
        PROVEN.box.replace(undecided=1.0, fault="no bound"),
        PROVEN.box.replace(undecided=1.0, unstable=(0.95, 1.0, 0.1)),
        PROVEN.box,
    ]
    waiting = iter(boxes)
    switching = fixed_controller(STUDY.change(control__law="modified_imsc"))
    with mock.patch.multiple(
        proofs_module,
        prove_box=lambda *_: next(waiting),
        prove_all_modes=lambda *_: PROVEN.all_modes,
    ):
        assert proofs_module.prove(switching).box == boxes[1]
