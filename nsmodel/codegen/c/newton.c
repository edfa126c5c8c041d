/*
 * Newton's linearisation in (z, l): E_z dz + E_l dl + E = 0 gives dz = dz_0 - S dl with dz_0 = -E_z^{-1} E, S = E_z^{-1} E_l, and
 * y+ = W l+ + b with W = Y_l - Y_z S, b = Y + Y_z (dz_0 + S l) - Y_l l: an affine problem in l for each iterate.
 */

#if AFFINE
#define ITERATIONS AFFINE_ITERATIONS
#else
#define ITERATIONS NEWTON_ITERATIONS
#endif

/* What is known of the matrices: nothing, their entries, or also whether E_z has an inverse. */
enum { UNKNOWN, READ, REGULAR, SINGULAR };
#if ROWS

/* See rows.c. */
static void S_times(const model_solver *s, const double *l, double *restrict v);
static void E_l_times(const model_solver *s, const double *l, double *restrict sum);
#if TERMS
static void E_l_size(const model_solver *s, const double *l, double *restrict sum);
#endif
static double Y_z_times(const model_solver *s, int i, const double *v);
static double Y_z_size(const model_solver *s, int i, const double *v);
static int solve_rows(model_solver *s);
static void law_scales(model_solver *s);
#endif

/* ------------------------------------------------------------------ the linearisation */

/* The Jacobians, and where they are not constant E and Y, at (z, l); 0 where an entry of a matrix is not finite. */
static int read_matrices(model_solver *s)
{
#if AFFINE
    matrices(s@MATRICES@);
#else
#if LAW
    linearise(s, s->work.z, s->work.l, s->newton.E, s->newton.Y@MATRICES@);
#else
    linearise(s, s->work.z, s->newton.E@MATRICES@);
#endif
#if EXPLICIT
    for (int i = 0; i < MODEL_EXPLICIT; i++)
        s->work.z[explicit_column[i]] = s->newton.given[i];
#endif
#endif
#if TRANSPOSED
#if ROWS
    for (int k = 0; k < MODEL_Y_Z; k++)
        s->newton.E_l[k] = -s->newton.Y_z[k];
#else
    for (int i = 0; i < MODEL_M; i++)
        for (int j = 0; j < MODEL_N; j++)
            s->newton.E_l[MODEL_M*j + i] = -s->newton.Y_z[MODEL_N*i + j];
#endif
#endif
#if LAW
#if FEEDTHROUGH
    if (!all_finite(MODEL_M*MODEL_M, s->newton.Y_l))
        return 0;
#endif
#if ROWS
    if (!all_finite(MODEL_E_L, s->newton.E_l) || !all_finite(MODEL_Y_Z, s->newton.Y_z))
        return 0;
#else
    if (!all_finite(MODEL_N*MODEL_M, s->newton.E_l) || !all_finite(MODEL_M*MODEL_N, s->newton.Y_z))
        return 0;
#endif
#endif
#if !IDENTITY
    if (!all_finite(MODEL_N*MODEL_N, s->newton.E_z))
        return 0;
#endif
    s->newton.prepared = READ;
    return 1;
}

#if LAW
#if !ROWS

/* v = S l. */
static void S_times(const model_solver *s, const double *l, double *restrict v)
{
#if IDENTITY
    const double *S = s->newton.E_l;
#else
    const double *S = s->newton.S;
#endif
    for (int i = 0; i < MODEL_N; i++) {
        v[i] = 0;
        for (int j = 0; j < MODEL_M; j++)
            v[i] += S[MODEL_M*i + j]*l[j];
    }
}

/* Row i of Y_z v. */
static double Y_z_times(const model_solver *s, int i, const double *v)
{
    double sum = 0;
    for (int k = 0; k < MODEL_N; k++)
        sum += s->newton.Y_z[MODEL_N*i + k]*v[k];
    return sum;
}

/* Row i of |Y_z| |v|. */
static double Y_z_size(const model_solver *s, int i, const double *v)
{
    double sum = 0;
    for (int k = 0; k < MODEL_N; k++)
        sum += fabs(s->newton.Y_z[MODEL_N*i + k]*v[k]);
    return sum;
}

/* sum = E_l l. */
static void E_l_times(const model_solver *s, const double *l, double *restrict sum)
{
    for (int i = 0; i < MODEL_N; i++)
        sum[i] = dot(MODEL_M, s->newton.E_l + MODEL_M*i, l);
}
#if TERMS

/* sum = |E_l| |l|. */
static void E_l_size(const model_solver *s, const double *l, double *restrict sum)
{
    for (int i = 0; i < MODEL_N; i++) {
        sum[i] = 0;
        for (int j = 0; j < MODEL_M; j++)
            sum[i] += fabs(s->newton.E_l[MODEL_M*i + j]*l[j]);
    }
}
#endif
#if !IDENTITY

