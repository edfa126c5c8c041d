/*
 * Many complementarity rows 0 <= l ⟂ y >= 0, few of which act. E_l and Y_z are kept sparse, and only the rows that act enter the
 * affine problem: those that the prediction violates, those whose y was 0, and then the ones that its solution violates.
 */

/* v = S l with S = E_z^{-1} E_l; 0 where E_z is singular. */
static void S_times(const model_solver *s, const double *l, double *restrict v)
{
    memset(v, 0, MODEL_N*sizeof *v);
    if (s->newton.prepared == SINGULAR)
        return;
    for (int j = 0; j < MODEL_M; j++)
        if (l[j] != 0)
            for (int k = E_l_start[j]; k < E_l_start[j + 1]; k++)
                v[E_l_row[k]] += s->newton.E_l[k]*l[j];
#if !IDENTITY
    lu_solve(MODEL_N, s->newton.lu, s->newton.pivot, v);
#endif
}

/* v = column j of S. */
static void S_column(const model_solver *s, int j, double *restrict v)
{
    memset(v, 0, MODEL_N*sizeof *v);
    if (s->newton.prepared == SINGULAR)
        return;
    for (int k = E_l_start[j]; k < E_l_start[j + 1]; k++)
        v[E_l_row[k]] = s->newton.E_l[k];
#if !IDENTITY
    lu_solve(MODEL_N, s->newton.lu, s->newton.pivot, v);
#endif
}

/* Row i of Y_z v. */
static double Y_z_times(const model_solver *s, int i, const double *v)
{
    double sum = 0;
    for (int k = Y_z_start[i]; k < Y_z_start[i + 1]; k++)
        sum += s->newton.Y_z[k]*v[Y_z_column[k]];
    return sum;
}

/* Row i of |Y_z| |v|. */
static double Y_z_size(const model_solver *s, int i, const double *v)
{
    double sum = 0;
    for (int k = Y_z_start[i]; k < Y_z_start[i + 1]; k++)
        sum += fabs(s->newton.Y_z[k]*v[Y_z_column[k]]);
    return sum;
}

/* sum = E_l l. */
static void E_l_times(const model_solver *s, const double *l, double *restrict sum)
{
    memset(sum, 0, MODEL_N*sizeof *sum);
    for (int j = 0; j < MODEL_M; j++)
        if (l[j] != 0)
            for (int k = E_l_start[j]; k < E_l_start[j + 1]; k++)
                sum[E_l_row[k]] += s->newton.E_l[k]*l[j];
}

#if TERMS
/* sum = |E_l| |l|. */
static void E_l_size(const model_solver *s, const double *l, double *restrict sum)
{
    memset(sum, 0, MODEL_N*sizeof *sum);
    for (int j = 0; j < MODEL_M; j++)
        if (l[j] != 0)
            for (int k = E_l_start[j]; k < E_l_start[j + 1]; k++)
                sum[E_l_row[k]] += fabs(s->newton.E_l[k]*l[j]);
}

#endif
/* Solve the affine problem on the rows that act: W = -Y_z S there. */
static int solve_acting(model_solver *s, int k)
{
    for (int j = 0; j < k; j++) {
        S_column(s, s->newton.rows[j], s->newton.v);
        for (int i = 0; i < k; i++)
            s->newton.W[k*i + j] = -Y_z_times(s, s->newton.rows[i], s->newton.v);
    }
    for (int i = 0; i < k; i++) {
        const int row = s->newton.rows[i];
        s->newton.b_rows[i] = s->newton.b[row];
        s->newton.l_rows[i] = s->work.l[row];
        s->newton.code[i] = s->work.code[row];
        s->newton.lower[i] = 0;
        s->newton.upper[i] = INFINITY;
    }
    return solve_affine(s, k, s->newton.W, s->newton.b_rows, s->newton.lower, s->newton.upper, s->newton.l_rows, s->newton.code);
}

/* Where a row stands: out of the affine problem, in it, or to enter it. */
enum { OUT, IN, WANTED };

/* Let the wanted rows in, those with the least y where there is no room for all, and list them. Return how many are in. */
static int choose_rows(model_solver *s, const double *y)
{
    signed char *place = s->newton.place;
    int k = 0, excess = -MODEL_ROWS;
    for (int i = 0; i < MODEL_M; i++)
        excess += place[i] != OUT;
    for (; excess > 0; excess--) {
        int last = -1;
        for (int i = 0; i < MODEL_M; i++)
            if (place[i] == WANTED && (last < 0 || y[i] > y[last]))
                last = i;
        place[last] = OUT;
    }
    for (int i = 0; i < MODEL_M; i++)
        if (place[i] != OUT) {
            place[i] = IN;
            s->newton.rows[k++] = i;
        }
    return k;
}

/* The l of y+ = W l+ + b, in newton.l, and its index set, in work.code. */
static int solve_rows(model_solver *s)
{
    const double *b = s->newton.b;
    double *l = s->newton.l, *v = s->newton.v, *y = s->newton.terms;
    signed char *place = s->newton.place;
    for (int i = 0; i < MODEL_M; i++) {
        place[i] = b[i] < 0 || s->work.code[i] == 0 ? WANTED : OUT;
        y[i] = b[i];
    }
    for (int pass = 0; pass <= MODEL_M; pass++) {
        const int k = choose_rows(s, y);
        const int solver = k > 0 ? solve_acting(s, k) : NONE_NEEDED;
        int violated = 0, acting = 0;
        if (solver == NONE)
            return NONE;
        memset(l, 0, MODEL_M*sizeof *l);
        for (int i = 0; i < k; i++) {
            l[s->newton.rows[i]] = s->newton.l_rows[i];
            acting += s->newton.code[i] == 0;
        }
        S_times(s, l, v);
        for (int i = 0; i < MODEL_M; i++) {
            y[i] = b[i] - Y_z_times(s, i, v);
            if (place[i] == OUT && y[i] < -SUM_ERROR*(MODEL_N + BESIDE)*EPS*(fabs(b[i]) + Y_z_size(s, i, v))) {
                place[i] = WANTED;
                violated++;
            }
        }
        if (violated == 0) {
            memset(s->work.code, -1, MODEL_M);
            for (int i = 0; i < k; i++)
                s->work.code[s->newton.rows[i]] = s->newton.code[i];
            return solver;
        }
        if (acting == MODEL_ROWS)
            return NONE;
        if (k + violated > MODEL_ROWS) /* rows that do not act make room: the solution does not need them */
            for (int i = 0; i < k; i++)
                if (s->newton.code[i] != 0)
                    place[s->newton.rows[i]] = OUT;
    }
    return NONE;
}

/* b, the terms |Y_z| |Z l| and w_max, by columns of W; w_max is 1 for a row that does not act. */
static void law_scales(model_solver *s)
{
    const double *l = s->work.l;
    double *v = s->newton.v;
    S_times(s, l, v);
    for (int i = 0; i < MODEL_M; i++) {
        s->newton.place[i] = l[i] != 0 || s->work.code[i] == 0 ? IN : OUT;
        s->newton.b[i] = s->newton.Y[i] + Y_z_times(s, i, v);
        s->newton.terms[i] = Y_z_size(s, i, v);
        s->newton.w_max[i] = s->newton.place[i] == IN ? 0 : 1;
    }
    for (int j = 0; j < MODEL_M; j++) {
        S_column(s, j, v);
        for (int i = 0; i < MODEL_M; i++)
            if (s->newton.place[i] == IN)
                s->newton.w_max[i] = worse_of(s->newton.w_max[i], fabs(Y_z_times(s, i, v)));
    }
}
