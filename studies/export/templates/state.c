static void forget(${name}_state *state)
{
    int k;

    for (k = 0; k < ${NAME}_N_MODES; k++) {
        state->high[k] = 0;
        state->line[k][0] = 0;
        state->line[k][1] = 0;
    }
    for (k = 0; k < ${NAME}_N_CHANNELS; k++) {
$forget_command        state->rail[k] = 0;
    }
}

void ${name}_init(${name}_state *state)
{
    forget(state);
    state->fault = 0;
}

void ${name}_shape_init(${name}_shaper *shaper, const ${reference_type} reference[3])
{
    uint32_t k;
    int axis;

    for (k = 0; k < ${NAME}_SHAPER_LENGTH; k++) {
        for (axis = 0; axis < 3; axis++) {
            shaper->past[k][axis] = reference[axis];
        }
    }
    shaper->newest = 0;
}
