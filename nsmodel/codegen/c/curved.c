/*
 * y = W l + b, -y ∈ N_K(l) where K has curved sets: semismooth Newton, with block Gauss-Seidel behind it.
 */


/* u = P_K(u). */
static void project_all(const model_solver *s, const affine_problem *p, double *u)
{
    (void)s; /* it has the numbers of the sets where parameters give them */
    for (int i = 0; i < p->m; i++)
        u[i] = clip(u[i], p->lo[i], p->up[i]);
    for (int k = 0; k < MODEL_CURVED; k++)
        set_project(&curved[k], NUMBERS(k), u + curved[k].start);
}

/* The natural map semismooth.F = l - P_K(u) with semismooth.u = l - c (W l + b); return |F|. */
static double natural_map(model_solver *s, const affine_problem *p, const double *l)
{
    affine_output(p, l, s->affine.y);
    for (int i = 0; i < p->m; i++)
        s->semismooth.F[i] = s->semismooth.u[i] = l[i] - s->semismooth.c[i]*s->affine.y[i];
    project_all(s, p, s->semismooth.F);
    for (int i = 0; i < p->m; i++)
        s->semismooth.F[i] = l[i] - s->semismooth.F[i];
    return norm(p->m, s->semismooth.F);
}

/* The largest part of semismooth.F beside what it consists of: |l|, c |W| |l|, and the radius of a bounded set, or c |b| for other
   rows, which at a bound have F = 0. A row far from its bound, or a ball that slides fast, says nothing about the others. */
static double relative_map(const model_solver *s, const affine_problem *p, const double *l)
{
    double worst = 0;
    for (int i = 0, k = 0; i < p->m;) {
        const int in_block = k < MODEL_CURVED && i == curved[k].start, end = in_block ? i + curved[k].size : i + 1;
        const double radius = in_block ? set_radius(&curved[k], NUMBERS(k)) : INFINITY;
        double size = 0, scale = 0;
        for (; i < end; i++) {
            double terms = is_finite(radius) ? radius : s->semismooth.c[i]*fabs(p->b[i]);
            for (int j = 0; j < p->m; j++)
                terms += s->semismooth.c[i]*fabs(p->W[i*p->m + j]*l[j]);
            scale = worse_of(scale, terms + fabs(l[i]));
            size = worse_of(size, fabs(s->semismooth.F[i]));
        }
        worst = worse_of(worst, ratio(size, scale));
        k += in_block;
    }
    return worst;
}

/* The Jacobian I - P (I - c W) of the natural map, P that of the projection at semismooth.u. */
static void natural_jacobian(model_solver *s, const affine_problem *p)
{
    const int m = p->m;
    const double *u = s->semismooth.u, *c = s->semismooth.c;
    double *J = s->affine.block;
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++)
            J[i*m + j] = u[i] > p->lo[i] && u[i] < p->up[i] ? c[i]*p->W[i*m + j] : i == j;
    for (int k = 0; k < MODEL_CURVED; k++) {
        const int start = curved[k].start, n = curved[k].size;
        double P[MODEL_BLOCK*MODEL_BLOCK];
        set_jacobian(&curved[k], NUMBERS(k), u + start, P);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < m; j++) {
                J[(start + i)*m + j] = start + i == j;
                for (int r = 0; r < n; r++)
                    J[(start + i)*m + j] -= P[i*n + r]*((start + r == j) - c[start + r]*p->W[(start + r)*m + j]);
            }
    }
}

/* Solve l = P_K(l - c (W l + b)) from semismooth.l, in place. Return 0, or 1 where it does not converge. */
static int semismooth_newton(model_solver *s, const affine_problem *p)
{
    const int m = p->m;
    double *l = s->semismooth.l, *trial = s->semismooth.trial, best = INFINITY;
    project_all(s, p, l);
    double size = natural_map(s, p, l);
    for (int iteration = 0; iteration < SEMISMOOTH_ITERATIONS; iteration++) {
        const double relative = relative_map(s, p, l);
        if (relative <= SUM_ERROR*EPS || (relative <= CONVERGED && relative >= best/2))
            return 0;
        best = min_of(best, relative);
        natural_jacobian(s, p);
        for (int i = 0; i < m; i++)
            s->semismooth.step[i] = -s->semismooth.F[i];
        if (solve_or_least_squares(s, m, s->affine.block, s->semismooth.step))
            return 1;
        for (double t = 1;; t /= 2) {
            for (int i = 0; i < m; i++)
                trial[i] = l[i] + t*s->semismooth.step[i];
            const double now = natural_map(s, p, trial);
            if (!(now > (1 - ARMIJO*t)*size) || t <= LEAST_STEP) {
                size = now;
                break;
            }
        }
        COPY(l, trial, m);
    }
    return !(relative_map(s, p, l) <= ACCEPTED);
}

/* 1 / |W_kk| for the diagonal block of n rows from ``start``, in the spectral norm. */
static double inverse_norm(model_solver *s, const affine_problem *p, int start, int n)
{
    for (int i = 0; i < n; i++)
        COPY(s->linear.lu + i*n, p->W + (start + i)*p->m + start, n);
    double unit;
    const double most = decompose(s, n, &unit);
    return 1/max_of(sqrt(most)*unit, DBL_MIN);
}

