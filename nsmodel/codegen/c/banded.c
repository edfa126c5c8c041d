/*
 * A large step whose matrices are numbers and sparse: with u = (z, l), an index set makes of it the one system
 *
 *     E_0 + E_z z + E_l l = 0,    Y_0 + Y_z z + Y_l l = 0 on the rows coded 0,    l_i = its end on the others,
 *
 * which is factored as a band, in an order and in scales (powers of 2) that are tables. The index set is found by block principal
 * pivoting from the last one. F = constant + J u, row by row of J; E is judged beside what moves in the step, y beside its
 * rounding, and l lies exactly where it must.
 */

#if LAW
/* The end at which the code holds l_i. */
static double bound_of(int i, int code) { return code < 0 ? lower[i] : upper[i]; }
#endif

/* Put the rows of J, and those of the multipliers that are held, into the band. */
static void fill_band(model_solver *s, double shift)
{
    double *band = s->banded.band;
    memset(band, 0, sizeof s->banded.band);
    for (int i = 0; i < MODEL_SIZE; i++) {
        const int diagonal = MODEL_BAND*place[i] + MODEL_BELOW;
#if LAW
        if (i >= MODEL_N && s->banded.held[i - MODEL_N]) {
            band[diagonal] = 1;
            continue;
        }
#endif
        for (int k = J_start[i]; k < J_start[i + 1]; k++)
            band[diagonal + place[J_column[k]] - place[i]] = J[k]*row_scale[i]*column_scale[J_column[k]];
        if (i >= MODEL_N)
            band[diagonal] += shift;
    }
}

/* Factor the system of the index set in banded.held. Return 0, or 1 where it is singular to rounding. */
static int factor_band(model_solver *s, double shift)
{
    fill_band(s, shift);
    for (int k = 0; k < MODEL_SIZE; k++) {
        const int last = k + MODEL_BELOW < MODEL_SIZE ? k + MODEL_BELOW : MODEL_SIZE - 1;
        double *row = s->banded.band + (long)MODEL_BAND*k + MODEL_BELOW;
        int p = k;
        double most = fabs(row[0]);
        for (int i = k + 1; i <= last; i++) {
            const double size = fabs(row[(long)(MODEL_BAND - 1)*(i - k)]);
            if (size > most) {
                most = size;
                p = i;
            }
        }
        if (!(most > SINGULAR_PIVOT))
            return 1;
        s->banded.pivot[k] = p;
        if (p != k) {
            double *other = row + (long)(MODEL_BAND - 1)*(p - k);
            for (int c = 0; c <= MODEL_UPPER; c++) {
                const double held = row[c];
                row[c] = other[c];
                other[c] = held;
            }
        }
        const double inverse = s->banded.inverse[k] = 1/row[0];
        for (int i = k + 1; i <= last; i++) {
            double *other = row + (long)(MODEL_BAND - 1)*(i - k);
            if (other[0] != 0) {
                const double factor = other[0] *= inverse;
                for (int c = 1; c <= MODEL_UPPER; c++)
                    other[c] -= factor*row[c];
            }
        }
    }
    return 0;
}

/* Solve with the factors: u from the right-hand sides in F, for rows that are held the multipliers themselves. */
static void solve_band(model_solver *s, double *restrict u)
{
    double *v = s->banded.v;
    for (int i = 0; i < MODEL_SIZE; i++)
        v[place[i]] = s->banded.F[i]*row_scale[i];
#if LAW
    for (int i = 0; i < MODEL_M; i++)
        if (s->banded.held[i])
            v[place[MODEL_N + i]] = s->banded.F[MODEL_N + i]/column_scale[MODEL_N + i];
#endif
    for (int k = 0; k < MODEL_SIZE; k++) {
        const double *row = s->banded.band + (long)MODEL_BAND*k + MODEL_BELOW;
        const int last = k + MODEL_BELOW < MODEL_SIZE ? k + MODEL_BELOW : MODEL_SIZE - 1, p = s->banded.pivot[k];
        const double held = v[p];
        v[p] = v[k];
        v[k] = held;
        for (int i = k + 1; i <= last; i++)
            v[i] -= row[(long)(MODEL_BAND - 1)*(i - k)]*held;
    }
    for (int k = MODEL_SIZE - 1; k >= 0; k--) {
        const double *row = s->banded.band + (long)MODEL_BAND*k + MODEL_BELOW;
        double sum = v[k];
        for (int c = MODEL_UPPER; c > 0; c--) /* what was computed last comes last */
            sum -= row[c]*v[k + c];
        v[k] = sum*s->banded.inverse[k];
    }
    for (int i = 0; i < MODEL_SIZE; i++)
        u[i] = v[place[i]]*column_scale[i];
}

