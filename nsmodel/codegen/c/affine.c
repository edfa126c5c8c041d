/*
 * y = W l + b, -y ∈ N_K(l): a chain of solvers, each answer polished on its index set and judged by the law's residual.
 *
 * Codes of an index set: 0 where y_i = 0, -1 where l_i = lower_i, +1 where l_i = upper_i; the rows of a curved set share one.
 */

typedef struct {
    int m;
    const double *W, *b, *lo, *up;
} affine_problem;

#if CURVED

/* Whether a problem has the curved blocks. */
#if SELECTION_CURVED
#define HAS_BLOCKS(m, lo) (curved[0].start < (m) && !is_finite((lo)[curved[0].start])) /* all other problems have l >= 0 */
#else
#define HAS_BLOCKS(m, lo) ((lo) == LOWER)
#endif
#endif

static double clip(double u, double lo, double up)
{
    return u < lo ? lo : u > up ? up : u;
}

static void affine_output(const affine_problem *p, const double *l, double *y)
{
    for (int i = 0; i < p->m; i++)
        y[i] = dot(p->m, p->W + i*p->m, l) + p->b[i];
}

/* c_i = 1 / max_j |W_ij| makes l and c y comparable; 1 for a row of zeros. */
static double row_scale(const affine_problem *p, int i)
{
    const double w = largest(p->m, p->W + i*p->m);
    return w > 0 ? 1/w : 1;
}

/* ------------------------------------------------------------------ the law's residual */

/* s_y from b, the terms of W l, and w_max_i = max_j |W_ij|. */
static void output_scale(int m, const double *b, const double *terms, const double *w_max, double *s_y)
{
    double most = 0;
    for (int i = 0; i < m; i++)
        if (w_max[i] > 0)
            most = worse_of(most, fabs(b[i])/sqrt(w_max[i]));
    for (int i = 0; i < m; i++) {
        const double size = fabs(b[i]);
        s_y[i] = w_max[i] > 0 ? min_of(size + terms[i], max_of(GROWTH*sqrt(w_max[i])*most, size)) : size;
    }
}

/* a / s with 0/0 = 0, infinite where it is not a number, or s is not finite: that excuses nothing. */
static double ratio(double a, double s)
{
    const double r = a == 0 ? 0 : s < INFINITY ? a/s : INFINITY;
    return r < INFINITY ? r : INFINITY;
}

/* The residual of one row of a box. */
static double row_residual(double lo, double up, double l, double y, double s_y, double s_l)
{
    return @ROW_RESIDUAL@;
}
#if CURVED

/* |l - P_K(l - c ŷ)| / (c s_y), ŷ = y where the law is a normal cone, of a block whose rows begin at l: by Minty
   (P_K(u), (P_K(u) - u)/c), u = l - c ŷ, is a point of the graph, c = min(s_l / s_y, 1 / w). */
static double block_residual(const curved_block *k, const double *numbers, const double *l, const double *y,
                             const double *s_y, const double *s_l, const double *w_max)
{
    const double w = largest(k->size, w_max), of_l = largest(k->size, s_l);
    double u[MODEL_BLOCK], nearest[MODEL_BLOCK], c = w > 0 ? 1/w : 1, of_y = 0, distance = 0;
    for (int i = 0; i < k->size; i++)
        of_y = hypot(of_y, max_of(s_y[i], UNRESOLVED));
    if (of_l > UNRESOLVED*of_y)
        c = min_of(c, of_l/of_y);
#if FRICTION
    double shifted[MODEL_BLOCK];
    COPY(shifted, y, k->size);
    set_shift(k, numbers, shifted);
    if (shifted[0] != y[0]) /* mu |y_T| may hide y_N: 0 <= l_N ⟂ y_N >= 0, and nothing rubs where y_N > 0 */
        distance = max_of(fabs(min_of(l[0], c*y[0])), min_of(norm(k->size, l), c*y[0]));
    y = shifted;
#endif
    int inside = 1;
    for (int i = 0; i < k->size; i++)
        u[i] = nearest[i] = l[i] - c*y[i];
    set_project(k, numbers, nearest);
    for (int i = 0; i < k->size; i++)
        inside = inside && nearest[i] == u[i];
    double off = 0;
    for (int i = 0; i < k->size; i++)
        off = hypot(off, inside ? c*y[i] : l[i] - nearest[i]);
    distance = max_of(distance, off);
    if (EPS*norm(k->size, l) > UNSEEN*(c*of_y)) /* y is lost in the rounding of l */
        distance = max_of(distance, EPS*norm(k->size, l));
    return ratio(distance, c*of_y);
}
#endif