/* Solve E_z S = E_l with the factors of E_z, all columns at once. */
static void solve_columns(model_solver *s)
{
    const double *lu = s->newton.lu;
    double *S = s->newton.S;
    memcpy(S, s->newton.E_l, sizeof s->newton.S);
    for (int k = 0; k < MODEL_N; k++) {
        const int p = s->newton.pivot[k];
        if (p != k)
            for (int j = 0; j < MODEL_M; j++) {
                const double held = S[MODEL_M*k + j];
                S[MODEL_M*k + j] = S[MODEL_M*p + j];
                S[MODEL_M*p + j] = held;
            }
    }
    for (int i = 1; i < MODEL_N; i++)
        for (int k = 0; k < i; k++)
            if (lu[MODEL_N*i + k] != 0)
                for (int j = 0; j < MODEL_M; j++)
                    S[MODEL_M*i + j] -= lu[MODEL_N*i + k]*S[MODEL_M*k + j];
    for (int i = MODEL_N - 1; i >= 0; i--) {
        for (int k = i + 1; k < MODEL_N; k++)
            if (lu[MODEL_N*i + k] != 0)
                for (int j = 0; j < MODEL_M; j++)
                    S[MODEL_M*i + j] -= lu[MODEL_N*i + k]*S[MODEL_M*k + j];
        for (int j = 0; j < MODEL_M; j++)
            S[MODEL_M*i + j] /= lu[MODEL_N*i + i];
    }
}
#endif

/* W = Y_l - Y_z S. */
static void read_W(model_solver *s)
{
    double *W = s->newton.W;
#if IDENTITY
    const double *S = s->newton.E_l;
#else
    const double *S = s->newton.S;
#endif
#if FEEDTHROUGH
    memcpy(W, s->newton.Y_l, sizeof s->newton.W);
#else
    memset(W, 0, sizeof s->newton.W);
#endif
    for (int i = 0; i < MODEL_M; i++)
        for (int k = 0; k < MODEL_N; k++) {
            const double entry = s->newton.Y_z[MODEL_N*i + k];
            if (entry != 0)
                for (int j = 0; j < MODEL_M; j++)
                    W[MODEL_M*i + j] -= entry*S[MODEL_M*k + j];
        }
}
#endif
#endif

/* E and Y at (z, l), with their Jacobians where these may have changed; 0 where something is not finite. */
static int evaluate(model_solver *s)
{
#if AFFINE
    double *E = s->newton.E;
    const double *z = s->work.z;
#if LAW
    const double *l = s->work.l;
    E_l_times(s, l, E);
    for (int i = 0; i < MODEL_M; i++) {
        double y = s->newton.Y_0[i] + Y_z_times(s, i, z);
#if FEEDTHROUGH
        for (int j = 0; j < MODEL_M; j++)
            y += s->newton.Y_l[MODEL_M*i + j]*l[j];
#endif
        s->newton.Y[i] = y;
    }
#else
    memset(E, 0, sizeof s->newton.E);
#endif
    for (int i = 0; i < MODEL_N; i++) {
#if IDENTITY
        E[i] += s->newton.E_0[i] + z[i];
#else
        double moved = s->newton.E_0[i];
        for (int j = 0; j < MODEL_N; j++)
            moved += s->newton.E_z[MODEL_N*i + j]*z[j];
        E[i] += moved;
#endif
    }
#else
    if (!read_matrices(s))
        return 0;
#endif
#if LAW
    if (!all_finite(MODEL_M, s->work.l) || !all_finite(MODEL_M, s->newton.Y))
        return 0;
#endif
    return all_finite(MODEL_N, s->work.z) && all_finite(MODEL_N, s->newton.E);
}

/* Factor E_z, and find S and W, once for the matrices at hand. Return 0 where E_z is singular: then S = 0. */
static int eliminate(model_solver *s)
{
    if (s->newton.prepared == READ) {
        s->newton.prepared = REGULAR;
#if !IDENTITY
        memcpy(s->newton.lu, s->newton.E_z, sizeof s->newton.lu);
        if (lu_factor(MODEL_N, s->newton.lu, s->newton.pivot) != 0)
            s->newton.prepared = SINGULAR;
#endif
#if LAW
#if !ROWS
#if !IDENTITY
        if (s->newton.prepared == REGULAR)
            solve_columns(s);
        else
            memset(s->newton.S, 0, sizeof s->newton.S);
#endif
        read_W(s);
#endif
#endif
    }
    return s->newton.prepared == REGULAR;
}
#if LAW

/* Solve an affine problem in l; where no answer passes, the best one is an iterate all the same. */
static int solve_affine(model_solver *s, int m, const double *W, const double *b, const double *lo, const double *up, double *l,
                        signed char *code)
{
    const int solver = affine_solve(s, m, W, b, lo, up, l, code, TOLERANCE/STRICTER);
#if CURVED
    return solver == NONE && s->affine.residual < INFINITY ? SEMISMOOTH : solver;
#else
    return solver == NONE && s->affine.residual < INFINITY ? INDEX_SET : solver;
#endif
}
#endif
#if EXACT_ROWS