/* Make the factors those of the index set in banded.code. Return 0, or 1 where it is singular even when it is shifted. */
static int factor_index_set(model_solver *s)
{
#if LAW
    int same = s->banded.factored;
    for (int i = 0; i < MODEL_M; i++) {
        const signed char held = s->banded.code[i] != 0;
        same &= s->banded.held[i] == held;
        s->banded.held[i] = held;
    }
    if (same)
        return 0;
#else
    if (s->banded.factored)
        return 0;
#endif
    s->banded.shift = 0;
    if (factor_band(s, 0)) {
        s->banded.shift = SHIFT;
        if (factor_band(s, SHIFT))
            return 1;
    }
    s->banded.factored = 1;
    return 0;
}

/* F and the size of its terms at u. */
static void evaluate_rows(model_solver *s)
{
    const double *u = s->banded.u;
    for (int i = 0; i < MODEL_SIZE; i++) {
        double sum = s->banded.constant[i], size = fabs(sum);
        for (int k = J_start[i]; k < J_start[i + 1]; k++) {
            const double term = J[k]*u[J_column[k]];
            sum += term;
            size += fabs(term);
        }
        s->banded.F[i] = sum;
        s->banded.size[i] = size;
    }
}

#if LAW
/* Put l at its ends, z_j where y_i = factor z_j + c is 0, and what follows from these, exactly. */
static void make_exact(model_solver *s)
{
    double *l = s->banded.u + MODEL_N;
    const signed char *code = s->banded.code;
    for (int i = 0; i < MODEL_M; i++) {
        if (code[i] != 0)
            l[i] = bound_of(i, code[i]);
        else if (l[i] < lower[i] && lower[i] - l[i] <= INSIDE*EPS*fabs(l[i]))
            l[i] = lower[i];
        else if (l[i] > upper[i] && l[i] - upper[i] <= INSIDE*EPS*fabs(l[i]))
            l[i] = upper[i];
    }
#if UNIT_ROWS
#if FOLLOW_ROWS
    signed char *exact = s->banded.exact;
    memset(exact, 0, sizeof s->banded.exact);
#endif
    for (int i = 0; i < MODEL_UNIT; i++)
        if (code[unit_row[i]] == 0) {
            s->banded.u[unit_column[i]] = -s->banded.constant[MODEL_N + unit_row[i]]/unit_factor[i];
#if FOLLOW_ROWS
            exact[unit_column[i]] = 1;
#endif
        }
#endif
#if FOLLOW_ROWS
    for (int i = 0; i < MODEL_FOLLOW; i++) {
        const int row = follow_row[i];
        double known = s->banded.constant[row], own = 0;
        int all = 1;
        for (int k = J_start[row]; k < J_start[row + 1]; k++)
            if (J_column[k] == row)
                own = J[k];
            else {
                known += J[k]*s->banded.u[J_column[k]];
                all &= exact[J_column[k]];
            }
        if (all)
            s->banded.u[row] = -known/own;
    }
#endif
#if REST_ROWS
    int moving = 0;
    for (int i = 0; i < MODEL_REST; i++)
        moving |= code[rest_row[i]] != 0;
    if (!moving)
        memset(s->banded.u, 0, MODEL_N*sizeof *l);
#endif
}

/* The code that row i calls for at u: another one than its own where it contradicts it. */
static int wanted_code(const model_solver *s, int i)
{
    const int code = s->banded.code[i];
    const double l = s->banded.u[MODEL_N + i];
    if (code == 0)
        return l < lower[i] ? -1 : l > upper[i] ? 1 : 0;
    return code*s->banded.F[MODEL_N + i] > ROUND_OFF*s->banded.size[MODEL_N + i] ? 0 : code;
}
#endif

