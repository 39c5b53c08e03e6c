"""Equations of motion (1)-(9), reduced to pose and modes by Kane's method, O(R) per link.

The mass matrix is a block arrow: links couple only through the three pose accelerations. Per link,
the modal accelerations are eliminated through a few sums; one symmetric 3x3 system then gives the
pose, back-substitution the rest. docs/theory.md derives each line. Elementwise arithmetic only.
Shapes as in `jaxmodel.plant`: structure first, lanes last.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.kinematics import Bend, Chain, close_chain
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.plant import Plant


class Accelerations(NamedTuple):
    """Result of one evaluation of the dynamics."""

    pose: Num[Array, "pose"]  # X'' [m/s2, m/s2, rad/s2]
    modal: Num[Array, "links Q"]  # q'' [m/s2]
    coupling: Num[Array, "links Q"]  # q'' + (k q + d q')/m: all except the oscillator itself [m/s2]
    rho: Num[Array, "links"]  # rho'' [m/s2]
    beta: Num[Array, "links"]  # beta'' of the links in the plane [rad/s2]
    axial: Num[Array, "links"]  # N, tension in the link that acts on its bending [N]


def shortening_row(plant: Plant, q: Array) -> Array:
    """(S q)_j, shortening of the chord by bending per coordinate [1], (3, R), 0 of an elongation.

    Of links that lengthen q has one coordinate more than there are modes.
    """
    if plant.shortening is None:
        return jnp.zeros_like(q)
    modes = q if plant.stretch is None else q[:, :-1]
    row = plant.shortening * modes
    if plant.mixed_shortening is not None:
        row = row + _times(plant.mixed_shortening, modes)
    return (
        row if plant.stretch is None else jnp.concatenate([row, jnp.zeros_like(q[:, -1:])], axis=1)
    )


def chord_row(plant: Plant, q: Array) -> Array:
    """Shortening of the chord per coordinate by bending and elongation, S q - a [1], (3, R)."""
    row = shortening_row(plant, q)
    if plant.stretch is None:
        return row
    longer = plant.stretch[:, None] + jnp.zeros_like(q[:, -1:])
    return jnp.concatenate([row[:, :-1], -longer], axis=1)


def _times(matrix: Array, q: Array) -> Array:
    """Matrices of links (3, R, R) times modal coordinates (3, R)."""
    return jnp.sum(matrix * q[:, None], axis=2)


def modal_chain(plant: Plant, pose: Array, pose_rate: Array, q: Array, q_rate: Array) -> Chain:
    """`close_chain` of the bent machine (4), (6): w = sum Y_j(L) q_j, d = 1/2 sum S_jk q_j q_k - e.

    Args:
        plant: the machine.
        pose: (3,) [m, m, rad].
        pose_rate: (3,).
        q: modal coordinates [m], (3, R).
        q_rate: [m/s], (3, R).
    """
    if plant.tip is not None:
        tip, tip_rate = jnp.sum(plant.tip * q, axis=1), jnp.sum(plant.tip * q_rate, axis=1)
        return close_chain(plant, pose, pose_rate, Bend(tip, tip_rate))
    if _is_rigid(plant):
        return close_chain(plant, pose, pose_rate)
    row = chord_row(plant, q)
    shorter, rate = jnp.sum(row * q, axis=1) / 2, jnp.sum(row * q_rate, axis=1)
    if plant.stretch is not None:
        shorter = shorter - plant.stretch * q[:, -1] / 2
    return close_chain(plant, pose, pose_rate, Bend(shortening=shorter, shortening_rate=rate))


class _Link(NamedTuple):
    """A link in (rho, gamma) with its modes eliminated: K (rho'', gamma'') + load."""

    k_rr: Array
    k_rg: Array
    k_gg: Array
    load_r: Array
    load_g: Array


class _Joint(NamedTuple):
    """Force that a link needs from the platform at C along f and g: W C'' + load."""

    ff: Array  # W [kg]
    fg: Array
    gg: Array
    load_f: Array  # [N]
    load_g: Array


def accelerations(
    plant: Plant,
    chain: Chain,
    pose_rate: Num[Array, "pose"],
    q: Num[Array, "links Q"],
    q_rate: Num[Array, "links Q"],
    slider_force: Num[Array, "links"],
    piezo: Num[Array, "links Q"],
    wrench: Num[Array, "pose"] | None = None,
    is_coupled: bool = True,
    torque: Num[Array, "links"] | None = None,
) -> Accelerations:
    """Accelerations of pose and modes, (7) solved.

    Args:
        plant: the machine.
        chain: closure at this state, from `modal_chain`; without coupling that of straight links.
        pose_rate: [m/s, m/s, rad/s].
        q: modal coordinates [m].
        q_rate: [m/s].
        slider_force: on the actuated joints [N].
        piezo: generalised piezo forces (14) over the modal masses, Q_j/m_j [m/s2].
        wrench: force and moment on the platform at its reference point [N, N, N m], or None.
        is_coupled: False: kineto-elastodynamics in two passes (static): the machine moves as if its
            links were rigid, motion and axial forces bend the links, and nothing acts back.
        torque: on the links [N m], or None.

    Returns:
        Accelerations.

    Example:
        >>> plant = prepare(*paper_case({"link.modes": 2})).loop.plant
        >>> pose, zero, q = jnp.array(HOME), jnp.zeros(3), jnp.zeros((3, 3))
        >>> force = jnp.array([1.0, 0.0, 0.0])
        >>> chain = close_chain(plant, pose, zero)
        >>> accelerations(plant, chain, zero, q, q, force, q).pose.shape
        (3,)
    """
    swing = _swing(plant, chain, q_rate)
    # modal accelerations without inertia: of piezos and rotation, and of the oscillator itself
    mass = plant.modal_mass[:, None]
    spread = _spread(plant, q)
    thrown = q if spread is None else q - spread.turning / mass
    push = piezo + thrown * (chain.beta_rate * chain.beta_rate)[:, None]
    if chain.turning is not None:
        push = push - (plant.b / mass) * (chain.cosine * chain.turning)[:, None]
        if spread is not None:
            push = push + (spread.inward / mass) * (chain.sine * chain.turning)[:, None]
    own = (plant.stiffness / mass) * q + (plant.damping / mass) * q_rate
    pull = own - push
    end = None
    if is_coupled:
        link = _link(plant, chain, swing, q, q_rate, pull, slider_force)
        if spread is not None:
            link = _spread_out(plant, chain, spread, link, q, q_rate, pull)
        if torque is not None:
            link = link._replace(load_g=link.load_g - torque)
        joint = _joint(chain, link)
        if not _is_rigid(plant):
            end, joint = _release_end(plant, chain, joint, q, pull, spread)
    else:
        joint = _joint(chain, _rigid_link(plant, chain, swing, slider_force))
    rates, phi2 = (swing.f, swing.g), None
    if chain.turn is not None:
        phi2 = pose_rate[2] * pose_rate[2]
        rates = swing.f - phi2 * chain.frame.c_f, swing.g - phi2 * chain.frame.c_g
    pose_acc = _pose_acceleration(plant, chain, joint, rates, phi2, wrench)

    acc_f, acc_g = (a + b for a, b in zip(rates, chain.frame.joint_motion(pose_acc), strict=True))
    force_f = joint.ff * acc_f + joint.fg * acc_g + joint.load_f
    force_g = joint.fg * acc_f + joint.gg * acc_g + joint.load_g
    coupling = push
    if end is not None:
        reaction = end.force[0] + end.force[1] * acc_f + end.force[2] * acc_g
        acc_f = end.motion[1] * acc_f + end.motion[2] * acc_g - end.motion[0]
        coupling = coupling - end.row * (reaction / plant.modal_mass)[:, None]
    rho_acc, beta_acc = chain.frame.link_motion(acc_f, acc_g)
    coupling = coupling + (plant.b / mass) * (chain.sine * rho_acc)[:, None]
    coupling = coupling - (plant.c / mass) * beta_acc[:, None]
    # the mass between mid-span and C takes its share of the force at C
    tension = force_f if chain.bend.tip is None else force_g
    axial = tension - plant.tip_mass * chain.cosine * rho_acc
    if chain.turning is not None:
        axial = axial - plant.tip_mass * chain.sine * chain.turning
    if not is_coupled and plant.shortening is not None:
        coupling = coupling - shortening_row(plant, q) * (axial / plant.modal_mass)[:, None]
    if spread is not None:
        coupling = coupling + spread.inward * (chain.cosine * rho_acc / plant.modal_mass)[:, None]
    return Accelerations(
        pose=pose_acc,
        modal=coupling - own,
        coupling=coupling,
        rho=rho_acc,
        beta=beta_acc,
        axial=axial,
    )


def _is_rigid(plant: Plant) -> bool:
    """Whether bending leaves the distance between a link's joints unchanged."""
    return plant.tip is None and plant.shortening is None and plant.stretch is None


