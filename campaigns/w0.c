/* Work W0 written by hand: the yardstick of `studies bench peers`.

   Pinned-pinned links whose chords shorten (w = 0), PD drive, voltages from modal velocities, RK4 with the vibration in
   the same step; WIDTH cases side by side in the vectors of gcc and clang. One call runs WIDTH cases. */

typedef double vec __attribute__((vector_size(8 * WIDTH)));
typedef long long mask __attribute__((vector_size(8 * WIDTH)));

enum { LINKS = 3, MODES = 3, PATCHES = 3, STATIONS = 3 };

struct machine {
  double ux[LINKS], uy[LINKS], joint_cos[LINKS], joint_sin[LINKS], s0[LINKS], h0[LINKS];
  double length[LINKS], slider_link_mass[LINKS], tip_mass[LINKS], inertia[LINKS];
  double platform_mass, platform_inertia;
  double modal_mass[LINKS], stiffness[LINKS][MODES], damping[LINKS][MODES];
  double b[LINKS][MODES], c[LINKS][MODES], shortening[LINKS][MODES];
  double actuator[LINKS][MODES][PATCHES]; /* acceleration of a voltage [m/s2/V] */
  double deflection_at[LINKS][STATIONS][MODES];
  double kp[LINKS], kd[LINKS], force_limit[LINKS], voltage_limit;
};

struct state {
  vec x[3], v[3], q[LINKS][MODES], p[LINKS][MODES];
};

static vec all(double x) { return x - (vec){0}; }

static vec root(vec x) {
  for (int k = 0; k < WIDTH; k++) x[k] = __builtin_sqrt(x[k]);
  return x;
}

static vec chosen(mask which, vec yes, vec no) { return (vec)(((mask)yes & which) | ((mask)no & ~which)); }

static vec limited(vec x, double bound) {
  vec high = all(bound), low = all(-bound);
  x = chosen(x > high, high, x);
  return chosen(x < low, low, x);
}

/* sine and cosine of a small angle plus that of a fixed one, to 2e-16 within 0.5 rad */
static void turn(vec angle, double home_sin, double home_cos, vec *sine, vec *cosine) {
  vec z = angle * angle;
  vec s = angle * (1 + z * (-1. / 6 + z * (1. / 120 + z * (-1. / 5040 + z * (1. / 362880 +
         z * (-1. / 39916800 + z * (1. / 6227020800.)))))));
  vec c = 1 + z * (-1. / 2 + z * (1. / 24 + z * (-1. / 720 + z * (1. / 40320 +
         z * (-1. / 3628800 + z * (1. / 479001600. - z * (1. / 87178291200.)))))));
  *sine = s * home_cos + c * home_sin;
  *cosine = c * home_cos - s * home_sin;
}

