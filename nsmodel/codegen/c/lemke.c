/*
 * Lemke's complementary pivoting.
 *
 * One-sided rows are shifted to 0 <= l' ⟂ y' >= 0; an upper bound beside a lower one adds a slack row; a free row is split in
 * two. For psd W the method ends with a solution or proves that there is none (Cottle, Pang and Stone, Theorem 4.4.12); where
 * round-off makes a ray of a singular W of about 1, W + REGULARISED I suggests the index set.
 *
 * Variables of the pivoting, size = lemke.size: w (0..size-1), z (size..2 size-1), z0 (2 size) of w - M z - z0 = q.
 */

/* The problem in units in which the entries of W and b are about 1: l = scale l' (Ruiz' iteration). Return 0, or 1 where it has
   no such units. */
static int equilibrate(model_solver *s, const affine_problem *p)
{
    const int m = p->m;
    double *scale = s->lemke.scale, *W = s->affine.block, size = 0;
    for (int i = 0; i < m; i++)
        scale[i] = 1;
    for (int sweep = 0; sweep <= EQUILIBRATIONS; sweep++) {
        for (int i = 0; i < m; i++)
            for (int j = 0; j < m; j++)
                W[i*m + j] = scale[i]*p->W[i*m + j]*scale[j];
        for (int i = 0; i < m && sweep < EQUILIBRATIONS; i++) {
            double most = largest(m, W + i*m);
            for (int j = 0; j < m; j++)
                most = worse_of(most, fabs(W[j*m + i]));
            if (most > 0)
                scale[i] /= sqrt(most);
        }
    }
    for (int i = 0; i < m; i++)
        size = worse_of(size, fabs(scale[i]*p->b[i]));
    if (size == 0)
        size = 1;
    for (int i = 0; i < m*m; i++)
        if (fabs(W[i]) < NOUGHT*EPS)
            W[i] = 0; /* A pivot on round-off would be a solution at infinity. */
    for (int i = 0; i < m; i++) {
        s->lemke.b[i] = scale[i]*p->b[i]/size;
        scale[i] *= size;
        s->lemke.lower[i] = p->lo[i]/scale[i];
        s->lemke.upper[i] = p->up[i]/scale[i];
    }
    return !all_finite(m*m, W) || !all_finite(m, s->lemke.b) || !all_finite(m, scale);
}

/* l' = offset + the sum of sign z over the columns: every row once, free rows a second time with the other sign, then a slack
   for every row with two bounds. Return 0, or 1 where there is no room for them. */
static int standard_form(model_solver *s, const affine_problem *p)
{
    const int m = p->m;
    int n = m;
    for (int i = 0; i < m; i++) {
        const int has_lo = is_finite(p->lo[i]), has_up = is_finite(p->up[i]);
        s->lemke.offset[i] = has_lo ? p->lo[i] : has_up ? p->up[i] : 0;
        s->lemke.column[i] = i;
        s->lemke.sign[i] = has_lo || !has_up ? 1 : -1;
        if (!has_lo && !has_up) {
            if (n == MODEL_LEMKE)
                return 1;
            s->lemke.column[n] = i;
            s->lemke.sign[n++] = -1;
        }
    }
    for (int i = 0; i < n; i++) {
        const int row = s->lemke.column[i];
        s->lemke.q[i] = s->lemke.sign[i]*(p->b[row] + dot(m, p->W + row*m, s->lemke.offset));
    }
    s->lemke.n = s->lemke.size = n;
    for (int i = 0; i < m; i++)
        if (is_finite(p->lo[i]) && is_finite(p->up[i])) {
            if (s->lemke.size == MODEL_LEMKE)
                return 1;
            s->lemke.column[s->lemke.size] = i;
            s->lemke.q[s->lemke.size++] = p->up[i] - p->lo[i];
        }
    return 0;
}

