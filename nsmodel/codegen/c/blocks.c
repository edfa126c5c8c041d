/* Blocks: what they keep stands behind the other inputs of a step, at KEPT. */
#define KEPT (MODEL_INPUTS - MODEL_NZ - MODEL_NW)

#if PULSES
/* When the pulse of period k begins and ends: products, no sums of periods. */
static void pulse_of(const struct pulse *p, double k, double duty, double *begin, double *end)
{
    const double first = p->kind == TRAILING ? 0 : p->kind == LEADING ? 1 - duty : (1 - duty)/2;
    const double last = p->kind == TRAILING ? duty : p->kind == LEADING ? 1 : (1 + duty)/2;
    *begin = p->phase + (k + first)*p->period;
    *end = p->phase + (k + last)*p->period;
}

/* Set the inputs that are pulses to what they are at t. */
static void set_pulses(double t, double *u)
{
    for (int i = 0; i < MODEL_PULSES; i++) {
        const struct pulse *p = &pulses[i];
        double begin, end;
        pulse_of(p, floor((t - p->phase)/p->period), u[p->duty], &begin, &end);
        u[p->at] = t >= begin && t < end ? p->high : p->low;
    }
}

#endif
/* The first time after t at which a block ticks or a pulse begins or ends. */
static double point_after(double t, const double *u)
{
    double first = tick_after(later(t));
#if PULSES
    for (int i = 0; i < MODEL_PULSES; i++) {
        const struct pulse *p = &pulses[i];
        double edge[2];
        pulse_of(p, floor((later(t) - p->phase)/p->period), u[p->duty], &edge[0], &edge[1]);
        for (int j = 0; j < 2; j++)
            if (edge[j] > later(t) && edge[j] < earlier(first))
                first = edge[j];
    }
#else
    (void)u;
#endif
    return first;
}

/* Let the blocks that are due at the time of the state act on the inputs u; whether these are finite then. */
static int sampled(const model_solver *s, double *u)
{
    double before[MODEL_INPUTS];
#if PULSES
    set_pulses(later(s->t), u);
#endif
    memcpy(before, u, sizeof before);
    tick(s, before, u);
#if PULSES
    memcpy(before, u, sizeof before);
    latch(s, before, u);
#endif
    return all_finite(MODEL_INPUTS, u);
}

/* Set the inputs of the step from the time of the state to `next` that the caller does not. */
static int place_inputs(model_solver *s, double next)
{
    double *begin = begin_of(s), *end = end_of(s);
#ifndef MODEL_OWN_TICKS
    if (!s->ticked && !sampled(s, begin))
        return MODEL_NOT_FINITE;
#endif
    if (point_after(s->t, begin) < earlier(next))
        return MODEL_BAD_STEP;
    memcpy(end + KEPT, begin + KEPT, (MODEL_INPUTS - KEPT)*sizeof *end);
#if PULSES
    set_pulses(later(s->t), begin);
    set_pulses(earlier(next), end);
#endif
    return MODEL_OK;
}

int model_sample(model_solver *s)
{
    double u[MODEL_INPUTS];
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (s->ticked)
        return MODEL_OK;
    memcpy(u, begin_of(s), sizeof u);
    if (!sampled(s, u))
        return MODEL_NOT_FINITE;
    memcpy(begin_of(s), u, sizeof u);
    s->ticked = 1;
    return MODEL_OK;
}

double model_next_tick(const model_solver *s)
{
    double u[MODEL_INPUTS];
    memcpy(u, s->x + BEGIN, sizeof u);
#ifndef MODEL_OWN_TICKS
    if (!s->ticked)
        (void)sampled(s, u);
#endif
    return point_after(s->t, u);
}

/* Set entries of the inputs to v[count]. */
static int keep(model_solver *s, const int *at, int count, const double *v)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!all_finite(count, v))
        return MODEL_NOT_FINITE;
    for (int i = 0; i < count; i++)
        begin_of(s)[at[i]] = end_of(s)[at[i]] = v[i];
    return MODEL_OK;
}

#if MEMORY
int model_set_memory(model_solver *s, const double *z) { return keep(s, memory_at, MODEL_NZ, z); }

void model_get_memory(const model_solver *s, double *z)
{
    for (int i = 0; i < MODEL_NZ; i++)
        z[i] = s->x[BEGIN + memory_at[i]];
}

#endif
#if HELD
int model_set_held(model_solver *s, const double *w) { return keep(s, held_at, MODEL_NW, w); }

void model_get_held(const model_solver *s, double *w)
{
    for (int i = 0; i < MODEL_NW; i++)
        w[i] = s->x[BEGIN + held_at[i]];
}

#endif