class _Swing(NamedTuple):
    """Contribution of gamma' and bending to C'' [m/s2]."""

    f: Num[Array, "links"]  # along f and g, sign reversed: what rho'' and gamma'' must give
    g: Num[Array, "links"]
    inward: Num[Array, "links"]  # gamma'^2 c + e2, along the chord
    across: Num[Array, "links"]  # 2 gamma' d', of a point moving inwards along the chord


def _swing(plant: Plant, chain: Chain, q_rate: Array) -> _Swing:
    """In the link, C is at (c, w) and moves by (-d', w'); velocities alone make its acceleration

    -gamma'^2 (c, w) + 2 gamma' (-w', -d') + (-e2, 0), e2 = sum S_jk q_j' q_k', and that of B.
    """
    rate, bend = chain.beta_rate, chain.bend
    rate2 = rate * rate
    inward, across = chain.chord * rate2, jnp.zeros_like(rate)
    if bend.shortening_rate is not None:
        inward = inward + jnp.sum(shortening_row(plant, q_rate) * q_rate, axis=1)
        across = 2 * rate * bend.shortening_rate
    if bend.tip is None:
        f, g = inward, across
        to_f, to_g = chain.sine, chain.cosine
    else:  # f = -n_t, g = t
        f, g = -bend.tip * rate2, inward + 2 * rate * bend.tip_rate
        to_f, to_g = -chain.cosine, chain.sine
    if chain.turning is not None:
        f, g = f - to_f * chain.turning, g - to_g * chain.turning
    return _Swing(f, g, inward, across)