/* Put z_j where y_i = factor z_j + offset is exactly 0, for the rows coded 0, what follows from these, and z = 0 at rest: stick is
   exactly 0. */
static void make_exact(model_solver *s)
{
#if UNIT_ROWS
#if FOLLOW_ROWS
    memset(s->newton.exact, 0, sizeof s->newton.exact);
#endif
    for (int i = 0; i < MODEL_UNIT; i++)
        if (s->work.code[unit_row[i]] == 0) {
            s->work.z[unit_column[i]] = -s->newton.offset[i]/unit_factor[i];
#if FOLLOW_ROWS
            s->newton.exact[unit_column[i]] = 1;
#endif
        }
#endif
#if FOLLOW_ROWS
    for (int i = 0; i < MODEL_FOLLOW; i++) {
        const int row = follow_row[i];
        double known = s->newton.E_0[row];
        int exact = 1;
        for (int k = follow_start[i]; k < follow_start[i + 1]; k++) {
            known += s->newton.E_z[MODEL_N*row + follow_column[k]]*s->work.z[follow_column[k]];
            exact &= s->newton.exact[follow_column[k]];
        }
        if (exact)
            s->work.z[row] = -known/s->newton.E_z[MODEL_N*row + row];
    }
#endif
#if REST_ROWS
    int moving = 0;
    for (int i = 0; i < MODEL_REST; i++)
        moving |= s->work.code[rest_row[i]] != 0;
    if (!moving)
        memset(s->work.z, 0, sizeof s->work.z);
#endif
}
#endif

/* dz = -E_z^{-1} E; 0 where E_z is singular. */
static int predict(model_solver *s)
{
    if (!eliminate(s))
        return 0;
    for (int i = 0; i < MODEL_N; i++)
        s->newton.dz[i] = -s->newton.E[i];
#if !IDENTITY
    lu_solve(MODEL_N, s->newton.lu, s->newton.pivot, s->newton.dz);
#endif
    return 1;
}
#if LAW

/* z += dz - S dl, dl in newton.l; what rows give exactly is exact. */
static void respond(model_solver *s)
{
    const double *dz = s->newton.dz;
    double *z = s->work.z, *v = s->newton.v;
    S_times(s, s->newton.l, v);
    for (int i = 0; i < MODEL_N; i++)
        z[i] += dz[i] - v[i];
#if EXACT_ROWS
    make_exact(s);
#endif
}
#endif

/* One iteration of Newton's method: the next (z, l, index set). Return the solver of its affine problem, or NONE. */
static int iterate(model_solver *s)
{
    const double *dz = s->newton.dz;
    if (!predict(s))
        return NONE;
#if LAW
    double *l = s->work.l, *l_next = s->newton.l, *b = s->newton.b, *v = s->newton.v;
    S_times(s, l, v);
    for (int i = 0; i < MODEL_N; i++)
        v[i] += dz[i];
    for (int i = 0; i < MODEL_M; i++) {
        b[i] = s->newton.Y[i] + Y_z_times(s, i, v);
#if FEEDTHROUGH
        b[i] -= dot(MODEL_M, s->newton.Y_l + MODEL_M*i, l);
#endif
    }
    if (!all_finite(MODEL_M, b))
        return NONE;
#if ROWS
    const int solver = solve_rows(s);
#else
    memcpy(l_next, l, sizeof s->work.l);
    const int solver = solve_affine(s, MODEL_M, s->newton.W, b, LOWER, UPPER, l_next, s->work.code);
#endif
    if (solver == NONE)
        return NONE;
    for (int j = 0; j < MODEL_M; j++) {
        const double next = l_next[j];
        l_next[j] -= l[j];
        l[j] = next;
    }
    respond(s);
    return solver;
#else
    for (int i = 0; i < MODEL_N; i++)
        s->work.z[i] += dz[i];
    return NONE_NEEDED;
#endif
}

/* ------------------------------------------------------------------ the certificate */

/* The largest |E_i| / scale_i, 0/0 = 0. */
static double largest_ratio(const double *E, const double *scale)
{
    double worst = 0;
    for (int i = 0; i < MODEL_N; i++)
        if (E[i] != 0)
            worst = worse_of(worst, fabs(E[i])/max_of(scale[i], UNRESOLVED));
    return worst;
}

#if TERMS

/* The bounds of large graphs: the terms of E and Y in the unknowns, and the rest. */
static void round_off_by_terms(model_solver *s)
{
    const double *z = s->work.z;
    double *error_E = s->newton.error_E;
#if LAW
    E_l_times(s, s->work.l, s->newton.sum);
    E_l_size(s, s->work.l, error_E);
#else
    memset(error_E, 0, sizeof s->newton.error_E);
#endif
    for (int i = 0; i < MODEL_N; i++) {
        double rest = s->newton.E[i];
#if LAW
        rest -= s->newton.sum[i];
#endif
#if IDENTITY
        rest -= z[i];
        error_E[i] += fabs(z[i]);
#else
        for (int j = 0; j < MODEL_N; j++) {
            const double term = s->newton.E_z[MODEL_N*i + j]*z[j];
            rest -= term;
            error_E[i] += fabs(term);
        }
#endif
        error_E[i] += fabs(rest);
    }
#if LAW
    for (int i = 0; i < MODEL_M; i++) {
        double rest = s->newton.Y[i] - Y_z_times(s, i, z), size = Y_z_size(s, i, z);
#if FEEDTHROUGH
        for (int j = 0; j < MODEL_M; j++) {
            const double term = s->newton.Y_l[MODEL_M*i + j]*s->work.l[j];
            rest -= term;
            size += fabs(term);
        }
#endif
        s->newton.error_Y[i] = size + fabs(rest);
    }
#endif
}
#endif

