"""Status of a case: why it stopped, as a number that travels through a compiled batch.

Inside the loop a status is a floating-point scalar (0 = fine) so that one arithmetic runs on every
executor; the first code that appears stays, and the state is frozen from there.
"""

OK = 0
OUT_OF_REACH = 1
SINGULAR = 2
DIVERGED = 3
NON_FINITE = 4
SATURATED = 5
ILL_CONDITIONED = 6
TOO_MANY_MODES = 7
PATCHES_OVERLAP = 8
PATCH_OFF_LINK = 9
UNSTABLE = 10
SHAPER_TOO_LONG = 11
WINDOW_TOO_LONG = 12
TOO_FAST = 13
STATION_OFF_LINK = 14
TOO_STIFF = 15
CLIPPED = 16
BUCKLED = 17
MOTORS_SATURATED = 18
NOT_ARRIVED = 19
NEAR_SINGULAR = 20
OVERLOADED = 21
OVERDAMPED = 22
UNPLACEABLE = 23
DELAY_OFF = 24
UNJUDGED = 25
STRAINED = 26

#: A case with one of these statuses ran to its end, and its metrics are valid.
FINISHED = (
    OK,
    SATURATED,
    UNSTABLE,
    CLIPPED,
    MOTORS_SATURATED,
    NOT_ARRIVED,
    NEAR_SINGULAR,
    OVERLOADED,
    UNJUDGED,
    STRAINED,
)

REASONS = {
    OK: "ok",
    OUT_OF_REACH: "pose out of reach",
    SINGULAR: "singular pose: a link along or across the path of its near joint, or the links' "
    "lines through one point",
    DIVERGED: "diverged: bending beyond a tenth of the link",
    NON_FINITE: "non-finite number",
    SATURATED: "actuators saturated too often",
    ILL_CONDITIONED: "modal filter or synthesizer ill-conditioned",
    TOO_MANY_MODES: "more controlled modes than patches",
    PATCHES_OVERLAP: "patches overlap",
    PATCH_OFF_LINK: "patch off the link",
    UNSTABLE: "linearised sampled loop unstable",
    SHAPER_TOO_LONG: "shaped motion longer than the run",
    WINDOW_TOO_LONG: "residual window longer than the run or shorter than a sample",
    TOO_FAST: "a filter, shaper or plant mode too fast for the step",
    STATION_OFF_LINK: "station off the link",
    TOO_STIFF: "drive, joints or ideal feedback too stiff for the step",
    CLIPPED: "ADC clipped too often",
    BUCKLED: "steady load on a link beyond its critical force",
    MOTORS_SATURATED: "motors saturated too often",
    NOT_ARRIVED: "platform did not reach its target",
    NEAR_SINGULAR: "path close to a singular pose",
    OVERLOADED: "a link compressed beyond its critical force on the way",
    OVERDAMPED: "a link mode with a damping ratio of 1 or more",
    UNPLACEABLE: "poles that cannot be placed: no decay, one beyond the mode's frequency without "
    "a frequency given, beyond half the sample rate, or estimates in phase",
    DELAY_OFF: "delay of the commands beyond 0 to 4 samples",
    UNJUDGED: "no verdict on stability: the linearised sampled loop is not finite",
    STRAINED: "patches strained beyond patches.strain_limit",
}