/* The certificate at u; infinite where anything is not finite. */
static double judged(const model_solver *s)
{
    const double *u = s->banded.u, *guess = s->banded.guess, *F = s->banded.F, *size = s->banded.size;
    double worst = 0, sum = 0;
    for (int i = 0; i < MODEL_N; i++) {
        const double off = fabs(F[i]);
        sum += size[i];
        if (off == 0)
            continue;
        double scale = ROUND_OFF/TOLERANCE*size[i], moved = s->banded.constant[i];
        if (!(off <= CLEAR*TOLERANCE*scale)) {
            double step = 0;
            for (int k = J_start[i]; k < J_start[i + 1]; k++) {
                const int j = J_column[k];
                moved += J[k]*guess[j];
                if (j < MODEL_N)
                    step += fabs(J[k]*(u[j] - guess[j]));
            }
            scale += is_finite(moved + step) ? fabs(moved) + step : 0;
        }
        worst = worse_of(worst, off/max_of(scale, UNRESOLVED));
    }
#if LAW
    for (int i = 0; i < MODEL_M; i++) {
        const int row = MODEL_N + i, code = s->banded.code[i];
        const double off = code == 0 ? fabs(F[row]) : worse_of(code*F[row], 0);
        sum += size[row];
        if (off > 0)
            worst = worse_of(worst, off/max_of(ROUND_OFF/TOLERANCE*size[row], UNRESOLVED));
    }
#endif
    return is_finite(sum) && is_finite(worst) ? worst : INFINITY;
}

/* The largest solutions of probes, which are r with signs that look random, in banded.felt: what u errs by where the rows do so by
   r, from below; and in banded.passed the most that a row feels of one of them. */
static void felt_by(model_solver *s, const double *r)
{
    double *change = s->banded.change, *felt = s->banded.felt, *passed = s->banded.passed;
    memset(felt, 0, sizeof s->banded.felt);
    memset(passed, 0, sizeof s->banded.passed);
    for (int p = 0; p < PROBES; p++) {
        for (int i = 0; i < MODEL_SIZE; i++)
            s->banded.F[i] = probe_sign(i, p)*r[i];
#if LAW
        for (int i = 0; i < MODEL_M; i++)
            if (s->banded.held[i])
                s->banded.F[MODEL_N + i] = 0;
#endif
        solve_band(s, change);
        for (int i = 0; i < MODEL_SIZE; i++) {
            double sum = 0;
            for (int k = J_start[i]; k < J_start[i + 1]; k++)
                sum += J[k]*change[J_column[k]];
            felt[i] = worse_of(felt[i], fabs(change[i]));
            passed[i] = worse_of(passed[i], fabs(sum));
        }
    }
}

/* The certificate at u, with the rounding of what is given and, where that does not suffice, of what the unknowns err by; none of
   that where rounding could excuse any row. */
static double judged_with_rounding(model_solver *s)
{
    double *size = s->banded.size, *error = s->banded.best, condition = 0;
    given_error(s, error);
    for (int i = 0; i < MODEL_SIZE; i++)
        error[i] = size[i] += error[i];
    double found = judged(s);
    if (found <= TOLERANCE || !spend_on_probes(s))
        return found;
    for (int i = 0; i < MODEL_SIZE; i++) {
        size[i] = 0;
        for (int k = J_start[i]; k < J_start[i + 1]; k++)
            size[i] += fabs(J[k])*column_scale[J_column[k]];
    }
    felt_by(s, size);
    for (int i = 0; i < MODEL_SIZE; i++)
        condition = worse_of(condition, s->banded.felt[i]/column_scale[i]);
    if (condition <= WORTH) {
        felt_by(s, error);
        for (int i = 0; i < MODEL_SIZE; i++)
            error[i] += s->banded.passed[i];
    }
    evaluate_rows(s);
    memcpy(size, error, sizeof s->banded.size);
    return condition <= WORTH ? judged(s) : found;
}

