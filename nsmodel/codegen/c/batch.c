/* Many runs in one call: the same steps for many values of the parameters, each from its own start. */

@CELLS@

enum { TO_DO = -1, PAUSED = -2 }; /* statuses of a cell that is not at its end */
#define LOOK_AFTER 65536 /* steps between two looks at the clock, at most, */
#define LOOKS_PER_CALL 16 /* and so many looks in the time of a call */

/* Go on with a batch in the memory s for about `seconds`; 1 where all of it is done. The memory must be this batch's own, and
   nothing of a cell is left in it when the next one begins. */
int model_run_cells(model_solver *s, model_cells *b, double seconds);

/* Steps are counted, and the clock is looked at after some. */
typedef struct { clock_t begin, last; double seconds; long left, between; } pace;

static int is_late(pace *p)
{
    if (p->left-- > 0)
        return 0;
    const clock_t now = clock();
    const double spent = (double)(now - p->last)/CLOCKS_PER_SEC;
    if (spent < p->seconds/LOOKS_PER_CALL && p->between < LOOK_AFTER)
        p->between *= 2;
    else if (spent > 2*p->seconds/LOOKS_PER_CALL && p->between > 1)
        p->between /= 2;
    p->last = now;
    p->left = p->between;
    return is_over(p->begin, p->seconds);
}

/* A solver as if there had been no cell before. */
static int begin_cell(model_solver *s, model_cells *b)
{
    memset(s, 0, sizeof *s);
    s->h = MODEL_STEP;
    s->budget = MODEL_MAX_WORK;
    s->ready = READY;
    b->step = START_STEPS;
    b->row = b->first;
    b->next = b->jump = 0;
    while (b->next <= START_STEPS)
        b->next += b->every;
    const int status = model_set_parameters(s, b->values + (long)MODEL_NP*b->cell);
    return status == MODEL_OK ? restart(s) : status;
}

/* Put the solver before step k, of its own length, with the inputs of the step. */
static int make_ready(model_solver *s, model_cells *b, long k)
{
    double h = MODEL_STEP;
    if (b->times != NULL) {
        h = b->lengths[k];
        s->t_0 = b->times[k];
        s->steps = 0;
    } else if (k == b->steps - 1 && b->last != MODEL_STEP) {
        h = b->last;
        s->t_0 = k*MODEL_STEP;
        s->steps = 0;
#if DIFFERENCE
        for (int i = 0; i < MODEL_NX; i++) /* the velocity is kept */
            s->x[MODEL_NX + i] *= h/MODEL_STEP;
#endif
    }
    if (s->h != h) {
        s->h = h;
#if CONSTANT
        s->newton.prepared = 0;
#endif
    }
#if INPUTS
    memcpy(begin_of(s), b->inputs + 2*MODEL_INPUTS*k, 2*MODEL_INPUTS*sizeof *b->inputs);
#if RESTARTED
    memcpy(s->regime, begin_of(s), sizeof s->regime);
    if (b->jump < b->jumping && b->jumps[b->jump] == k) {
        b->jump += 1;
        s->t = s->t_0 + s->steps*s->h;
        s->spent = 0;
        return renew_reaction(s);
    }
#endif
#endif
    return MODEL_OK;
}

/* Keep of the step of a cell that was attempted last what is asked for. */
static void keep_row(const model_solver *s, model_cells *b, long cell)
{
    const long row = b->rows*cell + b->row;
    write_row(s, b->whole);
    for (long j = 0; j < b->width; j++)
        b->kept[b->width*row + j] = b->whole[b->columns[j]];
#if LAW
    if (b->index != NULL)
        keep_index(b->index, row, s->work.code);
#endif
}

/* Take the steps of the cell at hand: its status, or PAUSED. */
static int run_cell(model_solver *s, model_cells *b, pace *p)
{
    const long cell = b->cell;
    for (; b->step < b->steps; b->step++) {
        if (is_late(p))
            return PAUSED;
        int status = make_ready(s, b, b->step);
        if (status == MODEL_OK)
            status = attempt(s);
        if (status != MODEL_OK)
            return status;
        const long number = b->step + 1;
        if (number == b->next || number == b->steps) {
            keep_row(s, b, cell);
            b->row += 1;
            b->next += b->every;
        }
        if (s->work.residual > b->worst[cell])
            b->worst[cell] = s->work.residual;
        b->newton[cell] += s->work.iterations;
#if LAW
        if (b->taken[cell] > 0)
            b->changes[cell] += memcmp(s->index, s->work.code, MODEL_M) != 0;
#endif
        b->taken[cell] += 1;
        commit(s);
    }
    return MODEL_OK;
}

int model_run_cells(model_solver *s, model_cells *b, double seconds)
{
    const clock_t now = clock();
    pace p = {now, now, seconds, 1, 1};
    for (; b->cell < b->cells; b->cell++, b->step = -1) {
        if (b->status[b->cell] != TO_DO)
            continue;
        int status = b->step < 0 ? begin_cell(s, b) : MODEL_OK;
        if (status == MODEL_OK)
            status = run_cell(s, b, &p);
        if (status == PAUSED)
            return 0;
        b->status[b->cell] = (signed char)status;
        if (status != MODEL_OK)
            b->failed_at[b->cell] = s->t;
    }
    return 1;
}
