/* Search, sample by sample, for the sensor signals that drive exported code farthest.
 *
 * Every candidate is one step of a copy of the state; the best few copies go on. What is driven: a
 * word of the state up or down, the difference of two, or an output up or down. Every step is held
 * against what the header promises. Each search ends with sensors at rest, and with a sensor fault.
 *
 * Arguments: samples, seed, samples of a search, file for the sequences found: of each, from its last
 * sample to its first, codes and actuators in double. Compile as exported.h says, with
 * -DCOUNT=<type of a word of the state> and -DBACK=<how far an actuator may end from where a fresh
 * controller ends>.
 */
#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "exported.h"

#ifdef FLEXLINK_N_STATES
#define WORDS FLEXLINK_N_STATES
#define WORDS_AT offsetof(flexlink_state, x)
#else
#define WORDS (3 * FLEXLINK_N_MODES)
#define WORDS_AT offsetof(flexlink_state, high)
#endif
#define BEAM 3
#define LONGEST 1000
#define GOALS (3 * WORDS + 2 * N)

typedef COUNT word;

/* A controller on the way, and what its fault must be by the header. */
typedef struct {
    flexlink_state state;
    int32_t code[N];
    wire out[N];
    int run[N]; /* samples at the upper end, or minus those at the lower one */
    int fault;
    int parent;
    double score;
} node;

static long samples; /* so far */
static double largest[WORDS];
static node beam[BEAM], fresh;
static int32_t codes[LONGEST][BEAM][N];
static wire outs[LONGEST][BEAM][N];
static int parents[LONGEST][BEAM];

static void fail(const char *what, int at)
{
    printf("%s %d at sample %ld\n", what, at, samples);
    exit(1);
}

static void words_of(const node *at, word value[WORDS])
{
    memcpy(value, (const char *)&at->state + WORDS_AT, WORDS * sizeof(word));
}

/* --- sensors ---------------------------------------------------------------------------------- */

#ifdef FIXED
static int can_be_bad(void)
{
    return TOP < 65535;
}

static wire bad(void)
{
    return (wire)(TOP + 1 + below(65535 - TOP));
}
#else
static int can_be_bad(void)
{
    return 1;
}

static wire bad(void)
{
    const wire range = (wire)((TOP + 2) * FLEXLINK_ADC_STEP);
    const wire values[] = {(wire)NAN, (wire)-NAN, (wire)INFINITY, (wire)-INFINITY, range, -range,
        (wire)(-2 * FLEXLINK_ADC_STEP), (wire)3e38, (wire)-3e38};

    return values[below((int)(sizeof values / sizeof *values))];
}
#endif

/* --- one step, held against the header -------------------------------------------------------- */

static void begin(node *at)
{
    int k;

    memset(at, 0, sizeof *at);
    memset(&at->state, 0xA5, sizeof at->state);
    flexlink_init(&at->state);
    for (k = 0; k < N; k++) {
        at->code[k] = REST;
    }
}

/* What the fault must be after these codes; `broken`: a channel with a bad value, or none, -1. */
static int expected(node *at, int broken)
{
    int k;

    for (k = 0; k < N && !at->fault; k++) {
        const int end = at->code[k] == TOP ? 1 : at->code[k] == 0 ? -1 : 0;

        at->run[k] = end * at->run[k] > 0 ? at->run[k] + end : end;
        if (IS_USED(k) && (k == broken || abs(at->run[k]) >= FLEXLINK_RAIL_SAMPLES)) {
            at->fault = k + 1;
        }
    }
    return at->fault;
}

static void check_words(const node *at)
{
    word value[WORDS];
    int i;

    words_of(at, value);
    for (i = 0; i < WORDS; i++) {
        const double size = fabs((double)value[i]);

        if (at->fault && value[i] != 0) {
            fail("fault, but there is a rest in word", i);
        }
#ifdef FIXED
        if (size >= (double)((UINT64_C(1) << (8 * sizeof(word) - 1)) - 1)) {
            fail("overflow of word", i);
        }
#endif
        if (!(size < 1e30)) {
            fail("not finite: word", i);
        }
        largest[i] = size > largest[i] ? size : largest[i];
    }
}