/* The running error bounds of E and Y at (z, l), once for each iterate. */
static void look_at_rounding(model_solver *s)
{
    if (s->newton.looked)
        return;
    s->newton.looked = 1;
#if TERMS
    round_off_by_terms(s);
#else
#if LAW
    round_off(s, s->work.z, s->work.l, s->newton.error_E, s->newton.error_Y);
#else
    round_off(s, s->work.z, s->newton.error_E);
#endif
#endif
}
#if !IDENTITY

/* The largest |E_z^{-1} r| over probes, which are r with signs that look random: from below, what z errs by where E does so by r;
   and the most that Y feels of one of them. */
static void felt_by(model_solver *s, const double *r)
{
    double *v = s->newton.dz, *felt = s->newton.felt;
    memset(felt, 0, sizeof s->newton.felt);
#if LAW
    memset(s->newton.terms, 0, sizeof s->newton.terms);
#endif
    for (int p = 0; p < PROBES; p++) {
        for (int i = 0; i < MODEL_N; i++)
            v[i] = probe_sign(i, p)*r[i];
        lu_solve(MODEL_N, s->newton.lu, s->newton.pivot, v);
        for (int i = 0; i < MODEL_N; i++)
            felt[i] = worse_of(felt[i], fabs(v[i]));
#if LAW
        for (int i = 0; i < MODEL_M; i++)
            s->newton.terms[i] = worse_of(s->newton.terms[i], fabs(Y_z_times(s, i, v)));
#endif
    }
}

/* Add to the error bounds of the rows what they feel of that of z; nothing where rounding could excuse any row. */
static void add_felt(model_solver *s)
{
    double *size = s->newton.size, *unit = s->newton.unit, condition = 0;
    if (!eliminate(s) || !spend_on_probes(s))
        return;
    memset(unit, 0, sizeof s->newton.unit); /* in which the largest entry of each row and then of each column is 1 */
    for (int i = 0; i < MODEL_N; i++) {
        const double *row = s->newton.E_z + MODEL_N*i, most = largest(MODEL_N, row);
        for (int j = 0; j < MODEL_N; j++)
            unit[j] = worse_of(unit[j], fabs(row[j])/most);
    }
    for (int i = 0; i < MODEL_N; i++)
        unit[i] = 1/unit[i];
    for (int i = 0; i < MODEL_N; i++) {
        size[i] = 0;
        for (int j = 0; j < MODEL_N; j++)
            size[i] += fabs(s->newton.E_z[MODEL_N*i + j])*unit[j];
    }
    felt_by(s, size);
    for (int i = 0; i < MODEL_N; i++)
        condition = worse_of(condition, s->newton.felt[i]/unit[i]);
    if (!(condition <= WORTH))
        return;
    felt_by(s, s->newton.error_E);
    for (int i = 0; i < MODEL_N; i++)
        s->newton.error_E[i] *= 2;
#if LAW
    for (int i = 0; i < MODEL_M; i++)
        s->newton.error_Y[i] += s->newton.terms[i];
#endif
}
#endif

/* The largest |E_i| / (scale_i + c u error_i / tolerance); an infinite bound excuses nothing. */
static double largest_unseen(const model_solver *s)
{
    double worst = 0;
    for (int i = 0; i < MODEL_N; i++) {
        const double error = s->newton.error_E[i], unseen = error < INFINITY ? ROUND_OFF/TOLERANCE*error : 0;
        if (s->newton.E[i] != 0)
            worst = worse_of(worst, fabs(s->newton.E[i])/max_of(s->newton.scale[i] + unseen, UNRESOLVED));
    }
    return worst;
}

/* The residual of E, against what moves in the step, and what double precision sees of it. The parts of the scale come in the
   order of what they cost, until they suffice: a residual with a smaller scale is an upper bound. |E| where nothing moves counts
   no more than the linearisation at the answer makes of it: far away, E may be anything. */