/* The largest residual of the rows of (l, y), infinite where anything is not finite. s_y is the scale of y, its floor included;
   w_max_i = max_j |W_ij|. Where lo is the model's own LOWER, K is the model's own law. */
static double law_residual(model_solver *s, int m, const double *lo, const double *up, const double *l, const double *y,
                           const double *s_y, const double *w_max)
{
    double *s_l = s->affine.x, others = 0, worst = 0;
    for (int i = 0; i < m; i++) {
        if (!is_finite(l[i]) || !is_finite(y[i]) || !is_finite(w_max[i]) || !is_finite(s_y[i]))
            return INFINITY;
        others = worse_of(others, NEGLIGIBLE*(fabs(l[i])*sqrt(w_max[i])));
    }
    /* s_l: what moves y by s_y, but not above l itself, its bounds, and a small part of the other multipliers. */
    for (int i = 0; i < m; i++)
        s_l[i] = max_of(max_of(fabs(l[i]), is_finite(lo[i]) ? fabs(lo[i]) : 0), is_finite(up[i]) ? fabs(up[i]) : 0);
#if CURVED
    const int blocks = HAS_BLOCKS(m, lo) ? MODEL_CURVED : 0;
    for (int k = 0; k < blocks; k++) {
        const int start = curved[k].start, end = start + curved[k].size;
        double size = 0, least = INFINITY;
        for (int i = start; i < end; i++) {
            size = hypot(size, l[i]);
            if (w_max[i] > 0)
                least = min_of(least, w_max[i]);
        }
        const double radius = set_radius(&curved[k], NUMBERS(k));
        size = max_of(size, max_of(is_finite(radius) ? radius : 0, others/sqrt(least)));
        for (int i = start; i < end; i++)
            s_l[i] = size;
    }
#endif
    for (int i = 0; i < m; i++)
        if (w_max[i] > 0)
            s_l[i] = min_of(max_of(s_y[i], UNRESOLVED)/w_max[i], max_of(s_l[i], others/sqrt(w_max[i])));
#if CURVED
    int k = 0;
#endif
    for (int i = 0; i < m; i++) {
#if CURVED
        if (k < blocks && i == curved[k].start) {
            worst = worse_of(worst, block_residual(&curved[k], NUMBERS(k), l + i, y + i, s_y + i, s_l + i, w_max + i));
            i += curved[k++].size - 1;
            continue;
        }
#endif
        worst = worse_of(worst, row_residual(lo[i], up[i], l[i], y[i], max_of(s_y[i], UNRESOLVED), s_l[i]));
    }
    return worst;
}

/* Judge the answer in affine.l, affine.code and keep it if it is the best so far. Return whether it is good enough. */
static int passes(model_solver *s, const affine_problem *p, double accepted)
{
    for (int i = 0; i < p->m; i++) {
        s->affine.x[i] = 0;
        for (int j = 0; j < p->m; j++)
            s->affine.x[i] += fabs(p->W[i*p->m + j]*s->affine.l[j]);
    }
    affine_output(p, s->affine.l, s->affine.y);
    output_scale(p->m, p->b, s->affine.x, s->affine.w_max, s->affine.s_y);
    const double residual = law_residual(s, p->m, p->lo, p->up, s->affine.l, s->affine.y, s->affine.s_y, s->affine.w_max);
    if (residual < s->affine.residual) {
        s->affine.residual = residual;
        COPY(s->affine.best, s->affine.l, p->m);
        COPY(s->affine.best_code, s->affine.code, p->m);
    }
    return residual <= accepted;
}

/* Solve y = 0 on the rows coded 0, l given elsewhere: l with its free rows filled in. Return 0, or 1 where it is not finite. */
static int solve_free_rows(model_solver *s, const affine_problem *p, const signed char *code, double *l)
{
    const int m = p->m;
    int *row = s->affine.free, n = 0;
    for (int i = 0; i < m; i++)
        if (code[i] == 0) {
            row[n++] = i;
            l[i] = 0;
        }
    for (int i = 0; i < n; i++) {
        s->affine.x[i] = -(p->b[row[i]] + dot(m, p->W + row[i]*m, l));
        for (int j = 0; j < n; j++)
            s->affine.block[i*n + j] = p->W[row[i]*m + row[j]];
    }
    if (solve_or_least_squares(s, n, s->affine.block, s->affine.x))
        return 1;
    for (int i = 0; i < n; i++)
        l[row[i]] = s->affine.x[i];
    return 0;
}
#if BOX_PROBLEM

