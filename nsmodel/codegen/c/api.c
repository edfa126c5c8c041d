/* The interface. */


/* Whether a state is finite, and the velocity that it stands for. */
static int is_finite_state(const model_solver *s, const double *x)
{
#if DIFFERENCE
    for (int i = 0; i < MODEL_NX; i++)
        if (s->h > 0 && !is_finite(x[MODEL_NX + i]/s->h))
            return 0;
#else
    (void)s;
#endif
    return all_finite(MODEL_NSTATE, x);
}

/* Compute the step of length h from the time and the state at hand in s->work; they stay. */
static int next_state(model_solver *s)
{
    s->work.residual = INFINITY;
    s->work.iterations = 0;
#if INCLUSION
    s->work.solver = step_by_catching_up(s);
#else
#if FIXED
    s->work.solver = step_by_matrices(s);
#endif
#if BANDED
    s->work.solver = step_by_band(s);
#endif
#if NEWTON
    s->work.solver = step_by_newton(s);
#endif
#endif
    if (s->work.solver == NONE)
        return MODEL_NOT_SOLVED;
#if REWRITTEN
#if LAW
    advance(s, s->work.z, s->work.l, s->work.y, s->work.x_next, s->work.multipliers, s->work.outputs);
#else
    advance(s, s->work.z, s->work.x_next, s->work.multipliers, s->work.outputs);
#endif
#else
#if LAW
    advance(s, s->work.z, s->work.l, s->work.y, s->work.x_next);
#else
    advance(s, s->work.z, s->work.x_next);
#endif
#endif
    for (int i = 0; i < MODEL_NSTATE; i++)
        s->work.x_next[i] += 0.0; /* no -0 */
#if LAW
    for (int i = 0; i < MODEL_M; i++)
        s->work.l[i] += 0.0;
#endif
#if REWRITTEN
    if (!all_finite(MODEL_NL, s->work.multipliers) || !all_finite(MODEL_NL, s->work.outputs))
        return MODEL_NOT_FINITE;
#endif
    return is_finite_state(s, s->work.x_next) ? MODEL_OK : MODEL_NOT_FINITE;
}

#if RENEWED
/* At the start, or after a jump of an input: the reaction that the law has at the time of the state, by a step of no length. */
static int renew_reaction(model_solver *s)
{
    const double h = s->h;
    double l[MODEL_M];
    signed char index[MODEL_M];
#if INPUTS
    double end[MODEL_INPUTS];
    memcpy(end, end_of(s), sizeof end);
    memcpy(end_of(s), begin_of(s), sizeof end);
#endif
    memcpy(l, s->l, sizeof l);
    memcpy(index, s->index, sizeof index);
    first_multiplier(s, s->l, s->index);
    s->h = 0;
#if CONSTANT
    s->newton.prepared = 0;
#endif
    const int status = next_state(s);
    s->h = h;
#if CONSTANT
    s->newton.prepared = 0;
#endif
#if INPUTS
    memcpy(end_of(s), end, sizeof end);
#endif
    memcpy(s->l, l, sizeof l);
    memcpy(s->index, index, sizeof index);
    if (status == MODEL_OK)
        memcpy(s->x + MODEL_NX, s->work.x_next + MODEL_NX, MODEL_NX*sizeof *s->x);
    return status;
}

#endif
/* Compute the next step in s->work; the state stays. */
static int attempt(model_solver *s)
{
    const double next = s->t_0 + (s->steps + 1)*s->h;
    s->t = s->steps != 0 ? s->t_0 + s->steps*s->h : s->t_0; /* -0 stays */
    s->spent = 0;
    s->work.residual = INFINITY;
    s->work.iterations = 0;
    if (!is_finite(next) || !is_finite_state(s, s->x))
        return MODEL_NOT_FINITE;
    if (!(next > s->t))
        return MODEL_BAD_STEP;
#if BLOCKS
    const int placed = place_inputs(s, next);
    if (placed != MODEL_OK)
        return placed;
#endif
#if RESTARTED
    if (memcmp(s->regime, begin_of(s), sizeof s->regime) != 0) {
        double reaction[MODEL_NX];
        memcpy(reaction, s->x + MODEL_NX, sizeof reaction);
        int status = renew_reaction(s);
        if (status == MODEL_OK)
            status = next_state(s);
        if (status != MODEL_OK)
            memcpy(s->x + MODEL_NX, reaction, sizeof reaction);
        return status;
    }
#endif
    return next_state(s);
}

