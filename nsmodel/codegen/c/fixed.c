/*
 * A step whose matrices are numbers: z = z_0 + Z l, y = W l + b, and on an index set l is affine in b. The last index set is
 * tried first, with its inverse kept; every answer is judged on E = E_0 + E_z z + E_l l and Y = Y_0 + Y_z z + Y_l l.
 */

/* The larger of worst and part/size; inf where that is NaN. An infinite size excuses nothing. */
static double worst_of(double worst, double part, double size)
{
    if (size < INFINITY ? part <= worst*size : part == 0)
        return worst;
    if (!(size < INFINITY))
        return INFINITY;
    const double r = part/max_of(size, UNRESOLVED);
    return r <= worst ? worst : r < INFINITY ? r : INFINITY;
}

/* The running error bounds of E and Y at (z, l), once for each that is judged. */
static void look_at_rounding(model_solver *s)
{
    if (s->fixed.looked)
        return;
    s->fixed.looked = 1;
#if LAW
    round_off_E(s, s->work.z, s->work.l, s->fixed.error_E);
    round_off_Y(s, s->work.z, s->work.l, s->fixed.error_Y);
#else
    round_off_E(s, s->work.z, s->fixed.error_E);
#endif
}

/* The residual of E at s->work.z, beside what moves in the step; rounding is looked at only where it may matter. */
static double dynamics_residual(model_solver *s)
{
    double *E = s->fixed.E, *scale = s->fixed.scale, worst = 0;
    scale_E(s, s->fixed.E_0, s->work.z, scale);
    for (int i = 0; i < MODEL_N; i++)
        worst = worst_of(worst, fabs(E[i]), scale[i]);
    if (worst <= CLEAR*TOLERANCE)
        return worst;
    look_at_rounding(s);
    worst = 0;
    for (int i = 0; i < MODEL_N; i++)
        worst = worst_of(worst, fabs(E[i]), scale[i] + ROUND_OFF/TOLERANCE*s->fixed.error_E[i]);
    return worst;
}

#if LAW
#if CURVED
/* The residual of the law at (l, Y); rounding is looked at only where it may matter. */
static double residual_of_law(model_solver *s)
{
    const double *l = s->work.l;
    double *s_y = s->fixed.s_y;
    output_scale(MODEL_M, s->fixed.b, s->fixed.terms, output_max, s_y);
    const double residual = law_residual(s, MODEL_M, lower, upper, l, s->fixed.Y, s_y, output_max);
    if (residual <= CLEAR*TOLERANCE)
        return residual;
    look_at_rounding(s);
    for (int i = 0; i < MODEL_M; i++)
        s_y[i] += ROUND_OFF/TOLERANCE*s->fixed.error_Y[i];
    return law_residual(s, MODEL_M, lower, upper, l, s->fixed.Y, s_y, output_max);
}
#else
/* The largest |b_j| / sqrt(w_j): multipliers that run away, because a step has no solution, must not raise the scale of y. */
static double largest_b(const model_solver *s)
{
    double most = 0;
    for (int j = 0; j < MODEL_M; j++)
        if (fabs(s->fixed.b[j]) > most*w_root[j] && w_root[j] > 0)
            most = fabs(s->fixed.b[j])/w_root[j];
    return most;
}

/* s_y of row i: |b_i| and the terms of W l, within GROWTH of what b is; *most is largest_b, once it is known. */
static double output_scale_of(const model_solver *s, int i, double *most)
{
    const double size = fabs(s->fixed.b[i]), terms = s->fixed.terms[i];
    if (w_root[i] == 0)
        return size;
    if (terms <= GROWTH*size)
        return size + terms;
    if (*most < 0)
        *most = largest_b(s);
    return min_of(size + terms, max_of(GROWTH*w_root[i]*(*most), size));
}

