/* ---- The interface ---- */


/* Whether the solver was initialised. */
static int is_ready(const model_solver *s) { return s->ready == READY; }

static int all_finite(size_t n, const double *v)
{
    size_t i;
    for (i = 0; i < n; i++)
        if (!isfinite(v[i])) return 0;
    return 1;
}

static int finite_there(const model_solver *s, const double *x)
{
    int i;
    for (i = 0; i < MODEL_BODIES; i++)
        if (s->present[i] && !all_finite(MODEL_DIM, x + (ptrdiff_t)MODEL_DIM*i)) return 0;
    return 1;
}

/* Compute the next step in s->work; the state stays. */
static int attempt(model_solver *s, model_motion *now, model_report *report)
{
    const double next = s->t_0 + (s->steps + 1)*s->h;
    size_t missing = 0;
    int status;
    s->t = s->steps != 0 ? s->t_0 + s->steps*s->h : s->t_0; /* -0 stays */
    if (!isfinite(s->t) || !isfinite(next) || !finite_there(s, s->x)) return MODEL_NOT_FINITE;
    if (!(next > s->t)) return MODEL_BAD_STEP;
    now->model = &own_functions;
    now->t = s->t;
    now->h = s->h;
    now->tolerance = MODEL_TOLERANCE;
    now->n = MODEL_BODIES;
    now->q = s->x;
    now->present = s->present;
    now->numbers = body_numbers;
    now->items = family_items;
    now->item_count = family_item_count;
    now->over = family_over;
    now->over_count = family_over_count;
    now->farthest = family_farthest;
    now->halves = NULL;
    now->budget = s->budget;
    now->motion = s->motion;
    now->contacts = s->contacts;
    now->family = s->family;
    now->first = s->first;
    now->second = s->second;
    now->multiplier = s->multiplier;
    now->q_next = s->work.x_next;
    now->leaves = s->work.leaves;
    status = move_bodies(now, (char *)s->work.memory, sizeof s->work.memory, &missing, report);
    if (status != MODEL_OK) return status;
    if (!finite_there(s, s->work.x_next)) return MODEL_NOT_FINITE;
    return now->contacts_out <= MODEL_CONTACTS ? MODEL_OK : MODEL_NO_ROOM;
}

int model_step(model_solver *s)
{
    model_motion now;
    model_report report;
    size_t contacts;
    int i;
    if (!is_ready(s)) return s->status = MODEL_NOT_INITIALISED;
    memset(&now, 0, sizeof now);
    memset(&report, 0, sizeof report);
    report.residual = INFINITY;
    s->status = attempt(s, &now, &report);
    s->residual = report.residual;
    s->iterations = report.factorisations;
    s->spent = report.work;
    if (s->status != MODEL_OK) return s->status;
    memcpy(s->x, s->work.x_next, sizeof s->x);
    s->contacts = now.contacts_out;
    contacts = (size_t)s->contacts;
    memcpy(s->family, now.family_out, contacts*sizeof *s->family);
    memcpy(s->first, now.first_out, contacts*sizeof *s->first);
    memcpy(s->second, now.second_out, contacts*sizeof *s->second);
    memcpy(s->multiplier, now.multiplier_out, contacts*sizeof *s->multiplier);
    s->length = s->h;
    for (i = 0; i < MODEL_BODIES; i++)
        if (s->work.leaves[i]) s->present[i] = 0;
    s->gap = report.gap;
    s->motion = report.motion;
    s->steps += 1;
    s->t = s->t_0 + s->steps*s->h;
    return MODEL_OK;
}

/* Back to the start; the step stays. */
static int restart(model_solver *s)
{
    int i;
    memcpy(s->x, body_starts, sizeof s->x);
    for (i = 0; i < MODEL_BODIES; i++) s->present[i] = 1;
    s->t = s->t_0 = s->steps = s->motion = s->residual = s->gap = 0;
    s->spent = 0;
    s->contacts = s->status = s->iterations = 0;
    s->length = s->h;
    return MODEL_OK;
}

int model_init(model_solver *s)
{
    memset(s, 0, sizeof *s);
    if (!is_sound()) return MODEL_BAD_ARITHMETIC;
    s->h = MODEL_STEP;
    s->budget = MODEL_MAX_WORK;
    s->ready = READY;
    return restart(s);
}

int model_reset(model_solver *s) { return is_ready(s) ? restart(s) : MODEL_NOT_INITIALISED; }

int model_set_time(model_solver *s, double t)
{
    if (!is_ready(s)) return MODEL_NOT_INITIALISED;
    if (!isfinite(t)) return MODEL_NOT_FINITE;
    s->t = s->t_0 = t;
    s->steps = 0;
    return MODEL_OK;
}

int model_set_step(model_solver *s, double h)
{
    if (!is_ready(s)) return MODEL_NOT_INITIALISED;
    if (!(h > 0) || !isfinite(h)) return MODEL_BAD_STEP;
    if (h == s->h) return MODEL_OK;
    s->t_0 = s->t;
    s->steps = 0;
    s->h = h;
    return MODEL_OK;
}

int model_set_state(model_solver *s, const double *x)
{
    if (!is_ready(s)) return MODEL_NOT_INITIALISED;
    if (!finite_there(s, x)) return MODEL_NOT_FINITE;
    memcpy(s->x, x, sizeof s->x);
    return MODEL_OK;
}

int model_set_present(model_solver *s, int body, int present)
{
    int i, kept = 0;
    if (!is_ready(s)) return MODEL_NOT_INITIALISED;
    if (body < 0 || body >= MODEL_BODIES) return MODEL_BAD_INDEX;
    if (present && !all_finite(MODEL_DIM, s->x + (ptrdiff_t)MODEL_DIM*body)) return MODEL_NOT_FINITE;
    s->present[body] = present != 0;
    for (i = 0; i < s->contacts; i++) {
        if (s->first[i] == body || (of_bodies[s->family[i]] && s->second[i] == body)) continue;
        s->family[kept] = s->family[i];
        s->first[kept] = s->first[i];
        s->second[kept] = s->second[i];
        s->multiplier[kept++] = s->multiplier[i];
    }
    s->contacts = kept;
    return MODEL_OK;
}

double model_get_time(const model_solver *s) { return s->t; }

void model_get_state(const model_solver *s, double *x) { memcpy(x, s->x, sizeof s->x); }

void model_get_present(const model_solver *s, unsigned char *present) { memcpy(present, s->present, sizeof s->present); }

void model_get_pressure(const model_solver *s, double *pressure)
{
    int i;
    memset(pressure, 0, MODEL_BODIES*sizeof *pressure);
    for (i = 0; i < s->contacts; i++) {
        pressure[s->first[i]] += s->multiplier[i]/s->length;
        if (of_bodies[s->family[i]]) pressure[s->second[i]] += s->multiplier[i]/s->length;
    }
}

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
    if (s != NULL) model_init(s);
    return s;
}

void model_free(model_solver *s) { free(s); }
#endif
