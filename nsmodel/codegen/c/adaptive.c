
/* Steps chosen by local error control: the rules, the names and the order of operations are those of nsmodel/simulation/error_control.py. */
#if VELOCITY
#define WATCHED (2*MODEL_NX)
#else
#define WATCHED MODEL_NX
#endif
#define STATES MODEL_NSTATE
#define ROWS (MODEL_M > 0 ? MODEL_M : 1)

@CONTROL@

/* Take steps, two rows each, until there is no room for more, the end is reached, `seconds` are over, or a step is not certified
   here. moved: how far extrapolation has moved the state of a row, in units of what is allowed. Return the number of rows. */
long model_adapt(model_solver *s, model_control *c, long room, double number, double seconds, double *rows, signed char *index,
                 double *times, double *lengths, double *moved, model_totals *totals);
long model_control_size(void);

typedef struct {
    double x[MODEL_NSTATE], l[ROWS], y[ROWS], watched[WATCHED];
    signed char index[ROWS];
    double residual, iterations;
    int solver;
} model_result;

long model_control_size(void) { return (long)sizeof(model_control); }

static double time_at(const model_control *c, double t)
{
    return c->start + ldexp(t, -(int)c->least - 1)*c->length;
}

/* One step as a result; 0 where it is not certified. */
static int take(model_solver *s, double t, double h, const double *x, const double *l, const signed char *index, model_result *r)
{
    model_place(s, 0, h, x, l, index);
    s->t_0 = t;
    if (attempt(s) != MODEL_OK)
        return 0;
    memcpy(r->x, s->work.x_next, sizeof r->x);
#if LAW
    memcpy(r->l, s->work.l, sizeof s->work.l);
    memcpy(r->y, s->work.y, sizeof s->work.y);
    memcpy(r->index, s->work.code, sizeof s->work.code);
#endif
    for (int i = 0; i < MODEL_NX; i++)
        r->watched[i] = r->x[i];
#if VELOCITY
    for (int i = MODEL_NX; i < WATCHED; i++)
        r->watched[i] = r->x[i]/CARRIED(h);
#endif
    r->residual = s->work.residual;
    r->iterations = s->work.iterations;
    r->solver = s->work.solver;
    return 1;
}

#if DIFFERENCE
/* The state for a step that is `ratio` as long: the difference of positions keeps its velocity. */
static void shorten(double *x, double ratio)
{
    for (int i = MODEL_NX; i < MODEL_NSTATE; i++)
        x[i] *= ratio;
}

#endif
/* The order of a step on one index set; 1 for the first one where it uses a multiplier of the start. */
static int order_of(const model_control *c, const model_result *fine)
{
#if FORCE
    if (c->fresh != 0)
        return 1;
#endif
#if LAW
    for (int i = 0; i < MODEL_M; i++)
        if (fine->index[i] == 0 && c->lowering[i] != 0)
            return 1;
#else
    (void)fine;
#endif
    return (int)c->order;
}

/* The largest of errors in units of what is allowed. */
static double units_of(const model_control *c, const double *off, const model_result *fine)
{
    double size[WATCHED], worst = 0;
    for (int i = 0; i < WATCHED; i++)
        size[i] = max_of(c->size[i], fabs(fine->watched[i]));
    for (int i = 0; i < WATCHED; i++) {
        double floor = 0;
        for (int k = 0; k < WATCHED; k++)
            if (c->group[k] == c->group[i])
                floor = max_of(floor, size[k]/c->unit[k]);
        const double allowed = c->atol[i] + c->rtol*max_of(size[i], c->part[i]*c->unit[i]*floor);
        const double units = allowed > 0 ? off[i]/allowed : off[i] > 0 ? INFINITY : 0.0;
        if (!(units <= worst))
            worst = units < INFINITY ? units : INFINITY;
    }
    return worst;
}

/* The error of x_fine; d = (x_fine - x_coarse)/weight, weight = 2^order - 1. */
static double error_of(const model_control *c, double h, const model_result *coarse, const model_result *half,
                       const model_result *fine, int smooth, double weight, double *d)
{
    double off[WATCHED];
    for (int i = 0; i < WATCHED; i++) {
        d[i] = (fine->watched[i] - coarse->watched[i])/weight;
        off[i] = fabs(d[i]);
        if (!smooth) {
            const double step = half->watched[i] - c->watched[i];
            const double within = fabs(fine->watched[i] - half->watched[i] - step), before = fabs(step - h/2*c->rate[i]);
            off[i] = worse_of(off[i], worse_of(within, before));
        }
    }
    return units_of(c, off, fine);
}

