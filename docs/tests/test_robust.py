"""H-infinity by python-control, as in notebook 7, and what fixed structure gives away."""

import ast
from functools import cache, partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are
from scipy.optimize import minimize, minimize_scalar
from test_notebooks import code_cells, read

from jaxmodel.controller import linear_law
from jaxmodel.numbers import case_of
from jaxmodel.prepare import prepare
from jaxmodel.sampled_response import controller_response
from studies.engine.preflight import check_run
from studies.single.plant import controller_of, plant_of
from studies.study.numbers import one_study, position, put
from studies.study.spec import parse_study
from tests.documents import page
from tests.jaxmodel.test_state_space import SHORT

ct = pytest.importorskip("control", reason="extra robust: pip install '.[robust]'")
ctrlsys = pytest.importorskip("ctrlsys", reason="extra robust: pip install '.[robust]'")

pytestmark = pytest.mark.long  # with the extra `robust`, which only `make campaigns` installs

FIELDS = {
    "ratio 2": [f"control.ratios[{i}][1]" for i in range(3)],
    "ratio 3": [f"control.ratios[{i}][2]" for i in range(3)],
}
RANGE = (0.02, 50.0)
#: Numbers of each law, the same for all links, and their ranges as multiples of where they start.
FREE = {
    "imsc": {"control.velocity_gain": RANGE, "ratio 2": RANGE, "ratio 3": RANGE}
    | {"electronics.highpass_hz": (0.02, 5.0)}
    | {f"electronics.lowpass_ratio[{k}]": (0.3, 4.0) for k in range(3)}
    | {f"electronics.lowpass_zeta[{k}]": (0.2, 4.0) for k in range(3)},
    "observer": {"control.velocity_gain": RANGE, "ratio 2": RANGE, "ratio 3": RANGE}
    | {"control.laws.observer.observer_damping": (0.05, 3.2)}
    | {"control.laws.observer.bending_hz": (0.01, 8.0)},
    "lqg": {
        "control.laws.lqg.voltage_weight": (1e-4, 1e4),
        "control.laws.lqg.disturbance": (1e-2, 1e3),
        "control.laws.lqg.bending_hz": (0.01, 8.0),
    },
}
#: Machine, frequency of its mode 1 [Hz], and what it has instead of the default.
MACHINES = {
    "default": (115.0, {}),
    "links with their patches": (115.0, {"link": {"basis": "loaded"}}),
    "links 30 % lighter": (137.0, {"link": {"density": 1925.0}}),
}


@cache
def notebook():
    """The functions that notebook 7 defines."""
    names = {"np": np, "ct": ct, "ctrlsys": ctrlsys}
    for cell in code_cells(read("7_python_control")):
        lines = (x for x in cell.source.splitlines() if not x.startswith("%"))
        tree = ast.parse("\n".join(lines))
        tree.body = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
        exec(compile(tree, "notebook 7", "exec"), names)
    return SimpleNamespace(**names)


@cache
def machine(name):
    """Study, plant and weights."""
    first, changes = MACHINES[name]
    study = parse_study(changes)
    plant = notebook().to_control(plant_of(study))
    return study, plant, notebook().weights(plant.dt, first)


def singular_value(system, angle):
    """Largest one at z = e^(j angle)."""
    state = np.linalg.solve(np.exp(1j * angle) * np.eye(system.nstates) - system.A, system.B)
    return np.linalg.svd(system.C @ state + system.D, compute_uv=False)[0]


def angles_of(poles):
    """[rad], dense beside poles of the upper half plane."""
    rate = np.log(poles[(np.abs(poles) > 0.3) & (poles.imag >= 0)])
    beside = np.abs(rate.imag) + np.tan(np.linspace(-1.4, 1.4, 9))[:, None] * np.abs(rate.real)
    angles = np.concatenate([np.geomspace(3e-4, np.pi, 100), beside.ravel()])
    return np.unique(np.clip(angles, 1e-6, np.pi).round(9))


def searched_norm(system):
    """On a grid, then refined."""
    angles = angles_of(system.poles())
    values = np.array([singular_value(system, x) for x in angles])
    best = values.max()
    for k in np.argsort(-values)[:4]:
        bounds = angles[max(k - 1, 0)], angles[min(k + 1, len(angles) - 1)]
        found = minimize_scalar(
            lambda x: -singular_value(system, x), bounds=bounds, options={"xatol": 1e-10}
        )
        best = max(best, -found.fun)
    return best