static double dynamics_residual(model_solver *s)
{
    const double *E = s->newton.E;
    double *scale = s->newton.scale, worst;
#if AFFINE
    worst = largest_ratio(E, s->newton.E_guess);
    if (worst <= CLEAR*TOLERANCE)
        return worst;
#endif
#if LAW
    E_l_times(s, s->work.l, s->newton.sum);
#endif
    for (int i = 0; i < MODEL_N; i++) {
        double moved = 0, unmoved = E[i];
#if LAW
        unmoved -= s->newton.sum[i];
#endif
#if IDENTITY
        const double term = s->work.z[i] - s->newton.guess[i];
        moved += fabs(term);
        unmoved -= term;
#else
        for (int j = 0; j < MODEL_N; j++) {
            const double term = s->newton.E_z[MODEL_N*i + j]*(s->work.z[j] - s->newton.guess[j]);
            moved += fabs(term);
            unmoved -= term;
        }
#endif
        scale[i] = moved + min_of(s->newton.E_guess[i], fabs(unmoved));
    }
    worst = largest_ratio(E, scale);
    if (worst <= CLEAR*TOLERANCE || !all_finite(MODEL_N, scale))
        return all_finite(MODEL_N, scale) ? worst : INFINITY;
    look_at_rounding(s);
#if !AFFINE
    for (int i = 0; i < MODEL_N; i++)
        if (!(fabs(E[i]) <= sqrt(EPS)*(s->newton.error_E[i] + s->newton.E_guess[i]))) /* no rounding, but an iterate on its way */
            return worst;
#endif
    worst = largest_unseen(s);
#if !IDENTITY
    if (worst > TOLERANCE) {
        add_felt(s);
        worst = largest_unseen(s);
    }
#endif
    return worst;
}
#if LAW
#if !CURVED

/* The residual of the law against |b| alone, the point of the graph chosen by the index set: an upper bound of law_residual,
   which is all that most steps need. b = Y - W l is looked at only where y is not what the index set says. */
static double residual_by_code(model_solver *s)
{
    const double *l = s->work.l, *v = s->newton.v, *Y = s->newton.Y;
    double worst = 0;
    int known = 0;
    for (int i = 0; i < MODEL_M; i++) {
        const int code = s->work.code[i];
        const double wrong = code == 0 ? fabs(Y[i]) : code*Y[i];
        if (code == 0 ? l[i] < LOWER[i] || l[i] > UPPER[i] : l[i] != (code < 0 ? LOWER[i] : UPPER[i]))
            return INFINITY;
        if (!(wrong > 0))
            continue;
        if (!known) {
            eliminate(s);
            S_times(s, l, s->newton.v);
            known = 1;
        }
        double b = Y[i] + Y_z_times(s, i, v);
#if FEEDTHROUGH
        b -= dot(MODEL_M, s->newton.Y_l + MODEL_M*i, l);
#endif
        worst = worse_of(worst, is_finite(b) ? wrong/max_of(fabs(b), UNRESOLVED) : INFINITY);
    }
    return worst;
}
#endif
#if !ROWS

/* b = Y - W l, the terms |Y_z| |Z l| + |Y_l| |l| of W l, Z = -S, and w_max_i = max_j |W_ij|. */
static void law_scales(model_solver *s)
{
    const double *l = s->work.l;
    double *v = s->newton.v;
    S_times(s, l, v);
    for (int i = 0; i < MODEL_M; i++) {
        s->newton.b[i] = s->newton.Y[i] + Y_z_times(s, i, v);
        s->newton.terms[i] = Y_z_size(s, i, v);
#if FEEDTHROUGH
        for (int j = 0; j < MODEL_M; j++) {
            const double term = s->newton.Y_l[MODEL_M*i + j]*l[j];
            s->newton.b[i] -= term;
            s->newton.terms[i] += fabs(term);
        }
#endif
        s->newton.w_max[i] = largest(MODEL_M, s->newton.W + MODEL_M*i);
    }
}
#endif

/* The residual of the law at the model's own y, rounding included in its scale. */
static double certified_law(model_solver *s)
{
    const double *l = s->work.l;
    eliminate(s);
    law_scales(s);
    output_scale(MODEL_M, s->newton.b, s->newton.terms, s->newton.w_max, s->newton.s_y);
    look_at_rounding(s);
    for (int i = 0; i < MODEL_M; i++)
        if (s->newton.error_Y[i] < INFINITY)
            s->newton.s_y[i] += ROUND_OFF/TOLERANCE*s->newton.error_Y[i];
    return law_residual(s, MODEL_M, LOWER, UPPER, l, s->newton.Y, s->newton.s_y, s->newton.w_max);
}
#endif

#if PROJECTION
/* <l, y>, which bounds the square of the distance to the projection, beside the square of what moves; 0 if rounding. */
static double gap_residual(model_solver *s)
{
    const double *l = s->work.l, *z = s->work.z, *Y = s->newton.Y;
    double gap = 0, reach = 0, unseen = 0;
    for (int i = 0; i < MODEL_M; i++)
        gap += worse_of(l[i], 0)*worse_of(Y[i], 0);
    if (gap == 0)
        return 0;
    for (int i = 0; i < MODEL_N; i++)
        reach += (z[i] - s->newton.guess[i])*(z[i] - s->newton.guess[i]) + s->newton.E_guess[i]*s->newton.E_guess[i];
    if (gap > CLEAR*TOLERANCE*reach) {
        look_at_rounding(s);
        for (int i = 0; i < MODEL_M; i++)
            unseen += ROUND_OFF*fabs(l[i])*s->newton.error_Y[i];
    }
    return gap <= unseen && unseen < INFINITY ? 0 : reach < INFINITY && gap < INFINITY ? gap/max_of(reach, UNRESOLVED) : INFINITY;
}
#endif