/* s_l of row i: what moves y by s_y, but not more than the size of l, of its bounds, or a small part of the other multipliers. */
static double multiplier_scale_of(const model_solver *s, int i, double s_y)
{
    double size = max_of(fabs(s->work.l[i]), bound_size[i]);
    if (w_root[i] == 0)
        return size;
    for (int j = 0; j < MODEL_M; j++)
        size = max_of(size, NEGLIGIBLE*fabs(s->work.l[j])*w_root[j]/w_root[i]);
    return min_of(s_y/(w_root[i]*w_root[i]), size);
}

/* The residual of the law at (l, Y), the graph point chosen by the index set: an upper bound of the distance to the graph.
   *settled: whether no other index set is called for. Rounding is looked at only where it may matter. */
static double box_residual(model_solver *s, int *settled)
{
    const double *l = s->work.l, *Y = s->fixed.Y, *error_Y = s->fixed.error_Y;
    double worst = 0, sum = 0, most = -1;
    *settled = 1;
    for (int i = 0; i < MODEL_M; i++) {
        const int code = s->work.code[i];
        const double y = Y[i];
        double wrong = fabs(y), off = 0; /* of y, of l */
        sum += y + l[i];
        if (code == 0) {
            if (l[i] < lower[i])
                off = lower[i] - l[i];
            else if (l[i] > upper[i])
                off = l[i] - upper[i];
            if (off > INSIDE*EPS*fabs(l[i]))
                *settled = 0;
        } else {
            off = fabs(l[i] - (code < 0 ? lower[i] : upper[i]));
            if (code*y <= 0)
                wrong = 0;
        }
        if (wrong == 0 && off == 0)
            continue;
        double s_y = output_scale_of(s, i, &most);
        if (code != 0 || wrong > CLEAR*TOLERANCE*s_y) {
            look_at_rounding(s);
            s_y += ROUND_OFF/TOLERANCE*error_Y[i];
            if (code != 0 && wrong > ROUND_OFF*error_Y[i])
                *settled = 0;
        }
        worst = worst_of(worst, wrong, s_y);
        if (off > 0)
            worst = worst_of(worst, off, multiplier_scale_of(s, i, max_of(s_y, UNRESOLVED)));
    }
    return is_finite(sum) ? worst : INFINITY;
}
#endif
#endif

#if PROJECTION
/* <l, y>, which bounds the square of the distance to the projection, beside the square of what moves; 0 if rounding. */
static double gap_residual(model_solver *s)
{
    const double *l = s->work.l, *Y = s->fixed.Y;
    double gap = 0, reach[1], unseen = 0;
    for (int i = 0; i < MODEL_M; i++)
        gap += worse_of(l[i], 0)*worse_of(Y[i], 0);
    if (gap == 0)
        return 0;
    moved(s, s->fixed.E_0, s->work.z, reach);
    if (gap <= CLEAR*TOLERANCE*reach[0])
        return worst_of(0, gap, reach[0]);
    look_at_rounding(s);
    for (int i = 0; i < MODEL_M; i++)
        unseen += ROUND_OFF*fabs(l[i])*s->fixed.error_Y[i];
    return gap <= unseen && unseen < INFINITY ? 0 : worst_of(0, gap, reach[0]);
}

#endif
static void add_felt(model_solver *s);
#if LENGTHS