def _link(
    plant: Plant,
    chain: Chain,
    swing: _Swing,
    q: Array,
    q_rate: Array,
    pull: Array,
    slider_force: Array,
) -> _Link:
    """Slider and link after eliminating q'', except for the effect of the modes on C."""
    sine, cosine, rate, mass = chain.sine, chain.cosine, chain.beta_rate, plant.modal_mass
    bq, bq_rate = jnp.sum(plant.b * q, axis=1), jnp.sum(plant.b * q_rate, axis=1)
    # the centre of mass moves inwards by half the shortening
    across = jnp.sum(plant.b * pull, axis=1) + bq * (rate * rate) + plant.tip_mass * swing.across
    along = plant.tip_mass * swing.inward + 2 * rate * bq_rate
    bb, bc, cc = (
        jnp.sum(x * y, axis=1) / mass
        for x, y in ((plant.b, plant.b), (plant.b, plant.c), (plant.c, plant.c))
    )
    load_g = 2 * rate * (mass * jnp.sum(q * q_rate, axis=1)) - jnp.sum(plant.c * pull, axis=1)
    if chain.turning is not None:
        load_g = load_g + (plant.tip_mass * chain.chord * cosine - bq * sine) * chain.turning
    return _Link(
        k_rr=plant.slider_link_mass - sine * sine * bb,
        k_rg=sine * (bc - plant.tip_mass * chain.chord) - cosine * bq,
        k_gg=plant.inertia - cc + mass * jnp.sum(q * q, axis=1),
        load_r=sine * across - cosine * along - slider_force,
        load_g=load_g,
    )


class _Spread(NamedTuple):
    """What distributed axial inertia adds to the lumped one, per modal coordinate."""

    inward: Num[Array, "links Q"]  # p = (P - mu S) q, momentum along the chord [kg]
    turning: Num[Array, "links Q"]  # Q q, taken from the moment of inertia [kg m]


def _spread(plant: Plant, q: Array) -> _Spread | None:
    if plant.inward is None or plant.centrifugal is None:
        return None
    return _Spread(_times(plant.inward, q), _times(plant.centrifugal, q))