/* Judge (z, l) with its index set. Return its residual, with the step's y in work.y where it passes; where E does not pass, the
   law is not looked at. */
static double judge(model_solver *s)
{
    s->newton.looked = 0;
    double residual = dynamics_residual(s);
#if LAW
    if (residual <= TOLERANCE) {
#if CURVED
        const double law = certified_law(s);
#else
        double law = residual_by_code(s);
        if (!(law <= CLEAR*TOLERANCE))
            law = min_of(law, certified_law(s)); /* both are numbers, or infinite */
#endif
        residual = worse_of(residual, law);
#if PROJECTION
        residual = worse_of(residual, gap_residual(s));
#endif
        for (int i = 0; i < MODEL_M; i++)
            s->work.y[i] = s->work.code[i] == 0 ? 0 : s->newton.Y[i];
    }
#endif
    return s->work.residual = residual;
}

/* ------------------------------------------------------------------ the step */

#if LAW
/* Start from the multiplier l, with z where nothing moves. */
static void prepare(model_solver *s, const double *l)
#else
/* Start with z where nothing moves. */
static void prepare(model_solver *s)
#endif
{
#if LAW
    guess(s, l, s->work.z, s->newton.guess, s->newton.E_guess);
#else
    guess(s, s->work.z, s->newton.guess, s->newton.E_guess);
#endif
    for (int i = 0; i < MODEL_N; i++) /* what is infinite there excuses nothing */
        s->newton.E_guess[i] = is_finite(s->newton.E_guess[i]) ? fabs(s->newton.E_guess[i]) : 0;
}
#if KEPT

/* Keep an accepted iterate while a better one is sought. */
static void keep(model_solver *s)
{
    memcpy(s->newton.best.z, s->work.z, sizeof s->work.z);
#if LAW
    memcpy(s->newton.best.l, s->work.l, sizeof s->work.l);
    memcpy(s->newton.best.y, s->work.y, sizeof s->work.y);
    memcpy(s->newton.best.code, s->work.code, sizeof s->work.code);
#endif
    s->newton.best.residual = s->work.residual;
    s->newton.best.iterations = s->work.iterations;
}

static void restore(model_solver *s)
{
    memcpy(s->work.z, s->newton.best.z, sizeof s->work.z);
#if LAW
    memcpy(s->work.l, s->newton.best.l, sizeof s->work.l);
    memcpy(s->work.y, s->newton.best.y, sizeof s->work.y);
    memcpy(s->work.code, s->newton.best.code, sizeof s->work.code);
#endif
    s->work.residual = s->newton.best.residual;
    s->work.iterations = s->newton.best.iterations;
}
#endif

#if REFINED

/* Correct (z, l) on its index set by what E and Y lack there; 0 where that is a singular system. */
static int correct(model_solver *s)
{
    double *v = s->newton.v, *l = s->newton.l, *A = s->linear.lu, *step = s->newton.b;
    int n = 0, *free = s->newton.free;
    for (int i = 0; i < MODEL_M; i++)
        if (s->work.code[i] == 0)
            free[n++] = i;
    if (n > MODEL_LINEAR || !predict(s))
        return 0;
    for (int j = 0; j < n; j++) {
        memset(l, 0, sizeof s->newton.l);
        l[free[j]] = 1;
        S_times(s, l, v);
        for (int i = 0; i < n; i++) {
            A[n*i + j] = -Y_z_times(s, free[i], v);
#if FEEDTHROUGH
            A[n*i + j] += s->newton.Y_l[MODEL_M*free[i] + free[j]];
#endif
        }
    }
    if (lu_factor(n, A, s->linear.pivot) != 0)
        return 0;
#if UNIT_ROWS
    for (int i = 0; i < MODEL_UNIT; i++)
        if (s->work.code[unit_row[i]] == 0) /* by which z is exact: as near as doubles come */
            s->newton.Y[unit_row[i]] = 0;
#endif
    for (int i = 0; i < n; i++)
        step[i] = -s->newton.Y[free[i]] - Y_z_times(s, free[i], s->newton.dz);
    lu_solve(n, A, s->linear.pivot, step);
    memset(l, 0, sizeof s->newton.l);
    for (int i = 0; i < n; i++) {
        l[free[i]] = step[i];
        s->work.l[free[i]] += step[i];
    }
    respond(s);
    return 1;
}
#endif