/* Make what attempt() has computed the state. */
static void commit(model_solver *s)
{
    memcpy(s->x, s->work.x_next, sizeof s->x);
#if RESTARTED
    memcpy(s->regime, end_of(s), sizeof s->regime);
#endif
#if LAW
    memcpy(s->l, s->work.l, sizeof s->l);
    memcpy(s->y, s->work.y, sizeof s->y);
    memcpy(s->index, s->work.code, sizeof s->index);
#endif
#if REWRITTEN
    memcpy(s->multipliers, s->work.multipliers, sizeof s->multipliers);
    memcpy(s->outputs, s->work.outputs, sizeof s->outputs);
#endif
    s->residual = s->work.residual;
    s->iterations = s->work.iterations;
    s->solver = s->work.solver;
    s->steps += 1;
    s->t = s->t_0 + s->steps*s->h;
#if BLOCKS
    s->ticked = 0;
#endif
#if TOLERANCE_OF_NUMBER
    s->number += 1;
#endif
}

int model_step(model_solver *s)
{
    if (!is_ready(s))
        return s->status = MODEL_NOT_INITIALISED;
#if BLOCKS
    double before[2*MODEL_INPUTS];
    memcpy(before, begin_of(s), sizeof before);
#endif
    s->status = attempt(s);
    if (s->status == MODEL_OK) {
        commit(s);
#if INPUTS
        memcpy(begin_of(s), end_of(s), MODEL_INPUTS*sizeof *s->x);
#endif
    } else {
#if BLOCKS
        memcpy(begin_of(s), before, sizeof before);
#endif
        s->residual = s->work.residual;
        s->iterations = s->work.iterations;
        s->solver = NONE;
    }
    return s->status;
}

#if LAW_OF_PARAMETERS
/* Take the ends of the law from the parameters; 0, and no change, where they are no ends or bound other sides. */
static int law_changes(model_solver *s)
{
    double *lo = s->work.l, *up = s->work.y;
#if CURVED_OF_PARAMETERS
    double numbers[MODEL_NUMBERS];
    law_of_parameters(s, lo, up, numbers);
    for (int i = 0; i < MODEL_CURVED; i++)
        if (!set_valid(&curved[i], numbers + curved[i].numbers))
            return 0;
#else
    law_of_parameters(s, lo, up);
#endif
    for (int i = 0; i < MODEL_M; i++)
        if (!(lo[i] <= up[i]) || is_finite(lo[i]) != bounded_below[i] || is_finite(up[i]) != bounded_above[i])
            return 0;
    memcpy(s->lower, lo, sizeof s->lower);
    memcpy(s->upper, up, sizeof s->upper);
#if CURVED_OF_PARAMETERS
    memcpy(s->curved_numbers, numbers, sizeof numbers);
#endif
    return 1;
}
#endif

#if CHECKED_PARAMETERS
/* Whether the parameters are in their ranges and give a law; then its numbers are theirs. */
static int are_accepted(model_solver *s)
{
#if RANGES
    double range[RANGE_COUNT];
    ranges_of_parameters(s, range);
    for (int i = 0; i < RANGE_COUNT; i++)
        if (!(range[i] >= 0))
            return 0;
#endif
#if LAW_OF_PARAMETERS
    return law_changes(s);
#else
    return 1;
#endif
}
#endif

