"""Modal bases against quadrature, finite elements and the paper's measured frequencies."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import piezo
from jaxmodel.bases import find_bases
from jaxmodel.beam import BASES, build_basis, held_frequency, pinned_free_roots
from jaxmodel.defaults import paper_machine
from jaxmodel.parameters import Damping
from jaxmodel.plant import damping_ratio
from jaxmodel.prepare import coupled_rate
from jaxmodel.response import held_modes
from studies.study.cases import as_arrays, build_case, build_structure
from tests.bare import paper_study

MACHINE = paper_machine()
BEAM, PATCHES = MACHINE.beam, MACHINE.patches
LENGTH = BEAM.length
LINE_MASS = BEAM.density * BEAM.width * BEAM.thickness
BARE_STIFFNESS = BEAM.youngs_modulus * BEAM.width * BEAM.thickness**3 / 12
N_MODES = 8
FACE_STEP = 1e-8  # for differences of shapes, whose curvature jumps there [m]


@partial(jax.jit, static_argnums=0)
def low_modes(kind, beam, patches, mask):
    """Three modes, with one station."""
    return build_basis(kind, beam, patches, 3, jnp.array([0.07]), mask)


def low_basis(kind, beam=BEAM, patches=PATCHES, mask=1.0):
    beam = type(beam)(*(np.broadcast_to(np.asarray(field, float), (3,)) for field in beam))
    patches = type(patches)(*(np.asarray(field, float) for field in patches))
    return low_modes(kind, beam, patches, np.broadcast_to(mask, (3,)))


def frequencies_hz(basis):
    return np.sqrt(np.asarray(basis.stiffness / basis.mass)) / (2 * np.pi)


def sections():
    """Ends of the stretches of constant section, their line mass and bending stiffness."""
    centers = np.asarray(PATCHES.center)[0]
    halves = np.array([PATCHES.sensor_length, PATCHES.actuator_length]) / 2
    ends = np.unique(np.r_[0, LENGTH, np.add.outer(centers, np.r_[-halves, halves]).ravel()])
    middle = (ends[1:] + ends[:-1]) / 2
    distance = np.abs(middle[:, None] - centers).min(axis=1)
    n_patches = (distance < halves[0]).astype(int) + (distance < halves[1])
    single = float(piezo.one_sided_section(BEAM, PATCHES).stiffness)
    double = float(piezo.two_sided_section(BEAM, PATCHES).stiffness)
    patch_mass = PATCHES.density * PATCHES.width * PATCHES.thickness
    extra = np.array([0.0, single, double])[n_patches]
    return ends, LINE_MASS + n_patches * patch_mass, BARE_STIFFNESS + extra


def points_and_weights(is_loaded):
    """Composite Gauss points [m] over the link and weights with the line mass [kg]."""
    node, weight = np.polynomial.legendre.leggauss(24)
    ends, line_mass, _ = sections()
    x = np.concatenate([(a + b) / 2 + (b - a) / 2 * node for a, b in pairwise(ends)])
    w = np.concatenate([(b - a) / 2 * weight for a, b in pairwise(ends)])
    return x, w * (np.repeat(line_mass, node.size) if is_loaded else LINE_MASS)


def patch_edges():
    """Right and left ends [m] of sensors and actuators, (2, 2, n_patches)."""
    halves = np.array([PATCHES.sensor_length, PATCHES.actuator_length])[:, None] / 2
    return np.stack([PATCHES.center[0] + halves, PATCHES.center[0] - halves])


@pytest.fixture(scope="module", params=BASES)
def shapes(request):
    """Kind, basis with eight modes, and its Y_j at Gauss points and beside all patch edges."""
    kind = request.param
    x, _ = points_and_weights(kind == "loaded")
    edges = patch_edges().ravel()
    stations = np.concatenate([x, edges + FACE_STEP, edges - FACE_STEP])
    build = jax.jit(lambda at: build_basis(kind, BEAM, PATCHES, N_MODES, at))
    basis = jax.tree.map(np.asarray, build(stations))
    tip = np.zeros(N_MODES) if basis.tip is None else basis.tip[0]
    shape = basis.deflection_at[0] + (stations / LENGTH)[:, None] * tip
    return kind, basis, shape[: x.size], shape[x.size :].reshape(2, 2, 2, 3, N_MODES)


def test_integrals_equal_quadrature_of_the_shapes(shapes):
    kind, basis, shape, _ = shapes
    x, w = points_and_weights(kind == "loaded")
    mass = w.sum()
    np.testing.assert_allclose(basis.link_mass, mass, rtol=1e-13)
    np.testing.assert_allclose(basis.first_moment, w @ x, rtol=1e-13)
    np.testing.assert_allclose(basis.inertia, w @ x**2, rtol=1e-13)
    np.testing.assert_allclose((shape.T * w) @ shape, np.diag(basis.mass[0]), atol=1e-12 * mass)
    np.testing.assert_allclose(basis.b[0], w @ shape, atol=1e-13 * mass)
    np.testing.assert_allclose(basis.c[0], (w * x) @ shape, atol=1e-13 * mass * LENGTH)


def test_slope_differences_are_those_of_the_shapes(shapes):
    _, basis, _, beside = shapes
    slope = (beside[0] - beside[1]) / (2 * FACE_STEP)  # (right or left, which patch, 3, R)
    for k, found in enumerate((basis.sensor_slope, basis.actuator_slope)):
        wanted = (slope[0, k] - slope[1, k]).T
        np.testing.assert_allclose(found[0], wanted, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize("kind", ["pinned_pinned", "loaded"])
def test_shortening_integrals_equal_quadrature_of_slopes(kind):
    """Of Y_j' Y_k' alone, and with the mass and its first moment beyond."""
    x, w = points_and_weights(is_loaded=False)
    w = w / LINE_MASS
    step = 1e-7  # within a section
    build = jax.jit(lambda at: build_basis(kind, BEAM, PATCHES, N_MODES, at))
    basis = jax.tree.map(np.asarray, build(np.concatenate([x + step, x - step])))
    slope = np.diff(basis.deflection_at[0].reshape(2, x.size, N_MODES), axis=0)[0] / (-2 * step)
    ends, line_mass, _ = sections()
    line_mass = line_mass if kind == "loaded" else np.full(len(ends) - 1, LINE_MASS)
    begin = np.clip(x[:, None], ends[:-1], ends[1:])
    beyond = (ends[1:] - begin) @ line_mass, (ends[1:] ** 2 - begin**2) @ line_mass / 2
    mixed = 0 if basis.mixed_shortening is None else basis.mixed_shortening[0]
    for found, weight in (
        (np.diag(basis.shortening[0]) + mixed, w),
        (basis.inward[0], w * beyond[0]),
        (basis.centrifugal[0], w * beyond[1]),
    ):
        wanted = (slope.T * weight) @ slope
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize(("kind", "share"), [("pinned_pinned", 1 / 2), ("pinned_free", 1 / 4)])
def test_bare_shapes_satisfy_the_beam_equation_in_their_normalisation(kind, share):
    basis = low_basis(kind)
    np.testing.assert_allclose(basis.mass, share * 0.011, rtol=1e-14)
    root = pinned_free_roots(3) if kind == "pinned_free" else np.arange(1, 4) * np.pi
    omega = (root / LENGTH) ** 2 * np.sqrt(BARE_STIFFNESS / LINE_MASS)
    np.testing.assert_allclose(basis.stiffness[0], omega**2 * basis.mass[0], rtol=1e-12)


def test_pinned_free_roots_and_frequencies():
    root = pinned_free_roots(16)
    np.testing.assert_allclose(root[:3], [3.9266, 7.0686, 10.2102], atol=5e-5)
    np.testing.assert_allclose(np.tan(root), np.tanh(root), rtol=1e-12)
    basis = low_basis("pinned_free")
    np.testing.assert_allclose(frequencies_hz(basis)[0], [178.7, 579, 1208], rtol=5e-4)


def test_links_off_their_chords_limit_the_step_by_the_shortest():
    study = paper_study().change(
        link__basis="pinned_free", link__length=(0.22, 0.2, 0.24), link__modes=3
    )
    found = coupled_rate(build_structure(study), as_arrays(build_case(study)))
    omega = (pinned_free_roots(3)[-1] / 0.2) ** 2 * np.sqrt(BARE_STIFFNESS / LINE_MASS)
    np.testing.assert_allclose(found, omega, rtol=1e-12)
    on_chord = study.change(link__basis="pinned_pinned")
    assert coupled_rate(build_structure(on_chord), as_arrays(build_case(on_chord))) == 0


def test_modes_of_links_alone():
    """Between held joints, of links of three lengths."""
    length = np.array([0.2, 0.22, 0.24])
    study = paper_study().change(link__length=tuple(length), link__damping_ratio=0.02)
    modes = jax.jit(held_modes, static_argnums=0)
    hertz, zeta = modes(build_structure(study), as_arrays(build_case(study)))
    n = np.arange(1, hertz.shape[1] + 1)
    wanted = np.pi / 2 * np.sqrt(BARE_STIFFNESS / LINE_MASS) * (n / length[:, None]) ** 2
    np.testing.assert_allclose(hertz, wanted, rtol=1e-10)
    np.testing.assert_allclose(zeta, 0.02, rtol=1e-12)


def test_frequencies_of_held_ends():
    soft = BEAM._replace(stiffness_factor=np.array([1.0, 0.8, 0.8]))
    for kind, like in (
        ("pinned_pinned", "pinned_pinned"),
        ("pinned_free", "pinned_pinned"),
        ("loaded", "loaded"),
    ):
        found = np.asarray(held_frequency(kind, soft, low_basis(kind, soft))) / (2 * np.pi)
        np.testing.assert_allclose(found, frequencies_hz(low_basis(like, soft)), rtol=1e-12)
    bare = np.asarray(held_frequency("pinned_free", BEAM, low_basis("pinned_free"))) / (2 * np.pi)
    np.testing.assert_allclose(bare, np.tile([114.39, 457.55, 1029.5], (3, 1)), rtol=5e-5)


def test_the_controller_s_model_has_nominal_stiffness():
    nominal, soft = (
        paper_study().change(link__basis="loaded", link__stiffness_factor=factor)
        for factor in ((1.0,) * 3, (1.0, 0.8, 1.3))
    )
    structure = build_structure(nominal)._replace(controller_basis="loaded")
    wanted, found = (find_bases(structure, as_arrays(build_case(x))) for x in (nominal, soft))
    for name in ("stiffness", "mass", "sensor_slope", "static_slope", "static_deflection"):
        one, other = (getattr(bases.model, name) for bases in (found, wanted))
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())
    np.testing.assert_allclose(
        found.plant.stiffness, wanted.plant.stiffness * np.array([[1.0], [0.8], [1.3]]), rtol=1e-9
    )


def test_high_pinned_free_modes_do_not_overflow():
    n_modes = 300  # sinh(kL) itself overflows from mode 226 on
    stations = np.array([0.0, 0.1, LENGTH])
    basis = jax.jit(lambda: build_basis("pinned_free", BEAM, PATCHES, n_modes, stations))()
    assert all(np.isfinite(part).all() for part in jax.tree.leaves(basis))
    np.testing.assert_allclose(basis.deflection_at[:, [0, 2]], 0, atol=1e-13)
    assert np.abs(basis.deflection_at).max() < 2


@pytest.mark.parametrize("ends", [(1.1e-5, 0.0), (0.0, 1.1e-5)])
def test_loaded_frequencies_are_the_papers_measurement(ends):
    joints = BEAM._replace(joint_inertia_b=ends[0], joint_inertia_c=ends[1])
    loaded = frequencies_hz(low_basis("loaded", joints))
    np.testing.assert_allclose(loaded[0, :2], [92.5, 240.2], rtol=5e-3)
    nothing = PATCHES._replace(density=0.0, youngs_modulus=1.0)
    bare = frequencies_hz(low_basis("loaded", joints, nothing))
    np.testing.assert_allclose(bare[0, :2], [90.0, 240.8], rtol=5e-3)


def finite_element_frequencies_hz(joint_b, joint_c, per_section=8):
    """Pinned-pinned link with patches by Hermite beam elements."""
    ends, line_mass, stiffness = sections()
    nodes = np.concatenate([np.linspace(a, b, per_section + 1)[:-1] for a, b in pairwise(ends)])
    nodes = np.append(nodes, LENGTH)
    size = 2 * nodes.size
    m, k = np.zeros((size, size)), np.zeros((size, size))
    for e, h in enumerate(np.diff(nodes)):
        part = slice(2 * e, 2 * e + 4)
        scale = np.diag([1, h, 1, h])
        k_unit = [[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]]
        m_unit = [[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]
        k[part, part] += stiffness[e // per_section] / h**3 * scale @ k_unit @ scale
        m[part, part] += line_mass[e // per_section] * h / 420 * scale @ m_unit @ scale
    m[1, 1] += joint_b
    m[-1, -1] += joint_c
    free = np.delete(np.arange(size), [0, size - 2])
    inverse = np.linalg.inv(np.linalg.cholesky(m[np.ix_(free, free)]))
    value = np.linalg.eigvalsh(inverse @ k[np.ix_(free, free)] @ inverse.T)
    return np.sqrt(value) / (2 * np.pi)


@pytest.mark.parametrize("ends", [(0.0, 0.0), (1.1e-5, 0.4e-5)])
def test_loaded_frequencies_equal_finite_elements(ends):
    joints = BEAM._replace(joint_inertia_b=ends[0], joint_inertia_c=ends[1])
    basis = low_basis("loaded", joints)
    wanted = finite_element_frequencies_hz(*ends)[:3]
    np.testing.assert_allclose(frequencies_hz(basis), np.tile(wanted, (3, 1)), rtol=5e-3)


def test_patches_add_17_percent_mass_and_31_to_69_percent_stiffness():
    loaded = low_basis("loaded")
    np.testing.assert_allclose(loaded.link_mass / 0.011 - 1, 0.17, atol=5e-3)
    single = piezo.one_sided_section(BEAM, PATCHES).stiffness / BARE_STIFFNESS
    double = piezo.two_sided_section(BEAM, PATCHES).stiffness / BARE_STIFFNESS
    np.testing.assert_allclose([single, double], [0.31, 0.69], atol=5e-3)


def test_one_sided_section_equals_integral_over_the_thickness():
    face, outer = BEAM.thickness / 2, BEAM.thickness / 2 + PATCHES.thickness
    e_a = BEAM.youngs_modulus * BEAM.width * np.array([2 * face, 0, 2 * face**3 / 3])
    own = [outer - face, (outer**2 - face**2) / 2, (outer**3 - face**3) / 3]
    e_p = PATCHES.youngs_modulus * PATCHES.width * np.array(own)
    zeroth, first, second = e_a + e_p  # moments of E about the mid-plane
    section = piezo.one_sided_section(BEAM, PATCHES)
    np.testing.assert_allclose(section.neutral_axis, first / zeroth, rtol=1e-12)
    expected = second - first**2 / zeroth - BARE_STIFFNESS
    np.testing.assert_allclose(section.stiffness, expected, rtol=1e-12)


def test_piezo_constants():
    np.testing.assert_allclose(piezo.actuator_constant(BEAM, PATCHES), 1.194e-4, atol=5e-8)
    np.testing.assert_allclose(piezo.sensor_constant(BEAM, PATCHES), 1.957e4, atol=5)
    positive = PATCHES._replace(d31=180e-12)
    assert piezo.actuator_constant(BEAM, positive) == piezo.actuator_constant(BEAM, PATCHES)
    assert piezo.sensor_constant(BEAM, positive) == piezo.sensor_constant(BEAM, PATCHES)


def test_placement_moves_loaded_frequencies_with_a_right_gradient():
    def log_squared(centers):
        basis = build_basis("loaded", BEAM, PATCHES._replace(center=centers), 3, jnp.array([0.07]))
        return jnp.log(basis.stiffness[1] / basis.mass[1])

    centers = jnp.array([[0.05, 0.10, 0.15], [0.041, 0.093, 0.152], [0.05, 0.10, 0.15]])
    reverse = jax.jit(jax.jacrev(log_squared))(centers)
    assert np.isfinite(reverse).all()
    assert np.abs(reverse[:, 1]).max() > 0.1  # 1/m: a patch moved by 1 cm shifts modes by 0.1 %
    np.testing.assert_array_equal(reverse[:, [0, 2]], 0)  # other links' patches
    h = 1e-5
    for k in range(3):
        move = jnp.zeros((3, 3)).at[1, k].set(h)
        moved = [PATCHES._replace(center=centers + sign * move) for sign in (1, -1)]
        plus, minus = (2 * np.log(frequencies_hz(low_basis("loaded", BEAM, p))[1]) for p in moved)
        slope = (plus - minus) / (2 * h)
        np.testing.assert_allclose(reverse[:, 1, k], slope, atol=1e-5 * np.abs(reverse).max())


def test_mode_mask_removes_every_coupling_and_keeps_the_oscillators():
    mask = np.array([1.0, 0.0, 1.0])
    for kind in BASES:
        whole, masked = low_basis(kind), low_basis(kind, mask=mask)
        for name in ("b", "c", "tip", "deflection_at"):
            full = getattr(whole, name)
            if full is not None:
                np.testing.assert_array_equal(getattr(masked, name), full * mask)
        for name in ("sensor_slope", "actuator_slope"):
            np.testing.assert_array_equal(
                getattr(masked, name), getattr(whole, name) * mask[:, None]
            )
        np.testing.assert_array_equal(masked.mass, whole.mass)
        np.testing.assert_array_equal(masked.stiffness, whole.stiffness)


def test_faults_name_value_and_allowed_range():
    with pytest.raises(ValueError, match="pinned_pined.*pinned_pinned"):
        build_basis("pinned_pined", BEAM, PATCHES, 3, np.array([0.1]))
    with pytest.raises(ValueError, match="n_modes = 0"):
        build_basis("loaded", BEAM, PATCHES, 0, np.array([0.1]))


def test_damping_goes_on_from_the_modes_given():
    """Measured ratios of two modes; beyond them as mass or stiffness would have it."""
    omega = np.array([[1.0, 4.0, 9.0, 16.0]] * 3)
    ratio, count = np.array([[0.02, 0.01], [0.03, 0.03], [0.01, 0.05]]), np.array([2, 1, 2])
    for power, wanted in (
        (0, [[0.02, 0.01, 0.01, 0.01], [0.03, 0.03, 0.03, 0.03]]),
        (-1, [[0.02, 0.01, 0.04 / 9, 0.0025], [0.03, 0.03 / 4, 0.03 / 9, 0.03 / 16]]),
        (1, [[0.02, 0.01, 0.0225, 0.04], [0.03, 0.12, 0.27, 0.48]]),
    ):
        found = damping_ratio(Damping(ratio, count, float(power)), omega)
        np.testing.assert_allclose(found[:2], wanted, rtol=1e-12)