/* Newton's method from (z, l) and the index set in work; the solver of the iterate accepted, or NONE. */
static int newton(model_solver *s)
{
    if (!evaluate(s))
        return NONE;
#if REFINED
    int passed = NONE; /* what passes is corrected until rounding explains its residual: elimination keeps a part of the system */
    for (int iteration = 1; iteration <= ITERATIONS && spend(s); iteration++) {
        const int solver = passed == NONE ? iterate(s) : correct(s) ? passed : NONE;
        if (solver == NONE || !evaluate(s))
            break;
        s->work.iterations = passed == NONE ? iteration : s->newton.best.iterations;
        const double residual = judge(s);
        if (residual <= EXPLAINED)
            return solver;
        if (passed != NONE && !(residual < s->newton.best.residual))
            break;
        if (residual <= TOLERANCE) {
            keep(s);
            passed = solver;
        }
    }
    if (passed != NONE)
        restore(s);
    return passed;
#else
#if AFFINE
    for (int iteration = 1; iteration <= ITERATIONS && spend(s); iteration++) {
        const int solver = iterate(s);
        if (solver == NONE || !evaluate(s))
            return NONE;
        s->work.iterations = iteration;
        if (judge(s) <= TOLERANCE)
            return solver;
    }
    return NONE;
#else
    int best = NONE;
    double least = INFINITY; /* residual so far */
    for (int iteration = 1; iteration <= ITERATIONS && spend(s); iteration++) {
        const int solver = iterate(s);
        if (solver == NONE || !evaluate(s))
            break;
        s->work.iterations = iteration;
        const double residual = judge(s);
        if (residual <= TOLERANCE) {
            if (best != NONE && s->newton.best.residual <= residual)
                break;
            if (residual <= ENOUGH*TOLERANCE || residual > least/GAIN) /* as good as it gets */
                return solver;
            keep(s);
            best = solver;
        }
        least = min_of(least, residual);
    }
    if (best != NONE)
        restore(s);
    return best;
#endif
#endif
}
#if NEARBY

/* The norm of what must vanish on an index set: E, and Y in its free rows. */
static double defect(const model_solver *s, int free)
{
    double sum = 0;
    for (int i = 0; i < MODEL_N; i++)
        sum += s->newton.E[i]*s->newton.E[i];
    for (int i = 0; i < free; i++)
        sum += s->newton.Y[s->newton.free[i]]*s->newton.Y[s->newton.free[i]];
    return sqrt(sum);
}

/* Newton's step of E = 0, Y_i = 0 in the free rows: in newton.step. Return 0, or 1 where it is not finite. */
static int smooth_direction(model_solver *s, int free)
{
    const int size = MODEL_N + free, *row = s->newton.free;
    double *J = s->linear.v; /* free until the system proves singular, and J is not needed any more then */
    double *step = s->newton.step;
    for (int i = 0; i < MODEL_N; i++) {
        for (int j = 0; j < MODEL_N; j++)
#if IDENTITY
            J[size*i + j] = i == j;
#else
            J[size*i + j] = s->newton.E_z[MODEL_N*i + j];
#endif
        for (int j = 0; j < free; j++)
            J[size*i + MODEL_N + j] = s->newton.E_l[MODEL_M*i + row[j]];
        step[i] = -s->newton.E[i];
    }
    for (int i = 0; i < free; i++) {
        for (int j = 0; j < MODEL_N; j++)
            J[size*(MODEL_N + i) + j] = s->newton.Y_z[MODEL_N*row[i] + j];
        for (int j = 0; j < free; j++)
#if FEEDTHROUGH
            J[size*(MODEL_N + i) + MODEL_N + j] = s->newton.Y_l[MODEL_M*row[i] + row[j]];
#else
            J[size*(MODEL_N + i) + MODEL_N + j] = 0;
#endif
        step[MODEL_N + i] = -s->newton.Y[row[i]];
    }
    return solve_or_least_squares(s, size, J, step);
}

#if SIDES

/* Put y on the side that the index set says; return 0 where something is not finite there. Slopes are infinite where y = 0. */
static int mirror(model_solver *s)
{
    double *dz = s->newton.dz;
    int wrong = 0;
    memset(dz, 0, sizeof s->newton.dz);
    for (int i = 0; i < MODEL_M; i++) {
        const double *row = s->newton.Y_z + MODEL_N*i, size = dot(MODEL_N, row, row);
        if (s->work.code[i]*s->newton.Y[i] > 0 && size > 0) {
            wrong = 1;
            for (int j = 0; j < MODEL_N; j++)
                dz[j] -= 2*s->newton.Y[i]/size*row[j];
        }
    }
    for (int j = 0; j < MODEL_N; j++)
        s->work.z[j] += dz[j];
    return !wrong || evaluate(s);
}

/* The part of newton.step up to which each y stays on the side that the index set says: beyond y = 0, sqrt|y| is the mirror image
   of what l at this end goes with, and steps would go to and fro. */