/* ------------------------------------------------------------------ index sets of a box */

/* Put affine.l on the index set affine.code. Return 0, or 1 where that has no solution (a bound that is infinite). */
static int solve_index_set(model_solver *s, const affine_problem *p)
{
    for (int i = 0; i < p->m; i++)
        if (s->affine.code[i]) {
            s->affine.l[i] = s->affine.code[i] < 0 ? p->lo[i] : p->up[i];
            if (!is_finite(s->affine.l[i]))
                return 1;
        }
    return solve_free_rows(s, p, s->affine.code, s->affine.l);
}

/* The index set that l suggests: -1 where l - c y <= lower, +1 where l - c y >= upper, else 0. */
static void classify(const affine_problem *p, const double *l, signed char *code)
{
    for (int i = 0; i < p->m; i++) {
        const double u = l[i] - row_scale(p, i)*(dot(p->m, p->W + i*p->m, l) + p->b[i]);
        code[i] = u <= p->lo[i] ? -1 : u >= p->up[i] ? 1 : 0;
    }
}

/* Solve and change the rows that contradict their code, from affine.code on, until none does: a set that comes back would do so
   for ever, and the sweeps run out. Return whether it settled. */
static int primal_dual(model_solver *s, const affine_problem *p)
{
    const double *l = s->affine.l;
    signed char *code = s->affine.code;
    for (int sweep = 0; sweep < PRIMAL_DUAL_SWEEPS; sweep++) {
        int settled = 1;
        if (solve_index_set(s, p))
            return 0;
        for (int i = 0; i < p->m; i++) {
            const double *W = p->W + i*p->m;
            double y = 0, size = 0;
            for (int j = 0; j < p->m; j++) {
                y += W[j]*l[j];
                size += fabs(W[j]*l[j]);
            }
            y += p->b[i];
            size += fabs(p->b[i]);
            if (code[i] != 0) {
                if (code[i]*y <= SUM_ERROR*EPS*size)
                    continue;
                code[i] = 0;
            } else if (fabs(l[i] - clip(l[i], p->lo[i], p->up[i])) > INSIDE*EPS*fabs(l[i])) {
                code[i] = l[i] < p->lo[i] ? -1 : 1;
            } else { /* a row that no l of those coded 0 holds goes to its end */
                if (fabs(y) <= POLISHED*size || !is_finite(y > 0 ? p->lo[i] : p->up[i]))
                    continue;
                code[i] = y > 0 ? -1 : 1;
            }
            settled = 0;
        }
        if (settled)
            return 1;
    }
    return 0;
}

#if PIVOTING
/* 0, or 1 where it finds no solution, which for psd W means that there is none; the solution is in lemke.l. See lemke.c. */
static int lemke(model_solver *s, const affine_problem *p);
#endif
#endif
#if INDEX_SETS

/* The codes a row may have, in order: choice 0, 1, 2. Return the first choice after ``choice`` other than ``last``, or 3. */
static const signed char codes[3] = {0, -1, 1};

static int next_choice(double lo, double up, int last, int choice)
{
    do
        choice++;
    while (choice < 3 && (codes[choice] == last || (choice == 1 && !is_finite(lo)) || (choice == 2 && !is_finite(up))));
    return choice;
}

/* Begin with the index set ``last`` (0 where its bound is infinite). Return whether the law is small enough to try all sets. */
static int first_index_set(model_solver *s, int m, const double *lo, const double *up, const signed char *last)
{
    double count = 1;
    s->sets.rows = s->sets.changes = 0;
    for (int i = 0; i < m; i++) {
        s->sets.last[i] = last[i] && is_finite(last[i] < 0 ? lo[i] : up[i]) ? last[i] : 0;
        const int choices = 1 + is_finite(lo[i]) + is_finite(up[i]);
        count *= choices;
        if (choices > 1)
            s->sets.row[s->sets.rows++] = i;
    }
    return count <= MOST_INDEX_SETS;
}

/* The index set that the enumeration stands at. */
static void this_index_set(const model_solver *s, int m, signed char *code)
{
    COPY(code, s->sets.last, m);
    for (int k = 0; k < s->sets.changes; k++)
        code[s->sets.row[s->sets.position[k]]] = codes[s->sets.choice[k]];
}

