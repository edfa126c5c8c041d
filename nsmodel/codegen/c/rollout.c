/* Many steps in one call, for a caller that keeps their rows. */
#include <time.h>

#define LOOK 256 /* steps between two looks at the clock, at most */

@COLUMNS@

@TOTALS@

/* Where a run stands: what the next step starts from. */
void model_place(model_solver *s, double k, double h, const double *x, const double *l, const signed char *index);
/* Take `steps` steps from number `k` of `last`, fewer where one fails or `seconds` are over; t[i], h[i] for each, or NULL where
   t = k h; of inputs u at both ends of each, where the model has some. Keep every `every`-th row, and the last; return how many steps were taken. */
long model_rollout(model_solver *s, double k, long steps, double last, long every, double seconds, const double *t,
                   const double *h, const double *inputs, double *rows, signed char *index, model_totals *totals);
void model_fetch(const model_solver *s, double *x, double *l, signed char *index);
/* Take step number k alone, from the state and l at `at`, with the row behind them, and codes with those of the row behind: 0 where
   it fails, else twice its solver and 1, or 2 where codes are as they were. */
int model_single(model_solver *s, double k, double h, double *at, signed char *index);
#if RESTARTED
/* After a jump of an input: put the reaction at time t into the state; the status. */
int model_restart(model_solver *s, double t, double *x);
#endif
long model_size(void);

#if INCLUSION
static void inclusion_columns(const model_solver *s, double *at)
{
    memcpy(at + AT_V, s->inclusion.v, sizeof s->inclusion.v);
#if SELECTION
    memcpy(at + AT_SELECTION, s->inclusion.selection, sizeof s->inclusion.selection);
#endif
    memcpy(at + AT_DEFECT, s->inclusion.defect, sizeof s->inclusion.defect);
    at[AT_PREDICTOR_DISTANCE] = s->inclusion.predictor_distance;
    at[AT_EXCESS] = s->inclusion.excess;
    at[AT_TOLERANCE] = s->inclusion.tolerance;
}

#endif
#if MONOTONE
/* Whether S - shift is positive definite: Cholesky's method, in L. */
static int exceeds(double (*S)[MODEL_M], double shift, double (*L)[MODEL_M])
{
    for (int i = 0; i < MODEL_M; i++)
        for (int j = 0; j <= i; j++) {
            double sum = i == j ? S[i][i] - shift : S[i][j];
            for (int k = 0; k < j; k++)
                sum -= L[i][k]*L[j][k];
            if (i == j && !(sum > 0))
                return 0;
            L[i][j] = i == j ? sqrt(sum) : sum/L[j][j];
        }
    return 1;
}

#define LOWER_BY 1e-3 /* part by which a least eigenvalue must be below the one known */
#define RESOLVED 1e-9 /* part of it to which it is found */

/* The least eigenvalue of (W + W')/2, rows and columns scaled alike, where it is below 0 and the least so far; else that. */
static double least_eigenvalue(const double *W, double least)
{
    double S[MODEL_M][MODEL_M], L[MODEL_M][MODEL_M], d[MODEL_M];
    for (int i = 0; i < MODEL_M; i++) {
        d[i] = 0;
        for (int j = 0; j < MODEL_M; j++) {
            S[i][j] = (W[MODEL_M*i + j] + W[MODEL_M*j + i])/2;
            if (fabs(S[i][j]) > d[i])
                d[i] = fabs(S[i][j]);
        }
        d[i] = d[i] > 0 ? sqrt(d[i]) : 1.0;
    }
    for (int i = 0; i < MODEL_M; i++)
        for (int j = 0; j < MODEL_M; j++)
            S[i][j] /= d[i]*d[j];
    double high = least < 0 ? least : 0.0, low = -MODEL_M - 1.0;
    high -= LOWER_BY*fabs(high) + MONOTONE_ERROR*MODEL_M*EPS; /* no search for what is nearly known */
    if (exceeds(S, high, L))
        return least;
    while (high - low > RESOLVED*fabs(high)) {
        const double middle = (low + high)/2;
        if (exceeds(S, middle, L))
            low = middle;
        else
            high = middle;
    }
    return high;
}

#endif
/* The step that was attempted last, as a row. */
static void write_row(const model_solver *s, double *at)
{
    memcpy(at, s->work.x_next, sizeof s->work.x_next);
    at[AT_RESIDUAL] = s->work.residual;
    at[AT_NEWTON] = s->work.iterations;
#if LAW
    memcpy(at + AT_L, s->work.l, sizeof s->work.l);
    memcpy(at + AT_Y, s->work.y, sizeof s->work.y);
#endif
#if REWRITTEN
    memcpy(at + AT_MULTIPLIERS, s->work.multipliers, sizeof s->work.multipliers);
    memcpy(at + AT_OUTPUTS, s->work.outputs, sizeof s->work.outputs);
#endif
#if RECORDS
#if LAW
    records(s, s->work.z, s->work.l, s->work.y, at + AT_RECORDS);
#else
    records(s, s->work.z, at + AT_RECORDS);
#endif
#endif
#if INCLUSION
    inclusion_columns(s, at);
#endif
    for (int j = 0; j < @WIDTH@; j++)
        at[j] += 0.0; /* no -0 */
}