/* The coefficient of a variable in row i of w - M z - z0 = q. */
static double coefficient(const model_solver *s, int m, int i, int variable)
{
    const int n = s->lemke.n, size = s->lemke.size, *column = s->lemke.column;
    if (variable < size)
        return i == variable;
    if (variable == 2*size)
        return -1;
    const int j = variable - size;
    const double regular = i == j ? s->lemke.regular : 0;
    if (i < n && j < n)
        return -s->lemke.sign[i]*s->affine.block[column[i]*m + column[j]]*s->lemke.sign[j] - regular;
    if (i < n)
        return -(column[j] == i);
    return j < n ? column[i] == j : -regular;
}

/* The lexicographically least of the ``count`` rows listed in lemke.rows of the table (value, inverse) / entering. */
static int least_row(model_solver *s, int count)
{
    const int size = s->lemke.size;
    int *rows = s->lemke.rows;
    for (int column = 0; column <= size && count > 1; column++) {
        double *table = s->linear.x, least = INFINITY, most = 0;
        for (int k = 0; k < count; k++) {
            const int i = rows[k];
            table[k] = (column ? s->linear.v[i*size + column - 1] : s->lemke.value[i])/s->lemke.entering[i];
            least = min_of(least, table[k]);
            most = worse_of(most, fabs(table[k]));
        }
        int kept = 0;
        for (int k = 0; k < count; k++)
            if (table[k] <= least + TIED*most)
                rows[kept++] = rows[k];
        if (kept == 0)
            break;
        count = kept;
    }
    return rows[0];
}

/* Choose the row that leaves the basis when a variable enters; z0 where it can. Return -1 where the variable is unbounded. */
static int leaving_row(model_solver *s, int m, int variable)
{
    const int size = s->lemke.size;
    double *a = s->linear.x, *noise = s->linear.rhs, most = 0, least = INFINITY, most_step = 0;
    int count = 0, artificial = -1;
    for (int i = 0; i < size; i++)
        a[i] = coefficient(s, m, i, variable);
    for (int i = 0; i < size; i++) {
        s->lemke.entering[i] = dot(size, s->linear.v + i*size, a);
        most = worse_of(most, fabs(s->lemke.entering[i]));
        noise[i] = 0;
        for (int j = 0; j < size; j++)
            noise[i] += PIVOT_ERROR*EPS*fabs(s->linear.v[i*size + j]*a[j]);
    }
    for (int i = 0; i < size; i++)
        if (s->lemke.entering[i] > max_of(noise[i], LEAST_PIVOT*most)) {
            const double step = s->lemke.value[i]/s->lemke.entering[i];
            s->lemke.rows[count++] = i;
            least = min_of(least, step);
            most_step = worse_of(most_step, fabs(step));
            if (s->lemke.basis[i] == 2*size)
                artificial = i;
        }
    if (artificial >= 0 && s->lemke.value[artificial]/s->lemke.entering[artificial] <= least + PREFERRED*most_step)
        return artificial;
    return count ? least_row(s, count) : -1;
}

/* Solve 0 <= z ⟂ M z + q >= 0: the values of the basic variables in lemke.value. Return 0, or 1 where it ends in a ray.

   The basis is factored afresh at every pivot, so that round-off does not grow, and ties are broken lexicographically, so that
   degenerate problems do not cycle. */