/* Let the rows from the k-th of those that differ on begin with their first other code. */
static void first_choices(model_solver *s, const double *lo, const double *up, int k)
{
    for (; k < s->sets.changes; k++) {
        const int i = s->sets.row[s->sets.position[k]];
        s->sets.choice[k] = (signed char)next_choice(lo[i], up[i], s->sets.last[i], -1);
    }
}

/* Go to the next index set, those nearest to ``last`` first. Return 0 where there are no more. */
static int next_index_set(model_solver *s, const double *lo, const double *up)
{
    int *position = s->sets.position, k = s->sets.changes;
    while (--k >= 0) { /* other codes on the same rows */
        const int i = s->sets.row[position[k]];
        s->sets.choice[k] = (signed char)next_choice(lo[i], up[i], s->sets.last[i], s->sets.choice[k]);
        if (s->sets.choice[k] < 3) {
            first_choices(s, lo, up, k + 1);
            return 1;
        }
    }
    k = s->sets.changes - 1; /* other rows */
    while (k >= 0 && position[k] == s->sets.rows - s->sets.changes + k)
        k--;
    if (k >= 0)
        position[k]++;
    else { /* more rows */
        if (s->sets.changes == s->sets.rows)
            return 0;
        s->sets.changes++;
        position[k = 0] = 0;
    }
    while (++k < s->sets.changes)
        position[k] = position[k - 1] + 1;
    first_choices(s, lo, up, 0);
    return 1;
}
#endif
#if BOX_PROBLEM

static int solve_box(model_solver *s, const affine_problem *p, const signed char *last, double accepted)
{
    COPY(s->affine.code, last, p->m);
    if (primal_dual(s, p) && passes(s, p, accepted))
        return INDEX_SET;
#if PIVOTING
    if (!lemke(s, p)) {
        classify(p, s->lemke.l, s->affine.code);
        if (!solve_index_set(s, p) && passes(s, p, accepted))
            return LEMKE;
        COPY(s->affine.l, s->lemke.l, p->m);
        if (passes(s, p, accepted))
            return LEMKE;
    }
#endif
#if ENUMERATION
    if (first_index_set(s, p->m, p->lo, p->up, last))
        do {
            this_index_set(s, p->m, s->affine.code);
            if (!solve_index_set(s, p) && passes(s, p, accepted))
                return ENUMERATION;
        } while (s->spent < s->budget && next_index_set(s, p->lo, p->up));
#endif
    return NONE;
}
#endif
#if CURVED

/* Solver of the law with curved sets, from the multiplier ``warm``, its codes and from 0. See curved.c. */
static int solve_curved(model_solver *s, const affine_problem *p, const double *warm, const signed char *last, double accepted);
#endif

/* Solve y = W l + b, -y ∈ N_[lo, up](l), from the last multiplier l and index set code; where lo is the model's own LOWER,
   K is the model's own law. Return the solver whose answer has a residual of at most ``accepted``, or NONE. l and code are the
   answer then, the best one found where none passed, and unchanged where none was finite; affine.residual is its residual. */
static int affine_solve(model_solver *s, int m, const double *W, const double *b, const double *lo, const double *up, double *l,
                        signed char *code, double accepted)
{
    const affine_problem problem = {m, W, b, lo, up};
    s->affine.residual = INFINITY;
    if (!all_finite(m*m, W) || !all_finite(m, b))
        return NONE;
    for (int i = 0; i < m; i++)
        s->affine.w_max[i] = largest(m, W + i*m);
#if CURVED
#if BOX_PROBLEM
    const int solver = HAS_BLOCKS(m, lo) ? solve_curved(s, &problem, l, code, accepted) : solve_box(s, &problem, code, accepted);
#else
    const int solver = solve_curved(s, &problem, l, code, accepted);
#endif
#else
    const int solver = solve_box(s, &problem, code, accepted);
#endif
    if (s->affine.residual < INFINITY) {
        COPY(l, s->affine.best, m);
        COPY(code, s->affine.best_code, m);
        for (int i = 0; i < m; i++)
            if (code[i] == 0 && lo[i] == up[i]) { /* no width: y is not held at 0 */
                code[i] = dot(m, W + i*m, l) + b[i] < 0 ? 1 : -1;
                l[i] = lo[i];
            }
    }
    return solver;
}