/* Units of z and l in which the step is well scaled, and the size of each row in them. */
static void choose_units(model_solver *s)
{
    double *J = s->linear.lu;
    const double *units = s->linear.columns;
#if LAW
    const int size = MODEL_N + MODEL_M;
#else
    const int size = MODEL_N;
#endif
    for (int i = 0; i < MODEL_N; i++) {
        COPY(J + size*i, AT.E_z + MODEL_N*i, MODEL_N);
#if LAW
        COPY(J + size*i + MODEL_N, AT.E_l + MODEL_M*i, MODEL_M);
#endif
    }
#if LAW
    for (int i = 0; i < MODEL_M; i++) {
        COPY(J + size*(MODEL_N + i), AT.Y_z + MODEL_N*i, MODEL_N);
        COPY(J + size*(MODEL_N + i) + MODEL_N, AT.Y_l + MODEL_M*i, MODEL_M);
    }
#endif
    balance(s, size);
    COPY(unit_z, units, MODEL_N);
    for (int i = 0; i < MODEL_N; i++) {
        unit_size_E[i] = 0;
        for (int j = 0; j < MODEL_N; j++)
            unit_size_E[i] += fabs(AT.E_z[MODEL_N*i + j])*units[j];
#if LAW
        for (int j = 0; j < MODEL_M; j++)
            unit_size_E[i] += fabs(AT.E_l[MODEL_M*i + j])*units[MODEL_N + j];
#endif
    }
#if LAW
    COPY(unit_l, units + MODEL_N, MODEL_M);
    for (int i = 0; i < MODEL_M; i++) {
        unit_size_Y[i] = 0;
        for (int j = 0; j < MODEL_N; j++)
            unit_size_Y[i] += fabs(AT.Y_z[MODEL_N*i + j])*units[j];
        for (int j = 0; j < MODEL_M; j++)
            unit_size_Y[i] += fabs(AT.Y_l[MODEL_M*i + j])*units[MODEL_N + j];
    }
#endif
}

/* Form the matrices of steps of length h, in place of those in use; 0 where E_z has no inverse. */
static int form_matrices(model_solver *s, double h)
{
    AT.h = h;
#if LAW
    matrices(s, AT.E_z, AT.E_l, AT.Y_z, AT.Y_l);
    if (!all_finite(MODEL_N*MODEL_M, AT.E_l) || !all_finite(MODEL_M*MODEL_N, AT.Y_z) || !all_finite(MODEL_M*MODEL_M, AT.Y_l))
        return 0;
#else
    matrices(s, AT.E_z);
#endif
    if (invert(s, MODEL_N, AT.E_z, AT.inverse) != 0)
        return 0;
#if LAW
    for (int i = 0; i < MODEL_N; i++)
        for (int j = 0; j < MODEL_M; j++) {
            double sum = 0;
            for (int k = 0; k < MODEL_N; k++)
                sum += AT.inverse[MODEL_N*i + k]*AT.E_l[MODEL_M*k + j];
            AT.Z[MODEL_M*i + j] = -sum;
        }
    for (int i = 0; i < MODEL_M; i++) {
        double most = 0;
        for (int j = 0; j < MODEL_M; j++) {
            double sum = AT.Y_l[MODEL_M*i + j];
            for (int k = 0; k < MODEL_N; k++)
                sum += AT.Y_z[MODEL_N*i + k]*AT.Z[MODEL_M*k + j];
            output_map[MODEL_M*i + j] = sum;
            most = max_of(most, fabs(sum));
        }
#if CURVED
        output_max[i] = most;
#else
        w_root[i] = sqrt(most);
#endif
    }
#endif
    choose_units(s);
    return 1;
}

/* Put the matrices of the step's length in place, from the few that are kept; 0 where it has none. */
static int find_matrices(model_solver *s)
{
    int found = -1, oldest = 0;
    if (s->fixed.formed > 0 && fabs(s->h - AT.h) <= SAME*AT.h)
        return 1;
    for (int k = 0; k < s->fixed.formed; k++) {
        const double h = s->fixed.lengths[k].h;
        if (fabs(s->h - h) <= SAME*h)
            found = k;
        if (s->fixed.lengths[k].used < s->fixed.lengths[oldest].used)
            oldest = k;
    }
#if FIXED_MAPS
    s->fixed.current = -1;
#endif
    s->fixed.length = found >= 0 ? found : s->fixed.formed < MODEL_LENGTHS ? s->fixed.formed++ : oldest;
    AT.used = ++s->fixed.turn;
    if (found >= 0)
        return 1;
#if FIXED_MAPS
    for (int k = 0; k < s->fixed.filled; k++)
        if (s->fixed.maps[k].length == s->fixed.length)
            s->fixed.maps[k].code[0] = 2; /* no code: it belonged to another length */
#endif
    if (spend(s) && form_matrices(s, s->h))
        return 1;
    AT.h = NAN; /* no length */
    return 0;
}
#endif
#if FIXED_MAPS