def _spread_out(
    plant: Plant, chain: Chain, spread: _Spread, link: _Link, q: Array, q_rate: Array, pull: Array
) -> _Link:
    """A link with lumped axial inertia, and what distributing it adds."""
    p, mass, rate = spread.inward, plant.modal_mass, chain.beta_rate
    b, c, own, pulled, rates, moment = (
        jnp.sum(p * x, axis=1) for x in (plant.b, plant.c, p, pull, q_rate, -q / 2)
    )
    inward = jnp.sum(_times(plant.inward, q_rate) * q_rate, axis=1)
    along = moment * (rate * rate) + inward - pulled
    load_g = link.load_g - 2 * rate * jnp.sum(spread.turning * q_rate, axis=1)
    if chain.turning is not None:
        load_g = load_g + chain.cosine * moment * chain.turning
    return _Link(
        k_rr=link.k_rr - chain.cosine * (2 * chain.sine * b + chain.cosine * own) / mass,
        k_rg=link.k_rg - chain.sine * moment + chain.cosine * c / mass,
        k_gg=link.k_gg - jnp.sum(spread.turning * q, axis=1),
        load_r=link.load_r + 2 * rate * chain.sine * rates - chain.cosine * along,
        load_g=load_g,
    )


def _rigid_link(plant: Plant, chain: Chain, swing: _Swing, slider_force: Array) -> _Link:
    """Slider and rigid link."""
    load_g = jnp.zeros_like(slider_force)
    if chain.turning is not None:
        load_g = plant.tip_mass * chain.chord * chain.cosine * chain.turning
    return _Link(
        k_rr=plant.slider_link_mass,
        k_rg=-plant.tip_mass * chain.chord * chain.sine,
        k_gg=plant.inertia,
        load_r=-plant.tip_mass * chain.cosine * swing.inward - slider_force,
        load_g=load_g,
    )


def _joint(chain: Chain, link: _Link) -> _Joint:
    """Carry a link to its joint: W = T^t K T, T = rows (rho_f, rho_g), (beta_f, beta_g)."""
    frame = chain.frame
    # momenta in rho and gamma of a unit motion of C along f, and along g
    r_f = link.k_rr * frame.rho_f + link.k_rg * frame.beta_f
    g_f = link.k_rg * frame.rho_f + link.k_gg * frame.beta_f
    r_g, g_g = link.k_rg * frame.beta_g, link.k_gg * frame.beta_g
    if frame.rho_g is not None:
        r_g, g_g = r_g + link.k_rr * frame.rho_g, g_g + link.k_rg * frame.rho_g
    ff, fg = frame.joint_force(r_f, g_f)
    gg = frame.joint_force(r_g, g_g)[1]
    return _Joint(ff, fg, gg, *frame.joint_force(link.load_r, link.load_g))


class _End(NamedTuple):
    """Interaction of the modes with the far joint of a link."""

    row: Num[Array, "links Q"]  # motion of C along f per modal coordinate, sign reversed [1]
    # C'' along f that slider and link feel: -motion[0] + motion[1] C''_f + motion[2] C''_g
    motion: tuple[Array, Array, Array]
    # reaction on row_j of every mode [N]: force[0] + force[1] C''_f + force[2] C''_g
    force: tuple[Array, Array, Array]


def _release_end(
    plant: Plant, chain: Chain, still: _Joint, q: Array, pull: Array, spread: _Spread | None
) -> tuple[_End, _Joint]:
    """Let the modes move C along f: by shortening of the chord (`chord_row`) or by row Y_j(L).

    tau = sum row_j q_j'' adds to C'' along f, and a reaction N acts on the modes, -row_j N; along
    the chord it is the axial force. With g = T^t (sum row_j beta_j, -sum row_j c_j)/m,
    beta = sin gamma b, plus cos gamma p of distributed inertia,
    B = sum row_j^2/m, mu the mass that moves in with the chord, A = W_ff - 2 mu and D = 1 - g_f:

    D tau = g.C'' - B N - sum row_j pull_j,  D N = (W_ff - mu, W_fg).C'' + A tau + load_f.
    """
    row, mu = (chord_row(plant, q), plant.tip_mass) if plant.tip is None else (plant.tip, 0.0)
    mass = plant.modal_mass[:, None]
    slid = chain.sine * jnp.sum(row * (plant.b / mass), axis=1)
    if spread is not None:
        slid = slid + chain.cosine * jnp.sum(row * (spread.inward / mass), axis=1)
    g_f, g_g = chain.frame.joint_force(slid, jnp.sum(row * (-plant.c / mass), axis=1))
    lead, stiff = 1 - g_f, still.ff - 2 * mu
    soft = jnp.sum(row * row, axis=1) / plant.modal_mass
    scale = 1 / (lead * lead + soft * stiff)
    lead, stiff, soft = lead * scale, stiff * scale, soft * scale
    pulled, fg, load = jnp.sum(row * pull, axis=1), still.fg, still.load_f
    drag = None if chain.turning is None else mu * chain.sine * chain.turning
    load = load if drag is None else load - drag
    motion = lead * pulled + soft * load, lead - mu * soft, lead * g_g - soft * fg
    force = lead * load - stiff * pulled, stiff + mu * lead, lead * fg + stiff * g_g
    joint = _Joint(
        ff=mu * motion[1] + force[1],
        fg=mu * motion[2] + force[2],
        gg=still.gg + fg * motion[2] + g_g * force[2],
        load_f=force[0] - mu * motion[0] if drag is None else force[0] - mu * motion[0] + drag,
        load_g=still.load_g - fg * motion[0] + g_g * force[0],
    )
    return _End(row, motion, force), joint


