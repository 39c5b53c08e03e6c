/* Work W0 written by hand: the yardstick of `studies bench peers`.

   Pinned-pinned links (w = 0), PD drive, voltages from modal velocities, RK4 with the vibration in
   the same step; 8 cases side by side in the vectors of gcc and clang. One call runs 8 cases. */

typedef double v8 __attribute__((vector_size(64)));
typedef long long m8 __attribute__((vector_size(64)));

enum { LINKS = 3, MODES = 3, PATCHES = 3, STATIONS = 3 };

struct machine {
  double ux[LINKS], uy[LINKS], joint_cos[LINKS], joint_sin[LINKS], s0[LINKS], h0[LINKS];
  double length[LINKS], slider_link_mass[LINKS], first_moment[LINKS], inertia[LINKS];
  double platform_mass, platform_inertia;
  double mass[LINKS][MODES], stiffness[LINKS][MODES], damping[LINKS][MODES];
  double b[LINKS][MODES], c[LINKS][MODES];
  double actuator[LINKS][MODES][PATCHES]; /* acceleration of a voltage [m/s2/V] */
  double deflection_at[LINKS][STATIONS][MODES];
  double kp[LINKS], kd[LINKS], force_limit[LINKS], voltage_limit;
};

struct state {
  v8 x[3], v[3], q[LINKS][MODES], p[LINKS][MODES];
};

static v8 all(double x) { return (v8){x, x, x, x, x, x, x, x}; }

static v8 root(v8 x) {
  for (int k = 0; k < 8; k++) x[k] = __builtin_sqrt(x[k]);
  return x;
}

static v8 chosen(m8 which, v8 yes, v8 no) { return (v8)(((m8)yes & which) | ((m8)no & ~which)); }

static v8 limited(v8 x, double bound) {
  v8 high = all(bound), low = all(-bound);
  x = chosen(x > high, high, x);
  return chosen(x < low, low, x);
}

/* sine and cosine of a small angle plus that of a fixed one, to 2e-16 within 0.5 rad */
static void turn(v8 angle, double home_sin, double home_cos, v8 *sine, v8 *cosine) {
  v8 z = angle * angle;
  v8 s = angle * (1 + z * (-1. / 6 + z * (1. / 120 + z * (-1. / 5040 + z * (1. / 362880 +
         z * (-1. / 39916800 + z * (1. / 6227020800.)))))));
  v8 c = 1 + z * (-1. / 2 + z * (1. / 24 + z * (-1. / 720 + z * (1. / 40320 +
         z * (-1. / 3628800 + z * (1. / 479001600. - z * (1. / 87178291200.)))))));
  *sine = s * home_cos + c * home_sin;
  *cosine = c * home_cos - s * home_sin;
}