/* Whether the map at hand is that of the index set at hand. */
static int on_map(const model_solver *s)
{
    const int k = s->fixed.current;
    return k >= 0 && memcmp(s->fixed.maps[k].code, s->work.code, MODEL_M) == 0;
}
#endif

/* Put z where it is known exactly, and judge (z, l) with its index set: 1 where it passes, 2 where also no other index set is
   called for. ``felt``: what the unknowns err by counts too. */
static int judged(model_solver *s, int felt)
{
    int settled = 1;
#if LAW
    double *z = s->work.z;
    const double *l = s->work.l;
#if UNIT_ROWS
#if FOLLOW_ROWS
    memset(s->fixed.exact, 0, sizeof s->fixed.exact);
#endif
    /* z_j where y_i = factor z_j + c is exactly 0: stick is a difference of exactly 0 */
    for (int i = 0; i < MODEL_UNIT; i++)
        if (s->work.code[unit_row[i]] == 0) {
            z[unit_column[i]] = -s->fixed.Y_0[unit_row[i]]/unit_factor[i];
#if FOLLOW_ROWS
            s->fixed.exact[unit_column[i]] = 1;
#endif
        }
#endif
#if FOLLOW_ROWS
    for (int i = 0; i < MODEL_FOLLOW; i++) {
        double known = s->fixed.E_0[follow_row[i]];
        int exact = 1;
        for (int k = follow_start[i]; k < follow_start[i + 1]; k++) {
#if LENGTHS
            known += AT.E_z[MODEL_N*follow_row[i] + follow_column[k]]*z[follow_column[k]];
#else
            known += follow_entry[k]*z[follow_column[k]];
#endif
            exact &= s->fixed.exact[follow_column[k]];
        }
        if (exact)
#if LENGTHS
            z[follow_row[i]] = -known/AT.E_z[(MODEL_N + 1)*follow_row[i]];
#else
            z[follow_row[i]] = -known/follow_own[i];
#endif
    }
#endif
#if REST_ROWS
    int moving = 0;
    for (int i = 0; i < MODEL_REST; i++)
        moving |= s->work.code[rest_row[i]] != 0;
    if (!moving)
        memset(z, 0, sizeof s->work.z);
#endif
    residuals(s, s->fixed.E_0, s->fixed.Y_0, z, l, s->fixed.E, s->fixed.Y);
#else
    residuals(s, s->fixed.E_0, s->work.z, s->fixed.E);
#endif
    s->fixed.looked = 0;
    if (felt)
        add_felt(s);
    double residual = dynamics_residual(s);
#if LAW
    scale_Y(s, l, s->fixed.terms);
#if CURVED
    residual = worse_of(residual, residual_of_law(s));
#else
    residual = worse_of(residual, box_residual(s, &settled));
#endif
#if PROJECTION
    residual = worse_of(residual, gap_residual(s));
#endif
    for (int i = 0; i < MODEL_M; i++)
        s->work.y[i] = s->work.code[i] == 0 ? 0.0 : s->fixed.Y[i];
#endif
    s->work.residual = residual;
    s->work.iterations = 1;
#if FIXED_MAPS
    if (residual > EXPLAINED && on_map(s) && s->fixed.maps[s->fixed.current].singular)
        return 0; /* one of many solutions, or none: only what is exact to rounding tells */
#endif
    return residual <= TOLERANCE ? 1 + settled : 0;
}

/* The solution of E_z dz + E_l dl = -E, Y_z dz + Y_l dl = -Y on the rows coded 0, dl = 0 on the others. */
#if LAW
static void correction(model_solver *s, const double *E, const double *Y, double *restrict dz, double *restrict dl)
{
    predict(s, E, Y, s->fixed.step, s->fixed.terms);
    memset(dl, 0, sizeof s->work.l);
#if FIXED_MAPS
    const int k = s->fixed.current;
    if (on_map(s)) {
        const int n = s->fixed.maps[k].n, *free = s->fixed.maps[k].free;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                dl[free[i]] -= s->fixed.maps[k].inverse[n*i + j]*s->fixed.terms[free[j]];
    }
#endif
    respond(s, s->fixed.step, dl, dz);
}
#else
static void correction(model_solver *s, const double *E, double *restrict dz) { predict(s, E, dz); }
#endif