static void rates(const struct machine *m, const double *wanted, const vec *gain,
                  const struct state *at, const double *home, struct state *out) {
  vec sine, cosine, A[3][3] = {{{0}}}, g[3] = {{0}};
  vec force[LINKS][MODES], row[LINKS][MODES], S[LINKS];
  vec Jf[LINKS][3], Jg[LINKS][3]; /* motion of joint C along the chord and across it */
  vec to_rho[LINKS], to_gamma[LINKS], turn_gamma[LINKS], vf[LINKS], vg[LINKS];
  vec tau[LINKS][3], N[LINKS][3];
  turn(at->x[2] - home[0], home[1], home[2], &sine, &cosine);
  for (int i = 0; i < LINKS; i++) {
    double ux = m->ux[i], uy = m->uy[i], mass = m->modal_mass[i], mu = m->tip_mass[i];
    vec cx = m->joint_cos[i] * cosine - m->joint_sin[i] * sine;
    vec cy = m->joint_cos[i] * sine + m->joint_sin[i] * cosine;
    vec X = at->x[0] + cx, Y = at->x[1] + cy;
    vec s = ux * X + uy * Y + m->s0[i], h = ux * Y - uy * X + m->h0[i];
    vec volt[PATCHES];
    for (int k = 0; k < PATCHES; k++) {
      vec sum = {0};
      for (int j = 0; j < MODES; j++) sum += gain[(i * PATCHES + k) * MODES + j] * at->p[i][j];
      volt[k] = limited(sum, m->voltage_limit);
    }
    vec d = {0}, d_rate = {0}, e2 = {0};
    for (int j = 0; j < MODES; j++) {
      vec q = at->q[i][j], p = at->p[i][j], r = m->shortening[i][j] * q;
      row[i][j] = r;
      d += r * q, d_rate += r * p, e2 += m->shortening[i][j] * p * p;
    }
    vec c = m->length[i] - 0.5 * d, P = root(c * c - h * h), product = 1.0 / (c * P);
    vec over = P * product, inverse = c * product, C = P * over;
    S[i] = h * over;
    vec fx = ux * C - uy * S[i], fy = uy * C + ux * S[i];
    vec cf = fx * cx + fy * cy, cg = fx * cy - fy * cx;
    Jf[i][0] = fx, Jf[i][1] = fy, Jf[i][2] = -cg, Jg[i][0] = -fy, Jg[i][1] = fx, Jg[i][2] = cf;
    to_rho[i] = c * inverse, to_gamma[i] = S[i] * inverse, turn_gamma[i] = over;
    vec along = d_rate, across = {0};
    for (int r = 0; r < 3; r++) along += Jf[i][r] * at->v[r], across += Jg[i][r] * at->v[r];
    vec rho_rate = to_rho[i] * along, rate = to_gamma[i] * along + over * across;
    vec rate2 = rate * rate, f2 = at->v[2] * at->v[2];
    vec inward = c * rate2 + e2, slip = 2 * rate * d_rate;
    vf[i] = inward - f2 * cf, vg[i] = slip - f2 * cg;
    vec motor = m->kp[i] * (wanted[i] - (s - P)) + m->kd[i] * (wanted[LINKS + i] - rho_rate);
    vec F = limited(motor, m->force_limit[i]);
    vec bb = {0}, bc = {0}, cc = {0}, fb = {0}, fc = {0}, fr = {0}, rb = {0}, rc = {0}, rr = {0};
    vec Bq = {0}, Bp = {0}, qq = {0}, qp = {0};
    for (int j = 0; j < MODES; j++) {
      double bj = m->b[i][j], cj = m->c[i][j];
      vec q = at->q[i][j], p = at->p[i][j], r = row[i][j], piezo = {0};
      for (int k = 0; k < PATCHES; k++) piezo += m->actuator[i][j][k] * volt[k];
      vec f = (m->stiffness[i][j] / mass - rate2) * q + m->damping[i][j] / mass * p - piezo;
      force[i][j] = f;
      bb += all(bj * bj / mass), bc += all(bj * cj / mass), cc += all(cj * cj / mass);
      fb += bj * f, fc += cj * f, fr += r * f;
      rb += bj / mass * r, rc += cj / mass * r, rr += r * r;
      Bq += bj * q, Bp += bj * p, qq += q * q, qp += q * p;
    }
    vec Mrr = m->slider_link_mass[i] - bb * S[i] * S[i];
    vec Mrg = S[i] * (bc - mu * c) - C * Bq, Mgg = m->inertia[i] - cc + mass * qq;
    vec er = S[i] * (fb + Bq * rate2 + mu * slip) - C * (mu * inward + 2 * rate * Bp) - F;
    vec eg = 2 * rate * mass * qp - fc;
    /* carried to the joint: W = T' M T */
    vec pr = Mrr * to_rho[i] + Mrg * to_gamma[i], pg = Mrg * to_rho[i] + Mgg * to_gamma[i];
    vec Wff = to_rho[i] * pr + to_gamma[i] * pg, Wfg = over * pg, Wgg = Mgg * over * over;
    vec lf = to_rho[i] * er + to_gamma[i] * eg, lg = over * eg;
    /* the modes shorten the chord */
    vec gf = to_rho[i] * S[i] * rb - to_gamma[i] * rc, gg = -over * rc;
    vec D = 1 - gf, K = Wff - 2 * mu, B = rr * (1 / mass), scale = 1.0 / (D * D + B * K);
    D *= scale, K *= scale, B *= scale;
    tau[i][0] = D * fr + B * lf, tau[i][1] = D - mu * B, tau[i][2] = D * gg - B * Wfg;
    N[i][0] = D * lf - K * fr, N[i][1] = K + mu * D, N[i][2] = D * Wfg + K * gg;
    vec ff = mu * tau[i][1] + N[i][1], fg = mu * tau[i][2] + N[i][2];
    vec last = Wgg + Wfg * tau[i][2] + gg * N[i][2];
    vec yf = N[i][0] - mu * tau[i][0] + ff * vf[i] + fg * vg[i];
    vec yg = lg - Wfg * tau[i][0] + gg * N[i][0] + fg * vf[i] + last * vg[i];
    for (int r = 0; r < 3; r++) {
      vec u = ff * Jf[i][r] + fg * Jg[i][r], w = fg * Jf[i][r] + last * Jg[i][r];
      g[r] += Jf[i][r] * yf + Jg[i][r] * yg;
      for (int k = 0; k <= r; k++) A[r][k] += u * Jf[i][k] + w * Jg[i][k];
    }
  }
  A[0][0] += m->platform_mass, A[1][1] += m->platform_mass, A[2][2] += m->platform_inertia;
  /* symmetric 3x3 by its adjugate */
  vec c00 = A[1][1] * A[2][2] - A[2][1] * A[2][1], c10 = A[2][0] * A[2][1] - A[1][0] * A[2][2];
  vec c20 = A[1][0] * A[2][1] - A[2][0] * A[1][1], c11 = A[0][0] * A[2][2] - A[2][0] * A[2][0];
  vec c21 = A[1][0] * A[2][0] - A[0][0] * A[2][1], c22 = A[0][0] * A[1][1] - A[1][0] * A[1][0];
  vec over = -1.0 / (A[0][0] * c00 + A[1][0] * c10 + A[2][0] * c20), U[3];
  U[0] = over * (c00 * g[0] + c10 * g[1] + c20 * g[2]);
  U[1] = over * (c10 * g[0] + c11 * g[1] + c21 * g[2]);
  U[2] = over * (c20 * g[0] + c21 * g[1] + c22 * g[2]);
  for (int r = 0; r < 3; r++) out->x[r] = at->v[r], out->v[r] = U[r];
  for (int i = 0; i < LINKS; i++) {
    vec f = vf[i], gc = vg[i];
    for (int r = 0; r < 3; r++) f += Jf[i][r] * U[r], gc += Jg[i][r] * U[r];
    vec pull = N[i][0] + N[i][1] * f + N[i][2] * gc;
    vec felt = tau[i][1] * f + tau[i][2] * gc - tau[i][0];
    vec rho = to_rho[i] * felt, gamma = to_gamma[i] * felt + turn_gamma[i] * gc;
    double mass = m->modal_mass[i];
    for (int j = 0; j < MODES; j++) {
      out->q[i][j] = at->p[i][j];
      out->p[i][j] = m->b[i][j] / mass * S[i] * rho - m->c[i][j] / mass * gamma
                     - row[i][j] * (1 / mass) * pull - force[i][j];
    }
  }
}