class Platform(NamedTuple):
    """Inertia of platform and payload: M_p X'' - phi'^2 moment = forces on the platform."""

    # M_p, upper triangle [kg, kg m, kg m2]; None: zero; of a point without phi
    matrix: tuple[Num[Array, ""] | None, ...]
    moment: tuple[Array, Array] | None  # mass times its centre from X [kg m]; None: centre at X


def platform_mass(plant: Plant, turn: tuple[Array, Array] | None) -> Platform:
    """M_p = (m 0 -s_y; 0 m s_x; -s_y s_x I), (s_x, s_y) the first moment turned by phi.

    Args:
        plant: the machine.
        turn: sin and cos of phi [1]; None: the platform is a point.
    """
    if turn is None:
        return Platform((plant.platform_mass, None, plant.platform_mass), None)
    mass, inertia = plant.platform_mass, plant.platform_inertia
    if plant.platform_moment is None:
        return Platform((mass, None, None, mass, None, inertia), None)
    (sine, cosine), own = turn, plant.platform_moment
    x, y = cosine * own[0] - sine * own[1], sine * own[0] + cosine * own[1]
    return Platform((mass, None, -y, mass, x, inertia), (x, y))


def _pose_acceleration(
    plant: Plant,
    chain: Chain,
    joint: _Joint,
    rates: tuple[Array, Array],
    phi2: Array | None,
    wrench: Array | None,
) -> Array:
    """Solve M_p X'' - phi'^2 moment + sum J^t (W (J X'' + rates) + load) = wrench over the links.

    J X'' = C''.
    """
    platform = platform_mass(plant, chain.turn)
    x, y, cx, cy = chain.frame.x, chain.frame.y, chain.cx, chain.cy
    # W in the axes of the plane
    f_x, g_x = x * joint.ff - y * joint.fg, x * joint.fg - y * joint.gg
    w_xx, w_xy = x * f_x - y * g_x, y * f_x + x * g_x
    w_yy = joint.ff + joint.gg - w_xx
    links: tuple[Array, ...] = (w_xx, w_xy, w_yy)
    if cx is not None and cy is not None:
        turn_x, turn_y = cx * w_xy - cy * w_xx, cx * w_yy - cy * w_xy  # phi'' with x'' and y''
        links = (w_xx, w_xy, turn_x, w_yy, turn_y, cx * turn_y - cy * turn_x)
    matrix = tuple(
        jnp.sum(part, axis=0) if own is None else own + jnp.sum(part, axis=0)
        for own, part in zip(platform.matrix, links, strict=True)
    )
    force_f = joint.ff * rates[0] + joint.fg * rates[1] + joint.load_f
    force_g = joint.fg * rates[0] + joint.gg * rates[1] + joint.load_g
    force_x, force_y = y * force_g - x * force_f, -(y * force_f + x * force_g)  # on the platform
    load: tuple[Array, ...] = (jnp.sum(force_x, axis=0), jnp.sum(force_y, axis=0))
    if cx is not None and cy is not None:
        load = (*load, jnp.sum(cx * force_y - cy * force_x, axis=0))
    if platform.moment is not None:
        outward = (phi2 * platform.moment[0], phi2 * platform.moment[1])
        load = (load[0] + outward[0], load[1] + outward[1], load[2])
    if wrench is not None:
        load = tuple(own + wrench[k] for k, own in enumerate(load))
    solve = solve_symmetric_2 if cx is None else solve_symmetric_3
    return solve(matrix, load)