/* Correct (z, l) by what E and Y are there. */
static void correct(model_solver *s)
{
#if LAW
#if UNIT_ROWS
    for (int i = 0; i < MODEL_UNIT; i++)
        if (s->work.code[unit_row[i]] == 0) /* by which z is exact: as near as doubles come */
            s->fixed.Y[unit_row[i]] = 0;
#endif
    correction(s, s->fixed.E, s->fixed.Y, s->fixed.dz, s->fixed.dl);
    for (int i = 0; i < MODEL_M; i++)
        s->work.l[i] += s->fixed.dl[i];
#else
    correction(s, s->fixed.E, s->fixed.dz);
#endif
    for (int i = 0; i < MODEL_N; i++)
        s->work.z[i] += s->fixed.dz[i];
}

/* Certify s->work.l with s->work.code: 1 where the step passes, 2 where also no other index set is called for. */
static int certified(model_solver *s)
{
#if LAW
    respond(s, s->fixed.z_0, s->work.l, s->work.z);
#else
    memcpy(s->work.z, s->fixed.z_0, sizeof s->work.z);
#endif
    int passed = judged(s, 0);
#if FIXED_MAPS
    const int k = s->fixed.current, fragile = k >= 0 && s->fixed.maps[k].fragile && on_map(s);
    for (int i = 0; i < REFINEMENTS && fragile && s->work.residual < INFINITY && spend(s); i++) {
        if (i >= FRAGILE_REFINEMENTS && s->work.residual <= EXPLAINED)
            break;
        correct(s);
        passed = judged(s, 0);
    }
#endif
    return passed;
}

#if FIXED_MAPS
/* The map l = offset - inverse b on an index set, from the few that are kept; -1 where a bound is infinite. */
static int find_map(model_solver *s, const signed char *code)
{
    if (s->fixed.current >= 0 && memcmp(s->fixed.maps[s->fixed.current].code, code, MODEL_M) == 0)
        return s->fixed.current;
    for (int k = 0; k < s->fixed.filled; k++)
#if LENGTHS
        if (s->fixed.maps[k].length == s->fixed.length && memcmp(s->fixed.maps[k].code, code, MODEL_M) == 0)
#else
        if (memcmp(s->fixed.maps[k].code, code, MODEL_M) == 0)
#endif
            return s->fixed.current = k;
#if WORST_CASE
    if (s->fixed.filled == MODEL_MAPS)
        return -1;
#endif
    int k = s->fixed.filled < MODEL_MAPS ? s->fixed.filled : s->fixed.oldest;
    int n = 0;
    for (int i = 0; i < MODEL_M; i++) {
        double bound = code[i] < 0 ? lower[i] : code[i] > 0 ? upper[i] : 0.0;
        if (!is_finite(bound))
            return -1;
        s->fixed.maps[k].code[i] = 2; /* no code: the entry is being written */
        s->fixed.maps[k].at_bound[i] = bound;
        if (code[i] == 0)
            s->fixed.maps[k].free[n++] = i;
    }
    const int *free = s->fixed.maps[k].free;
    double *inverse = s->fixed.maps[k].inverse, *offset = s->fixed.maps[k].offset;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            s->fixed.block[n*i + j] = output_map[MODEL_M*free[i] + free[j]];
    const int inverted = n > 0 ? invert(s, n, s->fixed.block, inverse) : 0;
    if (inverted > 0)
        return -1;
    s->fixed.maps[k].singular = inverted < 0;
    for (int i = 0; i < n; i++) {
        offset[i] = 0;
        for (int j = 0; j < n; j++) {
            double shift = 0;
            for (int c = 0; c < MODEL_M; c++)
                shift += output_map[MODEL_M*free[j] + c]*s->fixed.maps[k].at_bound[c];
            offset[i] -= inverse[n*i + j]*shift;
        }
    }
    double condition = 0;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            condition += fabs(inverse[n*i + j]*s->fixed.block[n*j + i]);
    s->fixed.maps[k].fragile = !(condition <= FRAGILE*n);
    s->fixed.maps[k].n = n;
    memcpy(s->fixed.maps[k].code, code, MODEL_M);
#if LENGTHS
    s->fixed.maps[k].length = s->fixed.length;
#endif
    if (s->fixed.filled < MODEL_MAPS)
        s->fixed.filled++;
    else
        s->fixed.oldest = (s->fixed.oldest + 1) % MODEL_MAPS;
    return s->fixed.current = k;
}