/* What a certified step adds to the totals. */
static void count(model_totals *totals, double residual, double iterations, int solver, double number)
{
    if (residual > totals->worst) {
        totals->worst = residual;
        totals->worst_step = number;
    }
    totals->newton += iterations;
    if (iterations > totals->newton_max)
        totals->newton_max = iterations;
    totals->counts[solver] += 1;
}

#if LAW
static void keep_index(signed char *index, long row, const signed char *code)
{
    memcpy(index + (long)MODEL_M*row, code, MODEL_M);
}

static void count_change(model_totals *totals, const signed char *before, const signed char *code)
{
    totals->changes += memcmp(before, code, MODEL_M) != 0;
}

#endif
#if MONOTONE
/* Look at W + W' of the step that was attempted last, where it is asked for. */
static void watch_monotone(model_totals *totals, const model_solver *s)
{
    if (totals->least > -INFINITY)
        totals->least = least_eigenvalue(s->newton.W, totals->least);
}

#endif
/* Whether the time for a call is over. */
static int is_over(clock_t start, double seconds) { return (double)(clock() - start) >= seconds*CLOCKS_PER_SEC; }

void model_place(model_solver *s, double k, double h, const double *x, const double *l, const signed char *index)
{
    memcpy(s->x, x, sizeof s->x);
#if RESTARTED
    memcpy(s->regime, begin_of(s), sizeof s->regime);
#endif
#if !ONE_STEP
#if CONSTANT
    if (s->h != h)
        s->newton.prepared = 0;
#endif
#endif
    s->h = h;
    s->t_0 = 0;
    s->steps = k;
#if LAW
    memcpy(s->l, l, sizeof s->l);
    memcpy(s->index, index, sizeof s->index);
#else
    (void)l;
    (void)index;
#endif
#if TOLERANCE_OF_NUMBER
    s->number = k;
#endif
}

long model_rollout(model_solver *s, double k, long steps, double last, long every, double seconds, const double *t,
                   const double *h, const double *inputs, double *rows, signed char *index, model_totals *totals)
{
    const clock_t start = clock();
    long row = 0, look = 1;
    totals->status = MODEL_OK;
#if !LAW
    (void)index;
#endif
#if !INPUTS
    (void)inputs;
#endif
    for (long i = 0; i < steps; i++) {
        if (i == look) {
            if (is_over(start, seconds))
                return i;
            look += look < LOOK ? look : LOOK;
        }
        if (t != NULL) {
            s->t_0 = t[i];
            s->steps = 0;
#if !ONE_STEP
#if CONSTANT
            if (s->h != h[i])
                s->newton.prepared = 0;
#endif
            s->h = h[i];
#else
            (void)h;
#endif
        }
#if INPUTS
        memcpy(begin_of(s), inputs + 2*MODEL_INPUTS*i, 2*MODEL_INPUTS*sizeof *inputs);
#if RESTARTED
        memcpy(s->regime, begin_of(s), sizeof s->regime); /* no block goes over a jump */
#endif
#endif
        int status = attempt(s);
        totals->status = status;
        if (status != MODEL_OK)
            return i;
        const double number = k + (double)(i + 1);
        int keep = every == 1 || fmod(number, (double)every) == 0 || number == last;
        if (keep) {
            write_row(s, rows + (long)@WIDTH@*row);
#if LAW
            keep_index(index, row, s->work.code);
#endif
            row++;
        }
#if LAW
        count_change(totals, s->index, s->work.code);
#endif
#if MONOTONE
        watch_monotone(totals, s);
#endif
        count(totals, s->work.residual, s->work.iterations, s->work.solver, number);
        commit(s);
    }
    return steps;
}

void model_fetch(const model_solver *s, double *x, double *l, signed char *index)
{
    memcpy(x, s->x, sizeof s->x);
#if LAW
    memcpy(l, s->l, sizeof s->l);
    memcpy(index, s->index, sizeof s->index);
#else
    (void)l;
    (void)index;
#endif
}

int model_single(model_solver *s, double k, double h, double *at, signed char *index)
{
    double *const l = at + sizeof s->x/sizeof *at;
    int same = 1;
    model_place(s, k, h, at, l, index);
    if (attempt(s) != MODEL_OK)
        return 0;
#if LAW
    write_row(s, l + MODEL_M);
    keep_index(index, 1, s->work.code);
    same = memcmp(index, index + MODEL_M, MODEL_M) == 0;
#else
    write_row(s, l);
#endif
    return 2*(int)s->work.solver + 1 + same;
}

#if RESTARTED
int model_restart(model_solver *s, double t, double *x)
{
    memcpy(s->x, x, sizeof s->x);
    s->t = t;
    s->spent = 0;
    const int status = renew_reaction(s);
    memcpy(x, s->x, sizeof s->x);
    return status;
}

#endif
long model_size(void) { return (long)sizeof(model_solver); }