def test_a_norm_is_that_of_a_search_and_of_python_control():
    use = notebook()
    study = parse_study(SHORT)
    plant, law = use.to_control(plant_of(study)), use.to_control(controller_of(study))
    weighted = use.generalised_plant(plant, *use.weights(plant.dt))
    closed = weighted.lft(law)
    norm = use.hinf_norm(closed)
    np.testing.assert_allclose(norm, searched_norm(closed), rtol=1e-6)
    continuous = ct.ss(*use.bilinear(closed))
    wanted = ct.norm(continuous, "inf", tol=1e-8, method="scipy")
    np.testing.assert_allclose(norm, wanted, rtol=1e-6)
    assert use.hinf_norm(weighted.lft(5 * law)) == np.inf  # unstable


def test_the_optimum_is_that_of_two_riccati_equations():
    """Normalised coprime factors: sqrt(1 + rho(X Z)) (Glover and McFarlane 1989)."""
    use = notebook()
    plant = use.balanced(use.to_control(plant_of(parse_study(SHORT))), 1e-3)
    n, eye, none = plant.noutputs, np.eye(9), np.zeros((9, 9))
    # from (n, d, u) to (y + n, u, y + n)
    enter = np.block([[none, eye, eye], [eye, none, none], [none, none, eye]])
    leave = np.block([[eye, eye, none], [none, none, eye], [eye, eye, none]])
    gain = [ct.ss([], [], [], x, plant.dt) for x in (leave, np.eye(2 * n), enter)]
    coprime = gain[0] * ct.append(plant, gain[1]) * gain[2]
    law, norm = use.hinf(coprime, n)
    a, b, c, d = use.bilinear(plant)
    seen, driven = eye + d @ d.T, eye + d.T @ d
    x = solve_continuous_are(a, b, c.T @ c, driven, s=c.T @ d)
    z = solve_continuous_are(a.T, c.T, b @ b.T, seen, s=b @ d.T)
    wanted = np.sqrt(1 + np.abs(np.linalg.eigvals(x @ z)).max())
    assert abs(norm / wanted - 1) < 1e-3
    assert wanted * (1 - 1e-6) < use.hinf_norm(coprime.lft(law)) < 1.001 * wanted


def weighted_response(plant, law, of_d, of_u, volts=0.1):
    """From (d, n) to (y/volts, weighted u), by frequency responses, (F, 18, 18)."""
    eye = jnp.broadcast_to(jnp.eye(plant.shape[1]), plant.shape)
    entering = jnp.concatenate([of_d * plant, volts * eye], axis=2)
    measured = jnp.linalg.inv(eye - plant @ law) @ entering
    noise = jnp.concatenate([0 * eye, volts * eye], axis=2)
    return jnp.concatenate([(measured - noise) / volts, of_u * (law @ measured)], axis=1)


def smooth_log_norm(matrix, doublings):
    """log of the 2^(doublings + 1)-norm of singular values at all frequencies, ()."""
    power, log = jnp.conj(jnp.swapaxes(matrix, 1, 2)) @ matrix, jnp.zeros(len(matrix))
    for k in range(doublings + 1):
        size = jnp.real(jnp.trace(power, axis1=1, axis2=2))
        log = log + jnp.log(size)
        power = power / size[:, None, None]
        if k < doublings:
            power, log = power @ power, 2 * log
    return jax.nn.logsumexp(log) / 2 ** (doublings + 1)


def response(system, z):
    return system.C @ np.linalg.solve(z * np.eye(system.nstates) - system.A, system.B + 0 * z)