static double part_within_sides(const model_solver *s, int free)
{
    double part = 1;
    for (int i = 0; i < MODEL_M; i++) {
        const int code = s->work.code[i];
        const double room = -code*s->newton.Y[i];
        double taken = code*Y_z_times(s, i, s->newton.step);
#if FEEDTHROUGH
        for (int j = 0; j < free; j++)
            taken += code*s->newton.Y_l[MODEL_M*i + s->newton.free[j]]*s->newton.step[MODEL_N + j];
#else
        (void)free;
#endif
        if (room >= 0 && taken > (1 - NEAREST)*room)
            part = min_of(part, (1 - NEAREST)*room/taken);
    }
    return part;
}
#endif

/* Damped Newton for the smooth system of the index set in work.code: E = 0, Y_i = 0 (code 0), l_i at its bound (code +-1).
   Return 1 where its solution passes the certificate. */
static int on_index_set(model_solver *s)
{
    double *z = s->work.z, *l = s->work.l;
    int free = 0;
    prepare(s, s->l);
    for (int i = 0; i < MODEL_M; i++) {
        const int code = s->work.code[i];
        l[i] = code < 0 ? LOWER[i] : code > 0 ? UPPER[i] : s->l[i];
        if (code == 0)
            s->newton.free[free++] = i;
    }
    if (!evaluate(s))
        return 0;
#if SIDES
    if (!mirror(s))
        return 0;
#endif
    double size = defect(s, free);
    for (int iteration = 1; iteration <= NEWTON_ITERATIONS; iteration++) {
        const double old = size;
        int better = 0;
        if (smooth_direction(s, free) != 0)
            return 0;
        memcpy(s->newton.z_0, z, sizeof s->work.z);
        memcpy(s->newton.l_0, l, sizeof s->work.l);
#if SIDES
        const double most = part_within_sides(s, free);
        if (most == 0)
            return 0;
#endif
        for (int k = 0; k <= HALVINGS; k++) {
#if SIDES
            const double t = ldexp(most, -k);
#else
            const double t = ldexp(1, -k);
#endif
            for (int i = 0; i < MODEL_N; i++)
                z[i] = s->newton.z_0[i] + t*s->newton.step[i];
            for (int i = 0; i < free; i++)
                l[s->newton.free[i]] = s->newton.l_0[s->newton.free[i]] + t*s->newton.step[MODEL_N + i];
#if EXACT_ROWS
            if (t == 1)
                make_exact(s);
#endif
            size = evaluate(s) ? defect(s, free) : INFINITY;
            better = size < (1 - ARMIJO*t)*old;
            if (better || size == (1 - ARMIJO*t)*old || old == 0)
                break;
        }
        if (!(size < INFINITY))
            return 0;
        s->work.iterations = iteration;
        const double residual = judge(s);
        if (residual <= ENOUGH*TOLERANCE || (!better && iteration > EARLY))
            return residual <= TOLERANCE;
    }
    return s->work.residual <= TOLERANCE;
}

/* At a switch Newton's index set may alternate: try those around the last one, each a smooth system. */
static int nearby(model_solver *s)
{
    if (!first_index_set(s, MODEL_M, LOWER, UPPER, s->index))
        return NONE;
    for (int count = 0; count < NEARBY_SETS && spend(s); count++) {
        this_index_set(s, MODEL_M, s->work.code);
        if (on_index_set(s))
            return NEWTON_ON_THE_INDEX_SET;
        if (!next_index_set(s, LOWER, UPPER))
            break;
    }
    return NONE;
}
#endif

#if OVERREACH

/* Whether the step leads where the linearisation of a constraint that acts means nothing. */
static int leads_too_far(model_solver *s)
{
    int acts = 0;
    for (int i = 0; i < MODEL_M; i++)
        acts |= s->work.l[i] != 0;
    if (!acts)
        return 0;
    overreach(s, s->work.z, s->newton.terms);
    for (int i = 0; i < MODEL_M; i++)
        if (s->work.l[i] != 0 && !(s->newton.terms[i] <= REACH))
            return 1;
    return 0;
}
#endif

/* The step; the solver whose answer was certified, or NONE. */
static int step_by_newton(model_solver *s)
{
#if AFFINE
#if !CONSTANT
    s->newton.prepared = UNKNOWN;
#endif
    if (s->newton.prepared == UNKNOWN && !read_matrices(s))
        return NONE;
#if LAW
    constant_part(s, s->newton.E_0, s->newton.Y_0);
#else
    constant_part(s, s->newton.E_0);
#endif
#endif
#if UNIT_ROWS
    unit_offsets(s, s->newton.offset);
#endif
#if LAW
    memcpy(s->work.l, s->l, sizeof s->l);
    memcpy(s->work.code, s->index, sizeof s->index);
    prepare(s, s->work.l);
    int solver = newton(s);
#if NEARBY
    if (solver == NONE)
        solver = nearby(s);
#endif
    if (solver == NONE) { /* the last multiplier may belong to a state of quite another size */
        first_multiplier(s, s->work.l, s->work.code);
        prepare(s, s->work.l);
        solver = newton(s);
    }
#if OVERREACH
    if (solver != NONE && leads_too_far(s))
        return NONE;
#endif
    return solver;
#else
    prepare(s);
    return newton(s);
#endif
}