/* Put l on the index set of a map. */
static void follow_map(model_solver *s, int k)
{
    const int n = s->fixed.maps[k].n;
    const int *free = s->fixed.maps[k].free;
    const double *inverse = s->fixed.maps[k].inverse, *offset = s->fixed.maps[k].offset, *b = s->fixed.b;
    memcpy(s->work.l, s->fixed.maps[k].at_bound, sizeof s->work.l);
    for (int i = 0; i < n; i++) {
        double sum = 0;
        for (int j = 0; j < n; j++)
            sum += inverse[n*i + j]*b[free[j]];
        s->work.l[free[i]] = offset[i] - sum;
    }
    memcpy(s->work.code, s->fixed.maps[k].code, MODEL_M);
}

/* Put l on an index set; 0 where the set has no map. */
static int on_index_set(model_solver *s, const signed char *code)
{
    const int k = spend(s) ? find_map(s, code) : -1;
    if (k >= 0)
        follow_map(s, k);
    return k >= 0;
}

#endif

/* The largest corrections of probes, which are E and Y with signs that look random: what z and l err by where the rows do so by
   E and Y, from below; and in passed_E and passed_Y the most that the rows feel of one of them. */
#if LAW
static void felt_by(model_solver *s, const double *E, const double *Y)
#else
static void felt_by(model_solver *s, const double *E)
#endif
{
    memset(s->fixed.felt_z, 0, sizeof s->fixed.felt_z);
    memset(s->fixed.passed_E, 0, sizeof s->fixed.passed_E);
#if LAW
    memset(s->fixed.felt_l, 0, sizeof s->fixed.felt_l);
    memset(s->fixed.passed_Y, 0, sizeof s->fixed.passed_Y);
#endif
    for (int p = 0; p < PROBES; p++) {
        for (int i = 0; i < MODEL_N; i++)
            s->fixed.probe_E[i] = probe_sign(i, p)*E[i];
#if LAW
        for (int i = 0; i < MODEL_M; i++)
            s->fixed.probe_Y[i] = probe_sign(MODEL_N + i, p)*Y[i];
        correction(s, s->fixed.probe_E, s->fixed.probe_Y, s->fixed.dz, s->fixed.dl);
        passed_on(s, s->fixed.dz, s->fixed.dl, s->fixed.probe_E, s->fixed.probe_Y);
        for (int i = 0; i < MODEL_M; i++) {
            s->fixed.felt_l[i] = worse_of(s->fixed.felt_l[i], fabs(s->fixed.dl[i]));
            s->fixed.passed_Y[i] = worse_of(s->fixed.passed_Y[i], fabs(s->fixed.probe_Y[i]));
        }
#else
        correction(s, s->fixed.probe_E, s->fixed.dz);
        passed_on(s, s->fixed.dz, s->fixed.probe_E);
#endif
        for (int i = 0; i < MODEL_N; i++) {
            s->fixed.felt_z[i] = worse_of(s->fixed.felt_z[i], fabs(s->fixed.dz[i]));
            s->fixed.passed_E[i] = worse_of(s->fixed.passed_E[i], fabs(s->fixed.probe_E[i]));
        }
    }
}