/* The error of x_fine + d: d falls like h^(order + 1), the rest is of x_fine + d. */
static double of_better(const model_control *c, const model_result *fine, int order, const double *d)
{
    const double ratio = ldexp(1.0, ((int)c->of_j - (int)c->j)*(order + 1));
    double off[WATCHED];
    for (int i = 0; i < WATCHED; i++)
        off[i] = fabs(d[i] - (isnan(c->d[i]) ? 0.0 : c->d[i]*ratio));
    return units_of(c, off, fine);
}

#if LAW
#if !CLOSING
/* Whether y is beyond 0 in a row that is let go, or outside a cone whose l is 0: an impulse alone would bring it back. */
static int is_past_a_wall(const model_solver *s, const model_control *c, const signed char *index, const double *y)
{
    (void)s; /* it has the numbers of the sets where parameters give them */
#if CURVED
    int k = 0;
#endif
    for (int i = 0; i < MODEL_M; i++) {
#if CURVED
        if (k < MODEL_CURVED && i == curved[k].start) {
            const int open = -1, first = i;
            double u[MODEL_BLOCK], wall = 0;
            for (; i < first + curved[k].size; i++) {
                u[i - first] = -y[i];
                wall += c->wall[i];
            }
            i--;
            if (wall > 0 && index[first] == open && set_code(&curved[k], NUMBERS(k), u) != open)
                return 1;
            k++;
            continue;
        }
#endif
        if (index[i]*y[i]*c->wall[i] > 0)
            return 1;
    }
    return 0;
}

#endif
#endif
/* x = x_fine + (x_fine - x_coarse)/weight, what is carried of the multipliers as it is; 0 where a velocity would change its
   sign, y is past a wall, or it cannot be projected. */
static int extrapolate(model_solver *s, const model_control *c, double end, const model_result *coarse, const model_result *fine,
                       double weight, double *x)
{
    for (int i = 0; i < MODEL_NSTATE; i++) {
#if VELOCITY
        const double other = i < MODEL_NX ? coarse->x[i] : coarse->x[i]*CARRIED(0.5);
#else
        const double other = coarse->x[i];
#endif
        x[i] = fine->x[i] + (fine->x[i] - other)/weight;
#if FORCE
        if (i >= MODEL_NX)
            x[i] = fine->x[i];
#endif
#if VELOCITY
        if (i >= MODEL_NX && ((x[i] > 0) != (fine->x[i] > 0) || (x[i] < 0) != (fine->x[i] < 0)))
            return 0;
#endif
    }
#if CLOSING
    model_result closing;
    if (!take(s, time_at(c, end - 1), ldexp(c->length, -(int)c->least - 1), x, fine->l, fine->index, &closing))
        return 0;
    memcpy(x, closing.x, sizeof closing.x);
#else
#if LAW
    double y[ROWS];
    for (int i = 0; i < MODEL_M; i++)
        y[i] = fine->y[i] + (fine->y[i] - coarse->y[i])/weight;
    if (is_past_a_wall(s, c, fine->index, y))
        return 0;
#endif
    (void)s;
    (void)c;
    (void)end;
#endif
    return 1;
}