/* One projected gradient step of n rows from ``start``, in semismooth.l: those of the curved block k, or a row of a box where k < 0.
   Return the largest change. */
static double relax(model_solver *s, const affine_problem *p, int k, int start, int n)
{
    double *u = s->semismooth.u, *l = s->semismooth.l, change = 0;
    for (int i = start; i < start + n; i++)
        u[i] = l[i] - s->semismooth.step[start]*(dot(p->m, p->W + i*p->m, l) + p->b[i]);
    if (k >= 0)
        set_project(&curved[k], NUMBERS(k), u + start);
    else
        u[start] = clip(u[start], p->lo[start], p->up[start]);
    for (int i = start; i < start + n; i++) {
        change = worse_of(change, fabs(u[i] - l[i]));
        l[i] = u[i];
    }
    return change;
}

/* Projected block gradient sweeps on semismooth.l: slow, but convergent for symmetric psd W. Gives Newton a start near the solution. */
static void gauss_seidel(model_solver *s, const affine_problem *p)
{
    project_all(s, p, s->semismooth.l);
    for (int i = 0; i < p->m; i++)
        s->semismooth.step[i] = inverse_norm(s, p, i, 1);
    for (int k = 0; k < MODEL_CURVED; k++)
        s->semismooth.step[curved[k].start] = inverse_norm(s, p, curved[k].start, curved[k].size);
    for (int sweep = 0; sweep < GAUSS_SEIDEL_SWEEPS && spend(s); sweep++) {
        double change = 0;
        for (int k = 0; k < MODEL_CURVED; k++)
            change = worse_of(change, relax(s, p, k, curved[k].start, curved[k].size));
        for (int i = 0, k = 0; i < p->m; i++)
            if (k < MODEL_CURVED && i == curved[k].start)
                i += curved[k++].size - 1;
            else
                change = worse_of(change, relax(s, p, -1, i, 1));
        if (!(change > SWEPT*largest(p->m, s->semismooth.l)))
            break;
    }
}

/* Codes of semismooth.l: 0 where y = 0, -1 where l = 0 (cone), +1 on the curved boundary; the rows of a block share one. */
static void curved_index_set(model_solver *s, const affine_problem *p)
{
    const double *u = s->semismooth.u;
    natural_map(s, p, s->semismooth.l);
    for (int i = 0; i < p->m; i++)
        s->affine.code[i] = u[i] <= p->lo[i] ? -1 : u[i] >= p->up[i] ? 1 : 0;
    for (int k = 0; k < MODEL_CURVED; k++) {
        const int start = curved[k].start;
        memset(s->affine.code + start, set_code(&curved[k], NUMBERS(k), u + start), (size_t)curved[k].size);
    }
}

/* Polish semismooth.l into affine.l: keep the curved rows' smooth branch, put l = 0 and l = bound exactly where the index set says
   so. Return 0, or 1 where that is not finite. */
static int exact_zeros(model_solver *s, const affine_problem *p)
{
    const signed char *code = s->affine.code;
    double *l = s->affine.l;
    for (int i = 0; i < p->m; i++) {
        l[i] = s->semismooth.l[i];
        if (code[i] < 0)
            l[i] = is_finite(p->lo[i]) ? p->lo[i] : 0;
        else if (code[i] > 0 && is_finite(p->up[i]))
            l[i] = p->up[i];
    }
    for (int k = 0; k < MODEL_CURVED; k++)
        if (code[curved[k].start] == 1)
            set_onto_boundary(&curved[k], NUMBERS(k), l + curved[k].start);
    return solve_free_rows(s, p, code, l);
}

/* The factor c of the natural map, equal within a block. */
static void block_scale(model_solver *s, const affine_problem *p)
{
    for (int i = 0; i < p->m; i++)
        s->semismooth.c[i] = row_scale(p, i);
    for (int k = 0; k < MODEL_CURVED; k++) {
        double *c = s->semismooth.c + curved[k].start, least = INFINITY;
        for (int i = 0; i < curved[k].size; i++)
            least = min_of(least, c[i]);
        for (int i = 0; i < curved[k].size; i++)
            c[i] = least;
    }
}

static int solve_curved(model_solver *s, const affine_problem *p, const double *warm, double accepted)
{
    block_scale(s, p);
    for (int attempt = 0; attempt < 4; attempt++) { /* from the last multiplier, then from 0; directly, then after sweeps */
        for (int i = 0; i < p->m; i++)
            s->semismooth.l[i] = attempt < 2 ? warm[i] : 0;
        if (attempt % 2)
            gauss_seidel(s, p);
        if (semismooth_newton(s, p))
            continue;
        curved_index_set(s, p);
        if (!exact_zeros(s, p) && passes(s, p, accepted))
            return SEMISMOOTH;
        COPY(s->affine.l, s->semismooth.l, p->m);
        if (passes(s, p, accepted))
            return SEMISMOOTH;
        attempt |= 1; /* no sweeps where Newton's method has converged */
    }
    return NONE;
}