/* Back to the start, as the parameters give it. */
static int restart(model_solver *s)
{
    double x[MODEL_NSTATE];
    start(s, x);
#if BLOCKS
    double held[MODEL_NZ + MODEL_NW];
    start_held(s, x, x + BEGIN, held);
    memcpy(x + BEGIN + KEPT, held, sizeof held);
    memcpy(x + BEGIN + MODEL_INPUTS + KEPT, held, sizeof held);
#endif
    if (!all_finite(MODEL_NSTATE, x))
        return MODEL_BAD_PARAMETER;
    memcpy(s->x, x, sizeof x);
#if RESTARTED
    memcpy(s->regime, begin_of(s), sizeof s->regime);
#endif
    s->t_0 = 0;
    s->steps = START_STEPS;
    s->t = s->t_0 + s->steps*s->h;
    s->status = MODEL_OK;
#if BLOCKS
    s->ticked = 0;
#endif
    s->residual = 0;
    s->spent = 0;
    s->iterations = s->solver = 0;
#if TOLERANCE_OF_NUMBER
    s->number = 0;
#endif
#if LAW
    first_multiplier(s, s->l, s->index);
    memset(s->y, 0, sizeof s->y);
#endif
#if REWRITTEN
    memset(s->multipliers, 0, sizeof s->multipliers);
    memset(s->outputs, 0, sizeof s->outputs);
#endif
#if FIXED_MAPS
    s->fixed.current = -1;
#endif
#if BEGUN
    return renew_reaction(s);
#else
    return MODEL_OK;
#endif
}

int model_init(model_solver *s)
{
    memset(s, 0, sizeof *s);
    if (!is_sound())
        return MODEL_BAD_ARITHMETIC;
    s->h = MODEL_STEP;
    s->budget = MODEL_MAX_WORK;
    s->ready = READY;
#if LENGTHS
    for (size_t k = sizeof known_length/sizeof *known_length; k-- > 0;) {
        s->spent = 0;
        s->h = known_length[k];
        find_matrices(s);
#if WORST_CASE
        form_maps(s);
#endif
    }
    s->spent = 0;
#else
#if WORST_CASE
    form_maps(s);
#endif
#endif
    for (int i = 0; i < MODEL_NSTATE; i++)
        s->x[i] = NAN; /* until there is a start: no step is taken from here */
#if PARAMETERS
    memcpy(s->p, default_p, sizeof s->p);
#endif
#if CHECKED_PARAMETERS
    if (!are_accepted(s))
        return MODEL_BAD_PARAMETER;
#endif
    return restart(s);
}

int model_reset(model_solver *s) { return is_ready(s) ? restart(s) : MODEL_NOT_INITIALISED; }

int model_set_time(model_solver *s, double t)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!is_finite(t))
        return MODEL_NOT_FINITE;
    s->t = s->t_0 = t;
    s->steps = 0;
#if BLOCKS
    s->ticked = 0;
#endif
    return MODEL_OK;
}

int model_set_step(model_solver *s, double h)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
#if ONE_STEP
    if (!(fabs(h - MODEL_STEP) <= SAME*MODEL_STEP))
        return MODEL_BAD_STEP;
#else
    if (!(h > 0) || !is_finite(h))
        return MODEL_BAD_STEP;
#if KNOWN_LENGTHS
    int known = 0;
    for (size_t k = 0; k < sizeof known_length/sizeof *known_length; k++)
        known |= fabs(h - known_length[k]) <= SAME*known_length[k];
    if (!known)
        return MODEL_BAD_STEP;
#endif
#endif
    if (h == s->h)
        return MODEL_OK;
    s->t_0 = s->t;
    s->steps = 0;
    s->h = h;
#if CONSTANT
    s->newton.prepared = 0;
#endif
    return MODEL_OK;
}

int model_set_state(model_solver *s, const double *x)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!all_finite(MODEL_NX, x))
        return MODEL_NOT_FINITE;
    memcpy(s->x, x, MODEL_NX*sizeof *x);
    return MODEL_OK;
}

#if VELOCITY
#if DIFFERENCE
/* The difference of the last two positions is kept: a velocity belongs to the step in use. */
#define CARRIED(h) (h)
#else
#define CARRIED(h) 1.0
#endif
int model_set_velocity(model_solver *s, const double *v)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    for (int i = 0; i < MODEL_NX; i++)
        if (!is_finite(CARRIED(s->h)*v[i]))
            return MODEL_NOT_FINITE;
    for (int i = 0; i < MODEL_NX; i++)
        s->x[MODEL_NX + i] = CARRIED(s->h)*v[i];
    return MODEL_OK;
}