def tuned(name, law):
    """The study whose law has the numbers of smallest norm, by exact gradients."""
    study, plant, weights = machine(name)
    study = study.change(control__law=law)
    structure = check_run(study)[0]._replace(n_steps=1, substeps=1, is_smooth=True)
    numbers = one_study(study, structure)
    places = [[position(study, x) for x in FIELDS.get(name, [name])] for name in FREE[law]]
    begin = np.array([np.mean(numbers[group[0][0]][group[0][1]]) for group in places])
    z = np.exp(1j * angles_of(plant.poles()))
    at = z[:, None, None]
    fixed = response(plant, at) + plant.D
    shapes = [response(x, at) + x.D for x in weights]

    def controller_with(change):
        changed = numbers
        for group, value in zip(places, begin * jnp.exp(change), strict=True):
            for place in group:
                changed = put(changed, place, value)
        return prepare(structure, case_of(structure, changed)).loop.controller

    def objective(change, doublings):
        controller = controller_with(change)
        gains = jax.vmap(lambda z: controller_response(controller, z))(z)
        return smooth_log_norm(weighted_response(fixed, gains, *shapes), doublings)

    program = jax.jit(jax.value_and_grad(objective), static_argnums=1)

    law_with = jax.jit(lambda change: linear_law(controller_with(change)))

    def evaluate(doublings, change):
        value, slope = program(change, doublings)
        is_stable = radius(plant, map(np.asarray, law_with(change))) < 1
        # frequency responses alone would not see it
        return float(value) if is_stable else 10.0, np.asarray(slope)

    bounds = np.log(list(FREE[law].values()))
    found = np.zeros(len(begin))
    for doublings in (4, 8):
        found = minimize(partial(evaluate, doublings), found, jac=True, bounds=bounds).x
    values = dict(zip(FREE[law], begin * np.exp(found), strict=True))
    return with_values(study, values)


def radius(plant, law):
    """Of the closed loop's poles, with a law as `linear_law` gives it."""
    a, b, c, d = law
    n = len(c)
    state = np.block([[a, b[:, n:]], [c, d[:, n:]]])
    enter, leave, direct = np.vstack([b, d])[:, :n], np.hstack([c, d[:, n:]]), d[:, :n]
    own = plant.A + plant.B @ direct @ plant.C
    whole = np.block([[own, plant.B @ leave], [enter @ plant.C, state]])
    return np.abs(np.linalg.eigvals(whole)).max()


def with_values(study, values):
    """One value for all links."""
    changes = {}
    for name, value in values.items():
        value = float(value)
        if name.startswith("ratio"):
            rows = changes.setdefault("control__ratios", [list(x) for x in study.control.ratios])
            for row in rows:
                row[int(name[-1]) - 1] = value
        elif name.endswith("]"):
            field = name[:-3]
            start = list(getattr(study.electronics, field.split(".")[1]))
            changes.setdefault(field.replace(".", "__"), start)[int(name[-2])] = value
        elif name == "control.velocity_gain":
            changes["control__velocity_gain"] = [value] * 3
        elif name.startswith("control.laws"):
            own = changes.setdefault("control__laws", {study.control.law: {}})
            own[study.control.law][name.split(".")[-1]] = value
        else:
            changes[name.replace(".", "__")] = value
    return study.change(**changes)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", MACHINES)
def test_what_fixed_structure_gives_away(name):
    """The table of docs/how-to/own-controller.md."""
    use = notebook()
    study, plant, weights = machine(name)
    weighted = use.generalised_plant(plant, *weights)
    small = use.balanced(plant, 1e-3)
    full, promised = use.hinf(use.generalised_plant(small, *weights), 9)
    best = use.hinf_norm(weighted.lft(full))
    assert 0.99 < best / promised < 1.02  # truncation costs no more
    norms = {"full order": best, "default": norm_of(name, study)}
    for law in FREE:
        norms[law] = norm_of(name, tuned(name, law))
        assert best < norms[law] < np.inf
    columns = ("full order", "default", *FREE)
    found = [norms[column] for column in columns]
    np.testing.assert_allclose(table_row(name), found, rtol=0.005)


def table_row(name):
    """Norms of a machine in the table."""
    text = page("docs/how-to/own-controller.md")
    (row,) = (x for x in text.splitlines() if x.startswith(f"| {name} |"))
    return [float(x.split()[0]) for x in row.strip("| ").split("|")[1:]]


def norm_of(name, study):
    """Of a study's controller around a machine."""
    _, plant, weights = machine(name)
    law = notebook().to_control(controller_of(study))
    return notebook().hinf_norm(notebook().generalised_plant(plant, *weights).lft(law))