def solve_symmetric_2(matrix: tuple[Array, ...], right: tuple[Array, ...]) -> Array:
    """The same as `solve_symmetric_3` of a 2x2 system (m00, m01, m11), (2,)."""
    m00, m01, m11 = matrix
    l10 = m01 / m00
    x1 = (right[1] - l10 * right[0]) / (m11 - l10 * m01)
    return jnp.stack([right[0] / m00 - l10 * x1, x1])


def solve_symmetric_3(matrix: tuple[Array, ...], right: tuple[Array, ...]) -> Array:
    """Solve a symmetric positive definite 3x3 system by L D L^t, elementwise.

    Args:
        matrix: (m00, m01, m02, m11, m12, m22).
        right: three right-hand sides.

    Returns:
        (3,) stacked on a new first axis.
    """
    m00, m01, m02, m11, m12, m22 = matrix
    l10, l20 = m01 / m00, m02 / m00
    d1 = m11 - l10 * m01
    e12 = m12 - l20 * m01
    l21 = e12 / d1
    d2 = m22 - l20 * m02 - l21 * e12
    y1 = right[1] - l10 * right[0]
    y2 = right[2] - l20 * right[0] - l21 * y1
    x2 = y2 / d2
    x1 = y1 / d1 - l21 * x2
    return jnp.stack([right[0] / m00 - l10 * x1 - l20 * x2, x1, x2])


def mass_matrix(platform: Platform) -> Array:
    """M_p as a matrix [kg, kg m, kg m2], (3, 3) or (2, 2)."""
    real = jnp.result_type(float)
    m = [jnp.asarray(0.0 if entry is None else entry, real) for entry in platform.matrix]
    rows = ((0, 1), (1, 2)) if len(m) == 3 else ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    return jnp.stack([jnp.stack([m[j] for j in row]) for row in rows])


def straight_motion(chain: Chain, pose_rate: Array, pose_acc: Array) -> tuple[Array, Array]:
    """rho'' [m/s2] and gamma'' [rad/s2] of straight links in a prescribed motion, (3,) each.

    Args:
        chain: closure of straight links.
        pose_rate: (3,).
        pose_acc: (3,).
    """
    frame = chain.frame
    acc_f, acc_g = frame.joint_motion(pose_acc)
    acc_f = acc_f + chain.chord * chain.beta_rate**2
    if frame.c_f is not None and frame.c_g is not None:
        phi2 = pose_rate[2] ** 2
        acc_f, acc_g = acc_f - phi2 * frame.c_f, acc_g - phi2 * frame.c_g
    if chain.turning is not None:
        acc_f, acc_g = acc_f - chain.sine * chain.turning, acc_g - chain.cosine * chain.turning
    return frame.link_motion(acc_f, acc_g)


def with_platform(plant: Plant, factor: Array) -> Plant:
    """The machine with mass, inertia and moment of platform and payload times a factor [1]."""
    moment = plant.platform_moment
    return plant._replace(
        platform_mass=factor * plant.platform_mass,
        platform_inertia=factor * plant.platform_inertia,
        platform_moment=None if moment is None else factor * moment,
    )