enum { NUMBERS = sizeof(struct state) / sizeof(vec) };

static struct state along(const struct state *from, const struct state *slope, double length) {
  struct state sum;
  const vec *x = (const vec *)from, *dx = (const vec *)slope;
  for (int k = 0; k < NUMBERS; k++) ((vec *)&sum)[k] = x[k] + length * dx[k];
  return sum;
}

/* wanted: rho and rho' of start, middle and end of every step, (n, 3, 2, 3); weight: residual
   window, (n); home: start pose (3) and phi, sin, cos; gain: V s/m, (27, WIDTH); square: sum of
   squared deflections, (9, WIDTH). */
void run(const struct machine *m, long n, double step, const double *wanted, const double *weight,
         const double *home, const vec *gain, vec *square) {
  struct state x = {0}, k1, k2, k3, k4, at;
  for (int r = 0; r < 3; r++) x.x[r] = all(home[r]);
  for (long s = 0; s < n; s++, wanted += 18) {
    if (weight[s] > 0)
      for (int k = 0; k < LINKS * STATIONS; k++) {
        vec y = {0};
        for (int j = 0; j < MODES; j++)
          y += m->deflection_at[k / STATIONS][k % STATIONS][j] * x.q[k / STATIONS][j];
        square[k] += weight[s] * y * y;
      }
    rates(m, wanted, gain, &x, home + 3, &k1);
    at = along(&x, &k1, step / 2);
    rates(m, wanted + 6, gain, &at, home + 3, &k2);
    at = along(&x, &k2, step / 2);
    rates(m, wanted + 6, gain, &at, home + 3, &k3);
    at = along(&x, &k3, step);
    rates(m, wanted + 12, gain, &at, home + 3, &k4);
    const vec *a = (vec *)&k1, *b = (vec *)&k2, *c = (vec *)&k3, *d = (vec *)&k4;
    for (int k = 0; k < NUMBERS; k++)
      ((vec *)&x)[k] += step / 6 * (a[k] + 2 * (b[k] + c[k]) + d[k]);
  }
}