static void rates(const struct machine *m, const double *wanted, const v8 *gain,
                  const struct state *at, const double *home, struct state *out) {
  v8 sine, cosine, A[3][3] = {{{0}}}, g[3] = {{0}};
  v8 a[LINKS][3], d[LINKS][3], t[LINKS], S[LINKS], C[LINKS], inverse[LINKS], rs[LINKS], gs[LINKS];
  v8 force[LINKS][MODES];
  turn(at->x[2] - home[0], home[1], home[2], &sine, &cosine);
  for (int i = 0; i < LINKS; i++) {
    v8 cu = m->joint_cos[i] * cosine - m->joint_sin[i] * sine;
    v8 cn = m->joint_cos[i] * sine + m->joint_sin[i] * cosine;
    v8 s = m->ux[i] * at->x[0] + m->uy[i] * at->x[1] + cu + m->s0[i];
    v8 h = -m->uy[i] * at->x[0] + m->ux[i] * at->x[1] + cn + m->h0[i];
    double L = m->length[i];
    v8 P = root(L * L - h * h), over = 1.0 / P;
    a[i][0] = all(m->ux[i]), a[i][1] = all(m->uy[i]), a[i][2] = -cn;
    d[i][0] = all(-m->uy[i]), d[i][1] = all(m->ux[i]), d[i][2] = cu;
    v8 s_rate = m->ux[i] * at->v[0] + m->uy[i] * at->v[1] - cn * at->v[2];
    v8 h_rate = -m->uy[i] * at->v[0] + m->ux[i] * at->v[1] + cu * at->v[2];
    v8 gr = h_rate * over, g2 = gr * gr, f2 = at->v[2] * at->v[2];
    S[i] = h * (1 / L), C[i] = P * (1 / L), t[i] = h * over, inverse[i] = over;
    gs[i] = (h * g2 - cn * f2) * over;
    rs[i] = h * gs[i] + P * g2 - cu * f2;
    v8 motor = m->kp[i] * (wanted[i] - (s - P)) + m->kd[i] * (wanted[LINKS + i] - (s_rate + h * gr));
    v8 F = limited(motor, m->force_limit[i]);
    v8 volt[PATCHES];
    for (int k = 0; k < PATCHES; k++) {
      v8 sum = {0};
      for (int j = 0; j < MODES; j++) sum += gain[(i * PATCHES + k) * MODES + j] * at->p[i][j];
      volt[k] = limited(sum, m->voltage_limit);
    }
    v8 bb = {0}, bc = {0}, cc = {0}, fb = {0}, fc = {0}, Bq = {0}, Bp = {0}, mqq = {0}, mqp = {0};
    for (int j = 0; j < MODES; j++) {
      double mass = m->mass[i][j], b = m->b[i][j], c = m->c[i][j];
      v8 q = at->q[i][j], p = at->p[i][j], piezo = {0};
      for (int k = 0; k < PATCHES; k++) piezo += m->actuator[i][j][k] * volt[k];
      v8 f = (m->stiffness[i][j] / mass - g2) * q + m->damping[i][j] / mass * p - piezo;
      force[i][j] = f;
      bb += b * b / mass, bc += b * c / mass, cc += c * c / mass;
      fb += b * f, fc += c * f, Bq += b * q, Bp += b * p;
      mqq += mass * q * q, mqp += mass * q * p;
    }
    double e = m->first_moment[i];
    v8 Mrr = m->slider_link_mass[i] - bb * S[i] * S[i];
    v8 Mrg = S[i] * (bc - e) - C[i] * Bq, Mgg = m->inertia[i] - cc + mqq;
    v8 er = Mrr * rs[i] + Mrg * gs[i] + (S[i] * Bq - e * C[i]) * g2 - 2 * C[i] * gr * Bp - F
            + S[i] * fb;
    v8 eg = Mrg * rs[i] + Mgg * gs[i] + 2 * gr * mqp - fc;
    v8 w = Mrr * t[i] + Mrg * over;
    v8 z = t[i] * (w + Mrg * over) + Mgg * over * over, y = t[i] * er + eg * over;
    for (int r = 0; r < 3; r++) {
      g[r] += a[i][r] * er + d[i][r] * y;
      for (int k = 0; k <= r; k++)
        A[r][k] += Mrr * a[i][r] * a[i][k] + w * (a[i][r] * d[i][k] + d[i][r] * a[i][k])
                   + z * d[i][r] * d[i][k];
    }
  }
  A[0][0] += m->platform_mass, A[1][1] += m->platform_mass, A[2][2] += m->platform_inertia;
  /* symmetric 3x3 by its adjugate */
  v8 c00 = A[1][1] * A[2][2] - A[2][1] * A[2][1], c10 = A[2][0] * A[2][1] - A[1][0] * A[2][2];
  v8 c20 = A[1][0] * A[2][1] - A[2][0] * A[1][1], c11 = A[0][0] * A[2][2] - A[2][0] * A[2][0];
  v8 c21 = A[1][0] * A[2][0] - A[0][0] * A[2][1], c22 = A[0][0] * A[1][1] - A[1][0] * A[1][0];
  v8 over = -1.0 / (A[0][0] * c00 + A[1][0] * c10 + A[2][0] * c20), U[3];
  U[0] = over * (c00 * g[0] + c10 * g[1] + c20 * g[2]);
  U[1] = over * (c10 * g[0] + c11 * g[1] + c21 * g[2]);
  U[2] = over * (c20 * g[0] + c21 * g[1] + c22 * g[2]);
  for (int r = 0; r < 3; r++) out->x[r] = at->v[r], out->v[r] = U[r];
  for (int i = 0; i < LINKS; i++) {
    v8 aU = a[i][0] * U[0] + a[i][1] * U[1] + a[i][2] * U[2];
    v8 dU = d[i][0] * U[0] + d[i][1] * U[1] + d[i][2] * U[2];
    v8 rho = aU + t[i] * dU + rs[i], gamma = dU * inverse[i] + gs[i];
    for (int j = 0; j < MODES; j++) {
      double mass = m->mass[i][j];
      out->q[i][j] = at->p[i][j];
      out->p[i][j] = m->b[i][j] / mass * S[i] * rho - m->c[i][j] / mass * gamma - force[i][j];
    }
  }
}

enum { NUMBERS = sizeof(struct state) / sizeof(v8) };

static struct state along(const struct state *from, const struct state *slope, double length) {
  struct state sum;
  const v8 *x = (const v8 *)from, *dx = (const v8 *)slope;
  for (int k = 0; k < NUMBERS; k++) ((v8 *)&sum)[k] = x[k] + length * dx[k];
  return sum;
}

/* wanted: rho and rho' of start, middle and end of every step, (n, 3, 2, 3); weight: residual
   window, (n); home: start pose (3) and phi, sin, cos; gain: V s/m, (27, 8); square: sum of squared
   deflections, (9, 8). */
void run(const struct machine *m, long n, double step, const double *wanted, const double *weight,
         const double *home, const v8 *gain, v8 *square) {
  struct state x = {0}, k1, k2, k3, k4, at;
  for (int r = 0; r < 3; r++) x.x[r] = all(home[r]);
  for (long s = 0; s < n; s++, wanted += 18) {
    if (weight[s] > 0)
      for (int k = 0; k < LINKS * STATIONS; k++) {
        v8 y = {0};
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
    const v8 *a = (v8 *)&k1, *b = (v8 *)&k2, *c = (v8 *)&k3, *d = (v8 *)&k4;
    for (int k = 0; k < NUMBERS; k++)
      ((v8 *)&x)[k] += step / 6 * (a[k] + 2 * (b[k] + c[k]) + d[k]);
  }
}