/* Add to the error bounds of the rows what they feel of that of the unknowns; nothing where rounding could excuse any row. */
static void add_felt(model_solver *s)
{
    double condition = 0;
    look_at_rounding(s);
#if LAW
    felt_by(s, unit_size_E, unit_size_Y);
    for (int i = 0; i < MODEL_M; i++)
        condition = worse_of(condition, s->fixed.felt_l[i]/unit_l[i]);
#else
    felt_by(s, unit_size_E);
#endif
    for (int i = 0; i < MODEL_N; i++)
        condition = worse_of(condition, s->fixed.felt_z[i]/unit_z[i]);
    if (!(condition <= WORTH))
        return;
#if LAW
    felt_by(s, s->fixed.error_E, s->fixed.error_Y);
    for (int i = 0; i < MODEL_M; i++)
        s->fixed.error_Y[i] += s->fixed.passed_Y[i];
#else
    felt_by(s, s->fixed.error_E);
#endif
    for (int i = 0; i < MODEL_N; i++)
        s->fixed.error_E[i] += s->fixed.passed_E[i];
}

/* Where an answer fails by rounding alone: correct (z, l) by what E and Y are there, and judge it again, at last with what its
   unknowns err by. Return whether it passes. */
static int refined(model_solver *s)
{
    for (int refinement = 0; refinement < REFINEMENTS && s->work.residual < INFINITY && spend(s); refinement++) {
        correct(s);
        if (judged(s, 0))
            return 1;
    }
    return spend_on_probes(s) && judged(s, 1);
}

#if ENUMERATED
/* The codes of an index set, by its number. */
static void numbered_set(int set, signed char *code)
{
    for (int i = 0; i < MODEL_M; i++) {
        code[i] = choices[i][set % choice_count[i]];
        set /= choice_count[i];
    }
}

/* How many codes differ from those of the last index set. */
static int changes_to(const model_solver *s, const signed char *code)
{
    int different = 0;
    for (int i = 0; i < MODEL_M; i++)
        different += code[i] != s->index[i];
    return different;
}

#if WORST_CASE
/* The inverses of all index sets, in their order: what a step needs of linear systems. */
static void form_maps(model_solver *s)
{
    for (int set = 0; set < MODEL_SETS; set++) {
        s->fixed.current = -1;
        numbered_set(set, s->fixed.code);
        if (find_map(s, s->fixed.code) < 0)
            s->fixed.filled++; /* it has none */
    }
}

/* How far l and y = W l + b are from what the index set at hand says, in units of y. */
static double violation(const model_solver *s)
{
    const double *l = s->work.l;
    double worst = 0;
    for (int i = 0; i < MODEL_M; i++) {
        const int code = s->work.code[i];
        const double y = s->fixed.b[i] + dot(MODEL_M, output_map + MODEL_M*i, l);
        const double out = max_of(max_of(lower[i] - l[i], l[i] - upper[i]), 0);
        worst = worse_of(worst, code == 0 ? fabs(y) : code*y);
        worst = worse_of(worst, code == 0 ? w_root[i]*w_root[i]*out : 0);
    }
    return worst;
}

/* Take the index set that is least violated, of several the nearest to the last one: as much work whichever it is. */
static int least_violated(model_solver *s)
{
    const double rounding = SUM_ERROR*MODEL_M*EPS*largest(MODEL_M, s->fixed.b);
#if LENGTHS
    const int first = MODEL_SETS*s->fixed.length;
#else
    const int first = 0;
#endif
    double least = INFINITY;
    int fewest = 0, best = -1;
    for (int k = first; k < first + MODEL_SETS && spend(s); k++) {
        if (s->fixed.maps[k].code[0] == 2)
            continue;
        follow_map(s, k);
        const double found = violation(s), wrong = found <= rounding ? 0 : found;
        const int changes = changes_to(s, s->work.code);
        if (wrong < least || (wrong == least && changes < fewest)) {
            least = wrong;
            fewest = changes;
            best = k;
        }
    }
    if (best < 0)
        return NONE;
    s->fixed.current = best;
    follow_map(s, best);
    return certified(s) || refined(s) ? ENUMERATION : NONE;
}
#else
/* Try every index set, those nearest to the last one first; where none is settled, one that is certified will do. */
static int nearest_index_set(model_solver *s)
{
    signed char *code = s->fixed.code;
    for (int strict = 1; strict >= -1; strict--) /* in the end refined, too */
        for (int changes = 0; changes <= MODEL_M; changes++)
            for (int set = 0; set < MODEL_SETS; set++) {
                numbered_set(set, code);
                if (changes_to(s, code) == changes && on_index_set(s, code) && (strict < 0 ? certified(s) || refined(s) : certified(s) > strict))
                    return ENUMERATION;
            }
    return NONE;
}
#endif
#endif