static int pivot_to_solution(model_solver *s, int m)
{
    const int size = s->lemke.size, pivots = PIVOTS_EACH*size + PIVOTS_MORE;
    int *basis = s->lemke.basis, satisfied = 1, variable = 2*size;
    for (int i = 0; i < size; i++) {
        basis[i] = s->lemke.rows[i] = i;
        s->lemke.value[i] = s->lemke.q[i];
        s->lemke.entering[i] = 1;
        satisfied &= s->lemke.q[i] >= 0;
        for (int j = 0; j < size; j++)
            s->linear.v[i*size + j] = i == j;
    }
    if (satisfied)
        return 0;
    int row = least_row(s, size);
    for (int count = 0; count < pivots && row >= 0 && spend(s); count++) {
        const int leaving = basis[row];
        double z0 = 0;
        basis[row] = variable;
        for (int i = 0; i < size; i++)
            for (int j = 0; j < size; j++)
                s->linear.lu[i*size + j] = coefficient(s, m, i, basis[j]);
        if (lu_factor(size, s->linear.lu, s->linear.pivot))
            return 1;
        lu_inverse(s, size, s->linear.v);
        for (int i = 0; i < size; i++) {
            s->lemke.value[i] = dot(size, s->linear.v + i*size, s->lemke.q);
            if (basis[i] == 2*size)
                z0 = s->lemke.value[i];
        }
        if (z0 <= GONE*largest(size, s->lemke.q))
            return 0;
        variable = leaving < size ? leaving + size : leaving - size;
        row = leaving_row(s, m, variable);
    }
    return 1;
}

/* The solution on the index set of lemke.l, if it is one: what a regularised problem suggests is not believed otherwise. */
static int polish_regularised(model_solver *s, const affine_problem *p)
{
    const int m = p->m;
    const signed char *code = s->affine.code;
    int *row = s->affine.free, n = 0;
    double *exact = s->lemke.offset, wrong = 0, outside = 0;
    classify(p, s->lemke.l, s->affine.code);
    for (int i = 0; i < m; i++) {
        exact[i] = code[i] == 0 ? 0 : code[i] < 0 ? p->lo[i] : p->up[i];
        if (code[i] == 0)
            row[n++] = i;
    }
    for (int i = 0; i < n; i++) {
        s->affine.x[i] = -(p->b[row[i]] + dot(m, p->W + row[i]*m, exact));
        for (int j = 0; j < n; j++)
            s->linear.lu[i*n + j] = p->W[row[i]*m + row[j]];
    }
    if (!spend(s) || least_squares(s, n, RANK, s->affine.x)) /* W may be singular: the regularised solution tends to that of least norm */
        return 1;
    for (int i = 0; i < n; i++)
        exact[row[i]] = s->affine.x[i];
    affine_output(p, exact, s->affine.y);
    if (!all_finite(m, exact) || !all_finite(m, s->affine.y))
        return 1;
    for (int i = 0; i < m; i++) {
        wrong = worse_of(wrong, code[i] == 0 ? fabs(s->affine.y[i]) : code[i]*s->affine.y[i]);
        outside = worse_of(outside, max_of(p->lo[i] - exact[i], exact[i] - p->up[i]));
        s->lemke.l[i] = clip(exact[i], p->lo[i], p->up[i]);
    }
    return !(wrong <= POLISHED*largest(m, p->b) && outside <= POLISHED*largest(m, exact));
}

static int lemke(model_solver *s, const affine_problem *p)
{
    const affine_problem scaled = {p->m, s->affine.block, s->lemke.b, s->lemke.lower, s->lemke.upper};
    if (equilibrate(s, p))
        return 1;
    for (int regularised = 0; regularised < 2; regularised++) {
        s->lemke.regular = regularised ? REGULARISED : 0;
        if (standard_form(s, &scaled) || pivot_to_solution(s, p->m))
            continue;
        COPY(s->lemke.l, s->lemke.offset, p->m);
        for (int i = 0; i < s->lemke.size; i++) {
            const int j = s->lemke.basis[i] - s->lemke.size;
            if (0 <= j && j < s->lemke.n)
                s->lemke.l[s->lemke.column[j]] += s->lemke.sign[j]*worse_of(s->lemke.value[i], 0);
        }
        for (int i = 0; i < p->m; i++)
            s->lemke.l[i] = clip(s->lemke.l[i], scaled.lo[i], scaled.up[i]);
        if (regularised && polish_regularised(s, &scaled))
            continue;
        for (int i = 0; i < p->m; i++)
            s->lemke.l[i] *= s->lemke.scale[i];
        return 0;
    }
    return 1;
}