void model_get_velocity(const model_solver *s, double *v)
{
    for (int i = 0; i < MODEL_NX; i++)
        v[i] = s->x[MODEL_NX + i]/CARRIED(s->h);
}
#endif

#if FORCE
int model_set_force(model_solver *s, const double *r)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!all_finite(MODEL_NX, r))
        return MODEL_NOT_FINITE;
    memcpy(s->x + MODEL_NX, r, MODEL_NX*sizeof *r);
#if RESTARTED
    memcpy(s->regime, begin_of(s), sizeof s->regime);
#endif
    return MODEL_OK;
}

void model_get_force(const model_solver *s, double *r) { memcpy(r, s->x + MODEL_NX, MODEL_NX*sizeof *r); }
#endif

#if GIVEN
int model_set_inputs_between(model_solver *s, const double *begin, const double *end)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!all_finite(MODEL_NU, begin) || !all_finite(MODEL_NU, end))
        return MODEL_NOT_FINITE;
#if BLOCKS
    for (int i = 0; i < MODEL_NU; i++) {
        begin_of(s)[given_at[i]] = begin[i];
        end_of(s)[given_at[i]] = end[i];
    }
#else
    memcpy(begin_of(s), begin, MODEL_NU*sizeof *begin);
    memcpy(end_of(s), end, MODEL_NU*sizeof *end);
#endif
    return MODEL_OK;
}

int model_set_inputs(model_solver *s, const double *u) { return model_set_inputs_between(s, u, u); }

#if BLOCKS
void model_get_inputs(const model_solver *s, double *u)
{
    for (int i = 0; i < MODEL_NU; i++)
        u[i] = s->x[BEGIN + given_at[i]];
}
#else
void model_get_inputs(const model_solver *s, double *u) { memcpy(u, s->x + BEGIN, MODEL_NU*sizeof *u); }
#endif
#endif

int model_set_budget(model_solver *s, long work)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    s->budget = work;
    return MODEL_OK;
}

#if PARAMETERS
int model_set_parameters(model_solver *s, const double *p)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!all_finite(MODEL_NP, p))
        return MODEL_NOT_FINITE;
#if CHECKED_PARAMETERS
    double old[MODEL_NP];
    memcpy(old, s->p, sizeof old);
    memcpy(s->p, p, sizeof s->p);
    if (!are_accepted(s)) {
        memcpy(s->p, old, sizeof old);
        return MODEL_BAD_PARAMETER;
    }
#else
    memcpy(s->p, p, sizeof s->p);
#endif
#if CONSTANT
    s->newton.prepared = 0;
#endif
    return MODEL_OK;
}
#endif

double model_get_time(const model_solver *s) { return s->t; }

void model_get_state(const model_solver *s, double *x) { memcpy(x, s->x, MODEL_NX*sizeof *x); }

#if REWRITTEN
void model_get_multipliers(const model_solver *s, double *l) { memcpy(l, s->multipliers, sizeof s->multipliers); }

void model_get_outputs(const model_solver *s, double *y) { memcpy(y, s->outputs, sizeof s->outputs); }
#else
#if LAW
void model_get_multipliers(const model_solver *s, double *l) { memcpy(l, s->l, sizeof s->l); }

void model_get_outputs(const model_solver *s, double *y) { memcpy(y, s->y, sizeof s->y); }
#endif
#endif

#if LAW
void model_get_index_set(const model_solver *s, signed char *index) { memcpy(index, s->index, sizeof s->index); }
#endif

double model_get_residual(const model_solver *s) { return s->residual; }

int model_get_iterations(const model_solver *s) { return s->iterations; }

long model_get_work(const model_solver *s) { return s->spent; }

int model_get_status(const model_solver *s) { return s->status; }

const char *model_status_text(int status)
{
    switch (status) {
@STATUS_CASES@
    default:
        return "unknown status";
    }
}

#ifndef MODEL_NO_MALLOC
model_solver *model_create(void)
{
    model_solver *s = malloc(sizeof *s);
    if (s != NULL)
        model_init(s);
    return s;
}

void model_free(model_solver *s) { free(s); }
#endif