/* u on the index set in banded.code. Return how many rows contradict it, and the residual where none does; -1: no answer. */
static int on_index_set(model_solver *s, double *residual)
{
    double *u = s->banded.u, best = INFINITY;
    if (!spend(s) || factor_index_set(s)) {
        s->banded.factored = 0;
        return -1;
    }
    for (int i = 0; i < MODEL_SIZE; i++)
        s->banded.F[i] = -s->banded.constant[i];
#if LAW
    for (int i = 0; i < MODEL_M; i++)
        if (s->banded.code[i] != 0)
            s->banded.F[MODEL_N + i] = bound_of(i, s->banded.code[i]);
#endif
    solve_band(s, u);
    int wrong = 0, refined = 0;
    for (;; refined++) {
        wrong = 0;
#if LAW
        make_exact(s);
#endif
        evaluate_rows(s);
#if LAW
        for (int i = 0; i < MODEL_M; i++)
            wrong += wanted_code(s, i) != s->banded.code[i];
        if (wrong > 0 && s->banded.shift == 0)
            return wrong;
#endif
        const double found = judged(s);
        if (found < best) {
            best = found;
            memcpy(s->banded.best, u, sizeof s->banded.u);
        }
        if (best <= TOLERANCE/STRICTER || refined == REFINEMENTS || !(found < INFINITY) || !spend(s))
            break;
#if LAW
        for (int i = 0; i < MODEL_M; i++)
            if (s->banded.code[i] != 0)
                s->banded.F[MODEL_N + i] = 0;
#endif
#if UNIT_ROWS
        for (int i = 0; i < MODEL_UNIT; i++) /* u is exact by these: as near as doubles come */
            s->banded.F[MODEL_N + unit_row[i]] = 0;
#endif
        double *change = s->banded.size;
        solve_band(s, change);
        for (int i = 0; i < MODEL_SIZE; i++)
            u[i] -= change[i];
    }
    if (refined > 0) {
        memcpy(u, s->banded.best, sizeof s->banded.u);
        evaluate_rows(s);
    }
    if (best > TOLERANCE && best < INFINITY)
        best = judged_with_rounding(s);
    *residual = best;
    return wrong;
}

/* The step; the solver whose answer was certified, or NONE. */
static int step_by_band(model_solver *s)
{
    double residual = INFINITY;
    constant_part(s, s->banded.constant, s->banded.guess);
#if LAW
    int fewest = MODEL_M + 1, patience = PATIENCE, sweep = 0, wrong = 0;
    for (int i = 0; i < MODEL_M; i++)
        s->banded.code[i] = s->index[i] && is_finite(bound_of(i, s->index[i])) ? s->index[i] : 0;
    for (; sweep < PIVOTED_SETS; sweep++) {
        wrong = on_index_set(s, &residual);
        if (wrong <= 0)
            break;
        int from = 0;
        if (wrong < fewest) {
            fewest = wrong;
            patience = PATIENCE;
        } else if (patience > 0)
            patience--;
        else /* the last row alone */
            for (from = MODEL_M - 1; wanted_code(s, from) == s->banded.code[from];)
                from--;
        for (int i = from; i < MODEL_M; i++)
            s->banded.code[i] = (signed char)wanted_code(s, i);
    }
    if (wrong != 0 || !(residual <= TOLERANCE))
        return NONE;
    memcpy(s->work.l, s->banded.u + MODEL_N, sizeof s->work.l);
    memcpy(s->work.code, s->banded.code, sizeof s->work.code);
    for (int i = 0; i < MODEL_M; i++)
        s->work.y[i] = s->work.code[i] == 0 ? 0.0 : s->banded.F[MODEL_N + i];
#else
    if (on_index_set(s, &residual) != 0 || !(residual <= TOLERANCE))
        return NONE;
#endif
    memcpy(s->work.z, s->banded.u, sizeof s->work.z);
    s->work.residual = residual;
    s->work.iterations = 1;
#if LAW
    return sweep == 0 ? LAST_INDEX_SET : INDEX_SET;
#else
    return NONE_NEEDED;
#endif
}
