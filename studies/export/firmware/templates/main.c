/* Firmware around the controller {{ name }}: a timer interrupt at its sample rate.
 *
 * The five functions of the section "your hardware" are stubs: they say what is expected of them,
 * in which units, and do nothing. All else is as it must be.
 */
#include "{{ name }}.h"

#define CLOCK_HZ {{ clock }}u /* of the processor, which counts down SysTick */
#define PERIOD ((uint32_t)(CLOCK_HZ / {{ NAME }}_SAMPLE_RATE + 0.5))

typedef {{ wire }} wire;
typedef {{ word }} word;

void timer_handler(void);

static {{ name }}_state state;
static {{ name }}_shaper shaper;
static wire sensor[{{ NAME }}_N_CHANNELS], actuator[{{ NAME }}_N_CHANNELS];
static word planned[{{ NAME }}_N_POSE], shaped[{{ NAME }}_N_POSE];
static uint32_t settling;

/* For the debugger, or for whatever supervises the machine. */
volatile int32_t faulty_sensor; /* number from 1; 0: none */
volatile uint32_t overruns;     /* samples that ended after the next one had begun */
volatile uint32_t samples;

/* --- your hardware ---------------------------------------------------------------------------- */

/* Put {{ "DAC codes" if fixed else "volts at the patches" }} on all actuators, at one instant. */
static void write_actuators(const wire *value)
{
    (void)value;
}

/* Sample all sensors at one instant: {{ "ADC codes" if fixed else "volts at the ADC, code * " ~ NAME ~ "_ADC_STEP" }}. */
static void read_sensors(wire *value)
{
    int k;

    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        value[k] = {{ at_rest }}; /* a machine at rest */
    }
}

/* The pose that the path asks for now: x, y{{ " [nm], phi [nrad]" if fixed else " [m], phi [rad]" }}. */
static void plan(word *pose)
{
    pose[0] = 0;
    pose[1] = 0;
    pose[2] = 0;
}

/* Give the shaped pose to the inverse kinematics and the servo of the actuated joints. */
static void command_sliders(const word *pose)
{
    (void)pose;
}

/* Amplifiers of the patches on or off; off is the safe state, also at reset. */
static void amplifiers(int is_on)
{
    (void)is_on;
}

/* Served in time, or the hardware switches the amplifiers off. */
static void serve_watchdog(void)
{
}

/* --- the sample ------------------------------------------------------------------------------- */

static void begin(void)
{
    int k;

    amplifiers(0);
    {{ name }}_init(&state);
    plan(planned);
    {{ name }}_shape_init(&shaper, planned);
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        actuator[k] = {{ rest }};
    }
    settling = {{ NAME }}_SETTLE_SAMPLES;
    faulty_sensor = 0;
}

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018u)
#define INTERRUPT_CONTROL (*(volatile uint32_t *)0xE000ED04u)
#define SYSTICK_PENDS (1u << 26)

/* Every sample, with the highest priority. */
void timer_handler(void)
{
    write_actuators(actuator); /* computed from the sample before: part of the design */
    read_sensors(sensor);
    faulty_sensor = {{ name }}_step(&state, sensor, actuator);
    if (faulty_sensor) {
        amplifiers(0); /* until begin() */
    } else if (settling > 0 && --settling == 0) {
        amplifiers(1);
    }
    plan(planned);
    {{ name }}_shape_step(&shaper, planned, shaped);
    command_sliders(shaped);
    if (INTERRUPT_CONTROL & SYSTICK_PENDS) {
        overruns++; /* the delay is no longer the one that was designed for */
        amplifiers(0);
    }
    samples++;
    serve_watchdog();
}

int main(void)
{
    begin();
    SYSTICK_RELOAD = PERIOD - 1u;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 7; /* on, by the processor's clock, with interrupt */
    for (;;) {
        __asm__ volatile("wfi");
    }
}