#if SETTLED
/* From an answer that passes though rows contradict their codes by more than rounding: change the last of them until none does,
   which ends for P-matrices (Murty 1974). Of rows coded 0 that cannot all be held, those left open are let go. */
static int settle(model_solver *s)
{
    signed char *code = s->fixed.called;
    memcpy(code, s->work.code, sizeof s->fixed.called);
    for (int sweep = 0; sweep < 2*MODEL_M; sweep++) {
        int wrong = -1, next = 0;
        look_at_rounding(s);
        for (int i = 0; i < MODEL_M; i++) {
            const double y = s->fixed.Y[i], l = s->work.l[i], unseen = ROUND_OFF*s->fixed.error_Y[i];
            int called = code[i];
            if (code[i] != 0)
                called = code[i]*y > unseen ? 0 : code[i];
            else if (l < lower[i] || (y > unseen && lower[i] > -INFINITY))
                called = -1;
            else if (l > upper[i] || (y < -unseen && upper[i] < INFINITY))
                called = 1;
            if (called != code[i]) {
                wrong = i;
                next = called;
            }
        }
        if (wrong < 0)
            return 0;
        code[wrong] = (signed char)next;
        if (!on_index_set(s, code))
            return 0;
        if (certified(s) == 2)
            return 1;
    }
    return 0;
}

#endif
/* The step; the solver whose answer was certified, or NONE. */
static int step_by_matrices(model_solver *s)
{
#if LENGTHS
    if (!find_matrices(s))
        return NONE;
#endif
#if LAW
    constant_part(s, s->fixed.E_0, s->fixed.Y_0);
    predict(s, s->fixed.E_0, s->fixed.Y_0, s->fixed.z_0, s->fixed.b);
#if FIXED_MAPS
    if (on_index_set(s, s->index) && certified(s) == 2)
        return LAST_INDEX_SET;
#endif
#if WORST_CASE
    return all_finite(MODEL_M, s->fixed.b) ? least_violated(s) : NONE;
#else
#if ENUMERATED
    return all_finite(MODEL_M, s->fixed.b) ? nearest_index_set(s) : NONE;
#else
    memcpy(s->fixed.l, s->l, sizeof s->l);
    memcpy(s->fixed.code, s->index, sizeof s->index);
    int solver = affine_solve(s, MODEL_M, output_map, s->fixed.b, lower, upper, s->fixed.l, s->fixed.code, TOLERANCE/STRICTER);
#if SETTLED
    const int passed = on_index_set(s, s->fixed.code) ? certified(s) : 0;
    if (passed == 2 || (passed && settle(s)))
        return solver == NONE ? INDEX_SET : solver;
    if (on_index_set(s, s->fixed.code) && (certified(s) || refined(s)))
        return solver == NONE ? INDEX_SET : solver;
#endif
    memcpy(s->work.l, s->fixed.l, sizeof s->work.l);
    memcpy(s->work.code, s->fixed.code, sizeof s->work.code);
    return certified(s) || refined(s) ? (solver == NONE ? INDEX_SET : solver) : NONE;
#endif
#endif
#else
    constant_part(s, s->fixed.E_0);
    predict(s, s->fixed.E_0, s->fixed.z_0);
    return certified(s) || refined(s) ? NONE_NEEDED : NONE;
#endif
}
