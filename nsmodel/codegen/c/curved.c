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

#if FRICTION
/* y = ŷ(y). */
static void shift_all(const model_solver *s, double *y)
{
    (void)s;
    for (int k = 0; k < MODEL_CURVED; k++)
        set_shift(&curved[k], NUMBERS(k), y + curved[k].start);
}

/* The natural map semismooth.F = l - P_K(u) with semismooth.u = l - c ŷ(W l + b); return |F|. */
#else
/* The natural map semismooth.F = l - P_K(u) with semismooth.u = l - c (W l + b); return |F|. */
#endif
static double natural_map(model_solver *s, const affine_problem *p, const double *l)
{
    affine_output(p, l, s->affine.y);
#if FRICTION
    for (int i = 0; i < p->m; i++)
        s->affine.y[i] += s->semismooth.added*l[i];
    if (!s->semismooth.associated)
        shift_all(s, s->affine.y);
#endif
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

#if FRICTION
/* The Jacobian I - P (I - c T W) of the natural map, P that of the projection at semismooth.u, T that of ŷ at affine.y. */
#else
/* The Jacobian I - P (I - c W) of the natural map, P that of the projection at semismooth.u. */
#endif
static void natural_jacobian(model_solver *s, const affine_problem *p)
{
    const int m = p->m;
    const double *u = s->semismooth.u, *c = s->semismooth.c;
    double *J = s->affine.block;
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++)
#if FRICTION
            J[i*m + j] = u[i] > p->lo[i] && u[i] < p->up[i] ? c[i]*(p->W[i*m + j] + (i == j ? s->semismooth.added : 0)) : i == j;
#else
            J[i*m + j] = u[i] > p->lo[i] && u[i] < p->up[i] ? c[i]*p->W[i*m + j] : i == j;
#endif
    for (int k = 0; k < MODEL_CURVED; k++) {
        const int start = curved[k].start, n = curved[k].size;
        double P[MODEL_BLOCK*MODEL_BLOCK];
        set_jacobian(&curved[k], NUMBERS(k), u + start, P);
#if FRICTION
        double T[MODEL_BLOCK*MODEL_BLOCK];
        set_shift_jacobian(&curved[k], NUMBERS(k), s->affine.y + start, T); /* which y_T alone decides: y may be ŷ */
        if (s->semismooth.associated)
            unit_matrix(n, T);
#endif
        for (int i = 0; i < n; i++)
            for (int j = 0; j < m; j++) {
                J[(start + i)*m + j] = start + i == j;
                for (int r = 0; r < n; r++) {
#if FRICTION
                    double moved = 0;
                    for (int q = 0; q < n; q++)
                        moved += T[r*n + q]*(p->W[(start + q)*m + j] + (start + q == j ? s->semismooth.added : 0));
#else
                    const double moved = p->W[(start + r)*m + j];
#endif
                    J[(start + i)*m + j] -= P[i*n + r]*((start + r == j) - c[start + r]*moved);
                }
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
#if FRICTION
    double W[MODEL_BLOCK*MODEL_BLOCK], b[MODEL_BLOCK], own[MODEL_BLOCK];
    for (int i = 0; i < n && k >= 0; i++) {
        b[i] = dot(p->m, p->W + (start + i)*p->m, l) + p->b[start + i];
        for (int j = 0; j < n; j++) {
            W[i*n + j] = p->W[(start + i)*p->m + start + j];
            b[i] -= W[i*n + j]*l[start + j];
        }
    }
    if (k >= 0 && !s->semismooth.associated && set_block_solution(&curved[k], NUMBERS(k), W, b, own)) {
        COPY(u + start, own, n);
    } else
#endif
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

/* affine.l: the l with the codes affine.code, its directions of slip and what else is curved as (l, affine.y) have them. Return 0,
   or 1 where that is not finite. */
static int solve_on_modes(model_solver *s, const affine_problem *p, const double *from)
{
    const int m = p->m;
    const signed char *code = s->affine.code;
    double *l = s->affine.l, *ray = s->semismooth.trial, *x = s->affine.x;
    int *row = s->affine.free, *width = s->semismooth.width, n = 0; /* the rows held, and of how many the column of each consists */
    for (int i = 0; i < m; i++) {
        l[i] = from[i];
        if (code[i] < 0)
            l[i] = is_finite(p->lo[i]) ? p->lo[i] : 0;
        else if (code[i] > 0 && is_finite(p->up[i]))
            l[i] = p->up[i];
        ray[i] = 1;
        width[i] = code[i] == 0;
    }
    for (int k = 0; k < MODEL_CURVED; k++) {
        const int start = curved[k].start;
#if FRICTION
        if (code[start] == 1 && set_boundary_ray(&curved[k], NUMBERS(k), from + start, s->affine.y + start, ray + start)) {
            width[start] = curved[k].size;
            continue;
        }
#endif
        if (code[start] == 1)
            set_onto_boundary(&curved[k], NUMBERS(k), l + start);
    }
    for (int i = 0; i < m; i++) {
        for (int r = 0; r < width[i]; r++)
            l[i + r] = 0;
        if (width[i])
            row[n++] = i;
    }
    for (int i = 0; i < n; i++) {
        x[i] = -(p->b[row[i]] + dot(m, p->W + row[i]*m, l));
        for (int j = 0; j < n; j++) {
            double sum = 0;
            for (int r = row[j]; r < row[j] + width[row[j]]; r++)
                sum += p->W[row[i]*m + r]*ray[r];
            s->affine.block[i*n + j] = sum;
        }
    }
    if (solve_or_least_squares(s, n, s->affine.block, x))
        return 1;
    for (int j = 0; j < n; j++)
        for (int r = row[j]; r < row[j] + width[row[j]]; r++)
            l[r] = x[j]*ray[r];
    return 0;
}

#if FRICTION
/* Whether the terms of W affine.l cancel beside b as far as rounding: then nothing is known of W l + b. */
static int is_lost(const model_solver *s, const affine_problem *p)
{
    double terms = 0;
    for (int i = 0; i < p->m; i++) {
        double sum = 0;
        for (int j = 0; j < p->m; j++)
            sum += fabs(p->W[i*p->m + j]*s->affine.l[j]);
        terms = worse_of(terms, sum);
    }
    return !(terms <= CANCELLED*largest(p->m, p->b));
}

/* Whether affine.l passes. */
static int passes_known(model_solver *s, const affine_problem *p, double accepted)
{
    return !is_lost(s, p) && passes(s, p, accepted);
}
#else
#define passes_known passes
#endif

/* Judge semismooth.l: polished on its index set, then as it is. Return whether one of them passes. */
static int passes_polished(model_solver *s, const affine_problem *p, double accepted)
{
    curved_index_set(s, p);
    affine_output(p, s->semismooth.l, s->affine.y);
    if (!solve_on_modes(s, p, s->semismooth.l) && passes_known(s, p, accepted))
        return 1;
    curved_index_set(s, p);
    COPY(s->affine.l, s->semismooth.l, p->m);
    return passes_known(s, p, accepted);
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

#if FRICTION
/* semismooth.l: the solution of the associated law, without ŷ: of a psd W a convex problem, which all that can stick solves by
   y = 0. What is found of it where it has none. */
static void solve_associated(model_solver *s, const affine_problem *p)
{
    double *l = s->semismooth.l;
    s->semismooth.associated = 1;
    for (int i = 0; i < p->m; i++)
        l[i] = 0;
    if (semismooth_newton(s, p)) {
        for (int i = 0; i < p->m; i++)
            l[i] = 0;
        gauss_seidel(s, p);
        COPY(s->semismooth.swept, l, p->m);
        if (semismooth_newton(s, p))
            COPY(l, s->semismooth.swept, p->m);
    }
    s->semismooth.associated = 0;
}
#if CONTACTS_IN_PLANE

/* Try all choices of modes, the first rows changing first: of a contact stick, open, slip either way. Return whether one passes. */
static int try_all_modes(model_solver *s, const affine_problem *p, double accepted)
{
    const int m = p->m;
    int *choice = s->semismooth.choice;
    double *from = s->semismooth.l, *y = s->affine.y;
    memset(choice, 0, sizeof s->semismooth.choice);
    for (int tried = 0, next = 0; next < m && tried < MAX_MODES && spend(s); tried++) {
        for (int i = 0, k = 0; i < m; i++) {
            from[i] = y[i] = 0;
            s->affine.code[i] = choice[i] == 0 ? 0 : choice[i] == 1 && is_finite(p->lo[i]) ? -1 : 1;
            if (k < MODEL_CURVED && i == curved[k].start) {
                s->affine.code[i] = s->affine.code[i + 1] = choice[i] == 0 ? 0 : choice[i] == 1 ? -1 : 1;
                from[i] = from[i + 1] = y[i] = 0;
                y[i + 1] = choice[i] == 2 ? 1 : -1;
                k++;
                i++;
            }
        }
        if (!solve_on_modes(s, p, from) && passes_known(s, p, accepted))
            return 1;
        for (next = 0; next < m; next++) { /* the next choice */
            int k = 0, most = is_finite(p->lo[next]) + is_finite(p->up[next]);
            while (k < MODEL_CURVED && curved[k].start < next)
                k++;
            const int contact = k < MODEL_CURVED && curved[k].start == next;
            most = contact ? 3 : most;
            if (choice[next] < most) {
                choice[next]++;
                break;
            }
            choice[next] = 0;
            next += contact;
        }
    }
    return 0;
}
#endif

/* Of several answers the first in a fixed order: the last modes, from the last multiplier, all that close stuck, from 0. */
static int solve_curved(model_solver *s, const affine_problem *p, const double *warm, const signed char *last, double accepted)
{
    block_scale(s, p);
    s->semismooth.added = 0;
    s->semismooth.associated = 0;
    COPY(s->affine.code, last, p->m);
    affine_output(p, warm, s->affine.y);
    if (spend(s) && !solve_on_modes(s, p, warm) && passes_known(s, p, accepted))
        return SEMISMOOTH;
    const int first = largest(p->m, warm) == 0; /* where it is 0 the last multiplier says nothing */
    for (int attempt = first; attempt < 5; attempt++) { /* the last two after sweeps */
        double *l = s->semismooth.l;
        for (int i = 0; i < p->m; i++)
            l[i] = attempt == 0 || attempt == 3 ? warm[i] : 0;
        if (attempt == 1)
            solve_associated(s, p);
        if (attempt > 2)
            gauss_seidel(s, p);
        if (attempt > 2)
            COPY(s->semismooth.swept, l, p->m);
        if (!semismooth_newton(s, p) && passes_polished(s, p, accepted))
            return SEMISMOOTH;
        if (attempt > 2) {
            COPY(l, s->semismooth.swept, p->m);
            if (passes_polished(s, p, accepted))
                return SEMISMOOTH;
        }
    }
    for (int i = 0; i < p->m; i++)
        s->semismooth.l[i] = 0;
    for (int decade = 0; decade <= REGULARISATIONS; decade++) { /* W + added I, the last time W itself */
        s->semismooth.added = decade < REGULARISATIONS ? pow(10, -decade)*largest(p->m*p->m, p->W) : 0;
        COPY(s->semismooth.swept, s->semismooth.l, p->m);
        if (semismooth_newton(s, p)) {
            if (decade == REGULARISATIONS)
                break;
            COPY(s->semismooth.l, s->semismooth.swept, p->m);
        } else if (decade == REGULARISATIONS && passes_polished(s, p, accepted))
            return SEMISMOOTH;
    }
    s->semismooth.added = 0;
#if CONTACTS_IN_PLANE
    if (try_all_modes(s, p, accepted))
        return SEMISMOOTH;
#endif
    return NONE;
}
#else
static int solve_curved(model_solver *s, const affine_problem *p, const double *warm, const signed char *last, double accepted)
{
    (void)last;
    block_scale(s, p);
    for (int attempt = 0; attempt < 4; attempt++) { /* from the last multiplier, then from 0; directly, then after sweeps */
        for (int i = 0; i < p->m; i++)
            s->semismooth.l[i] = attempt < 2 ? warm[i] : 0;
        if (attempt % 2)
            gauss_seidel(s, p);
        if (semismooth_newton(s, p))
            continue;
        if (passes_polished(s, p, accepted))
            return SEMISMOOTH;
        attempt |= 1; /* no sweeps where Newton's method has converged */
    }
    return NONE;
}
#endif