static void check_outputs(const node *at)
{
    int k;

    for (k = 0; k < N; k++) {
        if (!is_inside(at->out[k])) {
            fail("beyond the limits: actuator", k);
        }
        if ((at->fault || !IS_USED(k)) && at->out[k] != AT_REST) {
            fail("not at rest: actuator", k);
        }
    }
}

/* One sample of the node's codes, with a bad value at a channel or none. */
static void step(node *at, int broken)
{
    wire in[N];
    int k, fault;

    for (k = 0; k < N; k++) {
        in[k] = k == broken ? bad() : of_code(at->code[k]);
        at->out[k] = (wire)1;
    }
    fault = flexlink_step(&at->state, in, at->out);
    samples++;
    if (fault != expected(at, broken) || at->state.fault != fault) {
        fail("another fault than expected:", fault);
    }
    check_words(at);
    check_outputs(at);
}

/* --- the search ------------------------------------------------------------------------------- */

static double score_of(const node *at, int goal)
{
    word value[WORDS];
    double a, b;

    if (at->fault) {
        return -INFINITY;
    }
    if (goal >= 3 * WORDS) {
        goal -= 3 * WORDS;
        return (goal % 2 ? -1 : 1) * (double)at->out[goal / 2];
    }
    words_of(at, value);
    a = (double)value[goal / 3];
    b = (double)value[(goal / 3 + 1) % WORDS];
    switch (goal % 3) {
    case 0: return a;
    case 1: return -a;
    default: return (a - b) * (a - b) + 1e-2 * (a * a + b * b);
    }
}

/* Keep a candidate if it is among the best. */
static void keep(node next[BEAM], const node *candidate)
{
    int i = BEAM;

    while (i > 0 && candidate->score > next[i - 1].score) {
        i--;
        if (i + 1 < BEAM) {
            next[i + 1] = next[i];
        }
    }
    if (i < BEAM) {
        next[i] = *candidate;
    }
}

static double try_codes(const node *from, const int32_t code[N], int goal, node next[BEAM])
{
    node candidate = *from;

    memcpy(candidate.code, code, sizeof candidate.code);
    step(&candidate, -1);
    candidate.score = score_of(&candidate, goal);
    keep(next, &candidate);
    return candidate.score;
}

/* All candidates that follow a node: as before, turned, at rest, at random, at the ends in step with
 * a frequency, and from the last codes channel by channel to the end that is better. */
static void extend(const node *from, int goal, int time, int low, int high, node next[BEAM])
{
    const double rate = 0.02 + 0.001 * (goal * 37 % 500);
    int32_t code[N];
    double best;
    int kind, k;

    for (kind = 0; kind < 6; kind++) {
        const int end = sin(rate * time) > 0 ? high : low;

        for (k = 0; k < N; k++) {
            switch (kind) {
            case 0: code[k] = from->code[k]; break;
            case 1: code[k] = low + high - from->code[k]; break;
            case 2: code[k] = REST; break;
            case 3: code[k] = below(TOP + 1); break;
            case 4: code[k] = below(2) ? low : high; break;
            default: code[k] = k % 2 ? end : low + high - end;
            }
        }
        (void)try_codes(from, code, goal, next);
    }
    memcpy(code, from->code, sizeof code);
    best = -INFINITY;
    for (k = 0; k < N; k++) {
        int32_t old = code[k];

        if (!IS_USED(k)) {
            continue;
        }
        for (kind = 0; kind < 2; kind++) {
            double score;

            code[k] = kind ? high : low;
            score = try_codes(from, code, goal, next);
            if (score > best) {
                best = score;
                old = code[k];
            }
        }
        code[k] = old;
    }
}