long model_adapt(model_solver *s, model_control *c, long room, double number, double seconds, double *rows, signed char *index,
                 double *times, double *lengths, double *moved, model_totals *totals)
{
    const clock_t start = clock();
    const double last = ldexp(1.0, (int)c->least + 1);
    model_result coarse, half, fine;
    signed char before[ROWS];
    int known = 0; /* whether coarse is known: the first half of a step that was refused */
    long row = 0, tried = 0;
    totals->status = MODEL_OK;
    for (int i = 0; i < ROWS; i++)
        before[i] = (signed char)c->index[i];
    while (c->t < last && row + 2 <= room) {
        if (++tried % LOOK == 0 && is_over(start, seconds))
            return row;
        const double h = ldexp(c->length, -(int)c->j), halves = ldexp(1.0, (int)(c->least - c->j));
        double *at = rows + (long)@WIDTH@*row, x[MODEL_NSTATE];
        memcpy(x, c->x, sizeof x);
        if (!known && !take(s, time_at(c, c->t), h, x, c->l, before, &coarse))
            break;
#if DIFFERENCE
        shorten(x, 0.5);
#endif
        if (!take(s, time_at(c, c->t), h/2, x, c->l, before, &half))
            break;
        write_row(s, at);
#if MONOTONE
        watch_monotone(totals, s);
#endif
        if (!take(s, time_at(c, c->t + halves), h/2, half.x, half.l, half.index, &fine))
            break;
        write_row(s, at + @WIDTH@);
        int smooth = 1;
#if LAW
        const signed char *set = c->fresh != 0 ? coarse.index : before;
        smooth = memcmp(set, coarse.index, MODEL_M) == 0 && memcmp(set, half.index, MODEL_M) == 0
                 && memcmp(set, fine.index, MODEL_M) == 0;
#endif
        const int order = smooth ? order_of(c, &fine) : 1, least = c->j >= c->least;
        const double weight = ldexp(1.0, order) - 1, end = c->t + 2*halves;
        double d[WATCHED];
        const double error = error_of(c, h, &coarse, &half, &fine, smooth, weight, d);
        const int better = error <= c->looser && smooth && extrapolate(s, c, end, &coarse, &fine, weight, x);
        const double allowed = c->looser*(better ? 1.0 : smooth ? h/c->T : c->crossing);
        if (error > allowed && !least) {
            c->rejected += 1;
            c->j += 1;
#if DIFFERENCE
            shorten(c->x, 0.5);
#endif
            coarse = half;
            known = 1;
            continue;
        }
        if (error > allowed && c->no_jump != 0)
            break;
        known = 0;
        times[row] = time_at(c, c->t) + h/2;
        times[row + 1] = time_at(c, end);
        lengths[row] = lengths[row + 1] = h/2;
        moved[row] = 0;
        moved[row + 1] = better ? error : 0.0;
#if LAW
        keep_index(index, row, half.index);
        keep_index(index, row + 1, fine.index);
        if (c->fresh == 0)
            count_change(totals, before, half.index);
        count_change(totals, half.index, fine.index);
#endif
        count(totals, half.residual, half.iterations, half.solver, number + (double)row + 1);
        count(totals, fine.residual, fine.iterations, fine.solver, number + (double)row + 2);
        c->estimate += least ? 0.0 : better ? of_better(c, &fine, order, d) : error;
        for (int i = 0; i < WATCHED; i++) {
            c->rate[i] = (fine.watched[i] - half.watched[i])/(h/2);
            c->watched[i] = fine.watched[i];
            c->d[i] = better && c->fresh == 0 ? d[i] : NAN;
        }
        c->of_j = c->j;
        memcpy(c->x, fine.x, sizeof fine.x);
        if (better) {
            memcpy(c->x, x, sizeof x);
            for (int i = 0; i < MODEL_NX; i++)
                c->watched[i] = x[i];
#if CLOSING
            double *gaps = at + @WIDTH@ + AT_RECORDS;
            records(s, s->work.z, s->work.l, s->work.y, gaps);
            for (int i = 0; i < @WIDTH@ - AT_RECORDS; i++)
                gaps[i] += 0.0;
#endif
#if VELOCITY
            for (int i = MODEL_NX; i < WATCHED; i++)
                c->watched[i] = at[@WIDTH@ + AT_RECORDS + i - MODEL_NX] = x[i]/CARRIED(h/2) + 0.0;
#endif
            for (int i = 0; i < MODEL_NSTATE; i++)
                at[@WIDTH@ + i] = x[i] + 0.0;
        }
        for (int i = 0; i < WATCHED; i++)
            c->size[i] = max_of(c->size[i], fabs(c->watched[i]));
        memcpy(c->l, fine.l, sizeof fine.l);
        memcpy(before, fine.index, sizeof before);
        c->fresh = 0;
        c->accepted += 1;
        c->extrapolated += better && error > 0;
        c->at_least_step += least;
        c->least_step = h/2 < c->least_step ? h/2 : c->least_step;
        c->t = end;
        const double doubled = ldexp(error, order + smooth), budget = c->grow*allowed*(smooth && !better ? 2.0 : 1.0);
        const double j = c->j;
        if (j > c->largest && doubled <= budget && fmod(end, 4*halves) == 0)
            c->j -= 1;
#if DIFFERENCE
        shorten(c->x, ldexp(2.0, (int)(j - c->j)));
#endif
        row += 2;
        for (int i = 0; i < ROWS; i++)
            c->index[i] = before[i];
    }
    if (c->t < last && row + 2 <= room)
        totals->status = MODEL_NOT_SOLVED;
    return row;
}