def inverse_dynamics(
    plant: Plant, pose: Array, pose_rate: Array, pose_acc: Array, wrench: Array | None = None
) -> Array:
    """Drive forces [N] for a desired pose acceleration of the unbent machine (computed torque).

    M_p X'' + sum J^t T^t (K (rho'', gamma'') + load) = wrench + sum J^t T^t (F, 0) over the links.

    Args:
        plant: the machine.
        pose: (3,) [m, m, rad].
        pose_rate: (3,).
        pose_acc: (3,).
        wrench: force and moment on the platform [N, N, N m], (3,), or None.

    Returns:
        (3,).
    """
    chain = close_chain(plant, pose, pose_rate)
    frame, rate2 = chain.frame, chain.beta_rate**2
    rho_acc, beta_acc = straight_motion(chain, pose_rate, pose_acc)
    moment = plant.tip_mass * plant.length
    on_rho = plant.slider_link_mass * rho_acc - moment * (
        chain.sine * beta_acc + chain.cosine * rate2
    )
    on_beta = plant.inertia * beta_acc - moment * chain.sine * rho_acc
    if chain.turning is not None:
        on_beta = on_beta + moment * chain.cosine * chain.turning
    force_f, force_g = frame.joint_force(on_rho, on_beta)
    to_f, to_g = jnp.stack([frame.x, frame.y]), jnp.stack([-frame.y, frame.x])
    if frame.c_f is not None and frame.c_g is not None:
        to_f, to_g = jnp.stack([*to_f, -frame.c_g]), jnp.stack([*to_g, frame.c_f])
    platform = platform_mass(plant, chain.turn)
    load = jnp.sum(to_f * force_f + to_g * force_g, axis=1) + mass_matrix(platform) @ pose_acc
    if platform.moment is not None:
        phi2 = pose_rate[2] ** 2
        load = load - phi2 * jnp.stack([*platform.moment, jnp.zeros_like(phi2)])
    load = load if wrench is None else load - wrench
    return jnp.linalg.solve(frame.rho_f * to_f, load)


def kinetic_energy(
    plant: Plant,
    chain: Chain,
    pose_rate: Num[Array, "pose"],
    q: Num[Array, "links Q"],
    q_rate: Num[Array, "links Q"],
) -> Num[Array, ""]:
    """Kinetic energy (1) [J] in closed form, docs/theory.md.

    Args:
        plant: the machine.
        chain: closure at this state.
        pose_rate: [m/s, m/s, rad/s].
        q: [m].
        q_rate: [m/s].

    Example:
        >>> plant = prepare(*paper_case({"link.modes": 2})).loop.plant
        >>> rate, q = jnp.array([0.1, 0.0, 0.0]), jnp.zeros((3, 3))
        >>> chain = close_chain(plant, jnp.array(HOME), rate)
        >>> f"{kinetic_energy(plant, chain, rate, q, q):.2e} J"
        '5.97e-03 J'
    """
    bq, bq_rate = jnp.sum(plant.b * q, axis=1), jnp.sum(plant.b * q_rate, axis=1)
    swing = plant.tip_mass * chain.chord * chain.sine + chain.cosine * bq
    push = chain.sine * bq_rate
    if chain.bend.shortening_rate is not None:
        push = push + plant.tip_mass * chain.cosine * chain.bend.shortening_rate
    rotary = plant.inertia + plant.modal_mass * jnp.sum(q * q, axis=1)
    spread = _spread(plant, q)
    if spread is not None:
        swing = swing - chain.sine * jnp.sum(spread.inward * q, axis=1) / 2
        push = push + chain.cosine * jnp.sum(spread.inward * q_rate, axis=1)
        rotary = rotary - jnp.sum(spread.turning * q, axis=1)
    links = (
        plant.slider_link_mass * chain.rho_rate**2 / 2
        + rotary * chain.beta_rate**2 / 2
        + plant.modal_mass * jnp.sum(q_rate**2, axis=1) / 2
        + chain.beta_rate * jnp.sum(plant.c * q_rate, axis=1)
        - chain.rho_rate * chain.beta_rate * swing
        - chain.rho_rate * push
    )
    platform = plant.platform_mass * (pose_rate[0] ** 2 + pose_rate[1] ** 2) / 2
    if chain.turn is not None:
        platform = platform + plant.platform_inertia * pose_rate[2] ** 2 / 2
    moment = platform_mass(plant, chain.turn).moment
    if moment is not None:
        across = moment[0] * pose_rate[1] - moment[1] * pose_rate[0]
        platform = platform + across * pose_rate[2]
    return jnp.sum(links, axis=0) + platform


def potential_energy(plant: Plant, q: Num[Array, "links Q"]) -> Num[Array, ""]:
    """Bending energy (2) [J]: sum k_j q_j^2/2.

    Example:
        >>> plant = prepare(*paper_case({"link.modes": 2})).loop.plant
        >>> f"{potential_energy(plant, 1e-5 * jnp.eye(3)):.2e} J"
        '5.69e-04 J'
    """
    return jnp.sum(plant.stiffness * q * q) / 2