/* Drive a goal from rest; the best sequence goes to the file. */
static void search(int goal, int length, FILE *file)
{
    const int is_mild = below(2); /* one code off the ends, where no sensor counts as stuck */
    const int low = is_mild, high = TOP - is_mild;
    node next[BEAM];
    int time, i, k, alive = 1;

    begin(&beam[0]);
    for (time = 0; time < length; time++) {
        for (i = 0; i < BEAM; i++) {
            next[i].score = -INFINITY;
        }
        for (i = 0; i < alive; i++) {
            beam[i].parent = i;
            extend(&beam[i], goal, time, low, high, next);
        }
        for (alive = 0; alive < BEAM && next[alive].score > -INFINITY; alive++) {
            beam[alive] = next[alive];
            memcpy(codes[time][alive], next[alive].code, sizeof codes[0][0]);
            memcpy(outs[time][alive], next[alive].out, sizeof outs[0][0]);
            parents[time][alive] = next[alive].parent;
        }
        if (!alive) {
            fail("no way on from goal", goal);
        }
    }
    for (time = length - 1, i = 0; time >= 0; i = parents[time][i], time--) {
        double row[2 * N];

        for (k = 0; k < N; k++) {
            row[k] = codes[time][i][k];
            row[N + k] = (double)outs[time][i][k];
        }
        if (fwrite(row, sizeof row, 1, file) != 1) {
            fail("nothing written of goal", goal);
        }
    }
}

/* Sensors at rest bring the controller back to where a fresh one is. */
static void come_back(node *at)
{
    long count;
    int k;

    for (count = 0; count < 4L * FLEXLINK_SETTLE_SAMPLES + 50; count++) {
        for (k = 0; k < N; k++) {
            at->code[k] = REST;
        }
        step(at, -1);
        for (k = 0; count >= 4L * FLEXLINK_SETTLE_SAMPLES && k < N; k++) {
            if (fabs((double)at->out[k] - (double)fresh.out[k]) > BACK) {
                fail("does not come back: actuator", k);
            }
        }
    }
}

/* A bad value or a stuck sensor: named, latched whatever the sensors say, and forgotten by init. */
static void break_sensor(node *at)
{
    const int broken = below(N), is_stuck = below(2) || !can_be_bad();
    int k, time;

    for (time = 0; time < FLEXLINK_RAIL_SAMPLES + 20; time++) {
        for (k = 0; k < N; k++) {
            at->code[k] = 1 + below(TOP - 1);
        }
        at->code[broken] = is_stuck ? TOP : at->code[broken];
        step(at, !is_stuck && time < 10 ? broken : -1);
    }
    if ((at->fault != 0) != IS_USED(broken)) {
        fail("no fault, or one without a reason: channel", broken);
    }
    flexlink_init(&at->state);
    at->fault = 0;
    memset(at->run, 0, sizeof at->run);
    check_words(at);
    for (k = 0; k < N; k++) {
        at->code[k] = REST;
    }
    step(at, -1);
}

int main(int count, char **arguments)
{
    node best;
    FILE *file;
    long most;
    int length, i;

    if (count != 5 || !(file = fopen(arguments[4], "wb"))) {
        return 2;
    }
    most = atol(arguments[1]);
    random_state = UINT64_C(0x9E3779B97F4A7C15) ^ (uint64_t)atol(arguments[2]);
    length = atoi(arguments[3]);
    if (length < 1 || length > LONGEST) {
        return 2;
    }
    begin(&fresh);
    for (i = 0; i < 4 * FLEXLINK_SETTLE_SAMPLES; i++) {
        step(&fresh, -1);
    }
    while (samples < most) {
        search(below(GOALS), length, file);
        best = beam[0];
        come_back(&best);
        best = beam[0];
        break_sensor(&best);
    }
    if (fclose(file)) {
        return 2;
    }
    printf("%ld", samples);
    for (i = 0; i < WORDS; i++) {
        printf(" %.9g", largest[i]);
    }
    printf("\n");
    return 0;
}
