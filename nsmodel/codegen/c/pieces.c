/* One piece after another: event_driven/integrator.py, step_size.py, piece_bounds.py. */

/* What a piece is, as numbers: the last state; an event with its jump; the sizes that rows are measured beside; coefficients. */
enum {
    AT_T, AT_TAU, AT_S, AT_DEFECT, AT_EVENT, AT_EVENT_WIDTH, AT_RESIDUAL, AT_IMPULSE, AT_CODES = AT_IMPULSE + M, AT_SIZE_Y = AT_CODES + M,
    AT_SIZE_L = AT_SIZE_Y + M, AT_LAST = AT_SIZE_L + M, AT_C = AT_LAST + N
};

static int expand_finite(model_pieces *s, int orders)
{
    for (int pass = 0; pass < UNITS; pass++) {
        if (!expand(s, orders))
            return MODEL_NO_MODE;
        if (all_finite(N, s->c[orders]))
            return MODEL_OK;
        s->at.tau = ldexp(s->at.tau, -OCTAVES);
    }
    return MODEL_NOT_FINITE;
}

/* All orders at the place, of which the mode's choice has left some. */
static int expand_piece(model_pieces *s)
{
    const int known = s->at.known;
    s->at.known = 0;
#if LINEAR
    if (known) {
        extend(s, known, s->order);
        if (all_finite(N, s->c[s->order]))
            return MODEL_OK;
    }
#else /* the series of a run that goes on from here is expanded from l as it is now */
    UNUSED(known);
#endif
    return expand_finite(s, s->order);
}

/* A row: its column, how many terms are known, its size so far, what it is asked for, and what is rounding. */
typedef struct {
    int column, known;
    double size, rtol, more, rounding;
} measured;

/* The length that a row of size 0, measured beside its first term, lets a piece have; *late: that is none of the first half. */
static double length_from_0(const model_pieces *s, const measured *row, int *late)
{
    const int column = row->column, n = row->known;
    double longest = LONGEST;
    int k = 0;
    while (k < n && s->c[k][column] == 0)
        k++;
    *late = k >= n/2;
    if (k == n)
        return longest;
    const double least = max_of((*late ? 1 : row->rtol)*fabs(s->c[k][column]), row->rounding);
    const double last = fabs(s->c[n][column]), before = fabs(s->c[n - 1][column]);
    if (last != 0)
        longest = min_of(longest, pow(least/last, 1.0/(n - k)));
    if (before != 0 && n - 1 > k)
        longest = min_of(longest, pow(least/before, 1.0/(n - 1 - k)));
    return longest;
}

/* What a row is asked for over its term k, with its size on a piece of this length. */
static double ratio_on(const model_pieces *s, const measured *row, int k, double length)
{
    double size = row->size, raised = length;
    for (int j = 1; j < row->known/2; j++) {
        const double term = fabs(s->c[j][row->column])*raised;
        size = term > size ? term : size;
        raised *= length;
    }
    return max_of(row->rtol*size + row->more, row->rounding)/fabs(s->c[k][row->column]);
}

/* The longest s, no longer than this, with s^k at most least[k - first]: roots are drawn where they are shorter alone. */
static double shortest(const double *least, int first, double s)
{
    for (int e = 0; e < EXPONENTS; e++) {
        if (raised_to(s, first + e) > least[e])
            s = pow(least[e], 1.0/(first + e));
    }
    return s;
}

/*
 * The length of the piece in units of time: the last two terms of x, l, y and what switches look at are what is asked for. The size of a row is not less
 * than so far, so that only a row that would be the shortest with that needs its size on the piece.
 */
static double length_of(model_pieces *s)
{
    measured rows[N + M + CHOICES];
    const int p = s->order;
    int which[EXPONENTS] = {0};
    double ratio[N + M + CHOICES][2], least[EXPONENTS] = {INFINITY, INFINITY, INFINITY}; /* of goal/|c_k|, by k = p - 2, p - 1, p */
    double length = LONGEST, longest = LONGEST;
    signed char early[N + M + CHOICES] = {0}; /* rows of size 0 so far that the piece gives a size */
    int begins = 0;
    pushes(s, s->pushed);
    for (int i = 0; i < N; i++)
        rows[i] = (measured){i, p, s->at.size_x[i], s->rtol, s->atol[i], TERM_ROUNDING*s->pushed[i] + NOTHING};
#if LAW
    const int known = HOW.through ? p - 1 : p;
    double y_floor = 0, l_floor = 0;
    for (int i = 0; i < M; i++) {
        y_floor = max_of(y_floor, SMALL*s->at.size_y[i]);
        l_floor = max_of(l_floor, SMALL*s->at.size_l[i]);
    }
    for (int i = 0; i < M; i++)
        rows[N + i] = s->at.codes[i] ? (measured){Y + i, p, max_of(s->at.size_y[i], y_floor), MULTIPLIERS*s->rtol, 0, 0}
                                     : (measured){L + i, known, max_of(s->at.size_l[i], l_floor), MULTIPLIERS*s->rtol, 0, 0};
#endif
#if SWITCHED
    for (int b = 0; b < CHOICES; b++)
        rows[N + M + b] = (measured){branch_column[b], p - 1, s->at.size_switches[b], MULTIPLIERS*s->rtol, 0, 0};
#endif
    for (int i = 0; i < N + M + CHOICES; i++) {
        measured *row = &rows[i];
        const double first = fabs(s->c[0][row->column]);
        row->size = first > row->size ? first : row->size;
        const double goal = row->rtol*row->size + row->more;
        if (goal == 0) {
            int late;
            const double first_term = length_from_0(s, row, &late);
            length = min_of(length, first_term);
            longest = late ? min_of(longest, first_term) : longest;
            early[i] = !late;
            begins |= !late;
        }
        for (int e = 0; e < 2; e++) {
            const double a = fabs(s->c[row->known - e][row->column]);
            const int at = row->known - e - p + 2;
            ratio[i][e] = goal != 0 && a != 0 ? max_of(goal, row->rounding)/a : INFINITY;
            if (ratio[i][e] < least[at]) {
                least[at] = ratio[i][e];
                which[at] = i;
            }
        }
    }
    length = shortest(least, p - 2, length);
    for (int pass = 1; pass < PASSES; pass++) {
        const double before = length;
        double now[EXPONENTS];
        for (int e = 0; e < EXPONENTS; e++)
            now[e] = least[e] < INFINITY ? ratio_on(s, &rows[which[e]], p - 2 + e, length) : INFINITY;
        if (!begins && memcmp(now, least, sizeof now) == 0)
            break;
        for (int i = 0; i < N + M + CHOICES; i++)
            for (int e = 0; e < 2; e++) {
                const int k = rows[i].known - e;
                const int asked = early[i] ? s->c[k][rows[i].column] != 0 : ratio[i][e] < now[k - p + 2];
                if (asked)
                    now[k - p + 2] = min_of(now[k - p + 2], ratio_on(s, &rows[i], k, before));
            }
        memcpy(least, now, sizeof now);
        length = shortest(least, p - 2, longest);
        if (length == before)
            break;
    }
    return length;
}

/* What the slope of state i is the sum of. */
static double size_of_slope(const model_pieces *s, int i, double at)
{
    double most = 0;
    for (int k = s->order; k >= 1; k--)
        most = most*at + fabs(k*s->c[k][i]);
    return most;
}

/* The largest share that off is of what it may be at most, beyond rounding; rates: what x' is the sum of. */
static double missed_of(model_pieces *s, const double *off, const double *most, double at, const double *rates, int *known)
{
    double worst = 0;
    for (int i = 0; i < N; i++) {
        double seen = fabs(off[i]);
        if (!(seen <= LOCAL*most[i]))
            seen -= SEEN*(size_of_slope(s, i, at) + s->at.tau*rates[i]);
        if (!(seen <= most[i]))
            seen -= bound_of(s, known)[i];
        if (!(seen <= 0))
            worst = max_of(worst, most[i] != 0 && seen == seen ? seen/most[i] : INFINITY);
    }
    return worst;
}

#if LAW
/* Take the part of off along g_l of held rows away: the error of l, in units of rtol. */
static double split(const model_pieces *s, double *off, const double *l)
{
    double of_y[M], d[M], along[M], worst = 0;
    if (!HOW.through)
        return 0;
    memset(along, 0, sizeof along);
    for (int a = 0; a < HOW.n; a++)
        of_y[HOW.active[a]] = slope_along(s, HOW.active[a], off);
    through(s, of_y, 1, d);
    for (int a = 0; a < HOW.n; a++) {
        const int i = HOW.active[a];
        const double size = max_of(size_l(s, i), fabs(l[i]));
        along[i] = d[a];
        if (size != 0)
            worst = max_of(worst, (fabs(d[a])/s->at.tau - SEEN_ROW*size)/(MULTIPLIERS*s->rtol*size));
    }
    add_push(s, off, along);
    return worst;
}
#endif

/* An estimate of the local error in units of rtol, from |x' - f - g|, |y| of held rows and l at a point of a piece of this length. */
static double defect_of(model_pieces *s, double length)
{
    const int p = s->order;
    double worst = 0, y[M + 1], off[N], most[N], rates[N];
    const double at = POINT*length;
    int known = 0;
    double *value = s->value, *slope = s->slope;
    for (int i = 0; i < N; i++) {
        double v = s->c[p][i], d = p*v;
        for (int k = p - 1; k >= 1; k--) {
            const double c = s->c[k][i];
            v = v*at + c;
            d = d*at + k*c;
        }
        value[i] = v*at + s->c[0][i];
        slope[i] = d;
    }
#if LAW
    values_at(s->c[0] + L, COLUMNS, p, at, M, value + L);
    for (int i = 0; i < M; i++)
        if (s->at.codes[i])
            value[L + i] = s->c[0][L + i];
#endif
    s->now[0] = s->at.t + s->at.tau*at;
    equations(s, s->now, value, value + N, s->f, y);
    for (int i = 0; i < N; i++) {
        const double largest = max_of(max_of(s->at.size_x[i], s->later[i]), max_of(fabs(value[i]), fabs(slope[i]*length)));
        most[i] = s->share*(p + 1)/length*(s->rtol*largest + s->atol[i] + NOTHING)/LOCAL;
        off[i] = slope[i] - s->at.tau*s->f[i];
        rates[i] = fabs(s->f[i]);
    }
    double missed = missed_of(s, off, most, at, rates, &known);
#if LAW
    if (!(missed <= 1)) { /* where x rests, that may be an error of l alone */
        worst = max_of(worst, split(s, off, value + L));
        add_pushed(s, rates, value + L);
        missed = missed_of(s, off, most, at, rates, &known);
    }
#endif
    worst = max_of(worst, missed/LOCAL);
#if LAW
    double of_x[N], of_l[M];
    int any = 0;
    for (int i = 0; i < M; i++)
        any |= s->at.codes[i] == 0 && y[i] != 0;
    if (!any)
        return worst;
    for (int i = 0; i < N; i++)
        of_x[i] = max_of(s->at.size_x[i], fabs(value[i]));
    for (int i = 0; i < M; i++)
        of_l[i] = max_of(s->at.size_l[i], fabs(value[L + i]));
    for (int i = 0; i < M; i++)
        if (s->at.codes[i] == 0 && y[i] != 0) {
            double of = max_of(s->at.size_y[i], terms_of(s, i, of_x, of_l));
            double beyond = fabs(y[i]) - SEEN_ROW*of;
            if (beyond > MULTIPLIERS*s->rtol*of/LOCAL) {
                memset(rates, 0, sizeof rates);
                add_pushed(s, rates, value + L);
                of = max_of(of, s->at.tau*at*terms_of_x(s, i, rates));
                beyond = fabs(y[i]) - SEEN_ROW*of - at*terms_of_x(s, i, bound_of(s, &known));
            }
            worst = max_of(worst, beyond/(MULTIPLIERS*s->rtol*of + NOTHING));
        }
#endif
    return worst;
}

/* What states that begin at 0 come to at the end of a series of this length, and what f moves them by there. */
static void coming(model_pieces *s, double length)
{
    double y[M + 1];
    values_at(s->c[0], COLUMNS, s->order, length, N, s->value);
#if LAW
    values_at(s->c[0] + L, COLUMNS, s->order, length, M, s->value + L);
    for (int i = 0; i < M; i++)
        if (s->at.codes[i])
            s->value[L + i] = s->c[0][L + i];
#endif
    s->now[0] = s->at.t + s->at.tau*length;
    equations(s, s->now, s->value, s->value + N, s->f, y);
    for (int i = 0; i < N; i++) {
        int moves = 0;
        for (int k = 0; k < (s->order + 1)/2; k++)
            moves |= s->c[k][i] != 0;
        s->later[i] = s->c[0][i] != 0 ? 0 : moves ? max_of(fabs(s->value[i]), s->at.tau*length*fabs(s->f[i])) : INFINITY;
    }
}

/* What ends a piece of this length at most: *found and hit; its error in units of rtol. */
static int accept(model_pieces *s, double *length, double *tried, condition *hit, int *found, double *error)
{
    double proved = 0;
    if (s->estimated) {
        const int status = prove(s, length, &proved);
        if (status)
            return status;
    }
    const double whole = *length, now = AS_NOW*fabs(s->at.t)/s->at.tau; /* in which nothing moves: time is not known better */
    memset(s->later, 0, sizeof s->later);
    for (int pass = 0; pass < SHORTENINGS; pass++) {
        *tried = *length;
        *found = first_event(s, length, hit, s->margins, -1);
        *error = s->estimated ? LOCAL*defect_of(s, *length) : 0;
        if (pass == 0 && !(*error <= 1)) {
            coming(s, *length);
            *error = LOCAL*defect_of(s, *length);
        }
        if (*error <= 1 || (*length <= now && (*error < INFINITY || rests_here(s)))) { /* nothing moves */
            *error = max_of(min_of(*error, 1), whole > 0 ? *length == whole ? proved : proved*pow(*length/whole, s->order) : 0);
            return MODEL_OK;
        }
        *length = max_of(*length*min_of(0.5, CAUTION*pow(*error, -1.0/s->order)), now);
        if (s->at.t + s->at.tau**length == s->at.t)
            break;
    }
    return MODEL_TOO_SHORT;
}

/* Note what the rows come to at s of a piece, and what moves x in this time of a series; x at s into s->value. */
static void grow(model_pieces *s, double length, double time)
{
    double moved[N], of_x[N];
    values_at(s->c[0], COLUMNS, s->order, length, ROWS, s->value);
    for (int i = 0; i < N; i++)
        s->at.size_x[i] = max_of(s->at.size_x[i], max_of(fabs(s->value[i]), fabs(s->c[0][i])));
#if LAW
    for (int i = 0; i < M; i++) {
        s->at.size_y[i] = max_of(s->at.size_y[i], max_of(fabs(s->value[Y + i]), fabs(s->c[0][Y + i])));
        s->at.size_l[i] = max_of(s->at.size_l[i], max_of(fabs(s->value[L + i]), fabs(s->c[0][L + i])));
    }
#endif
    pushes(s, s->pushed);
    for (int i = 0; i < N; i++) /* and what is left of x that held rows let rest */
        of_x[i] = max_of(s->at.size_x[i], TERM_ROUNDING*time/s->at.tau*s->pushed[i]);
    s->now[0] = s->c[0][T];
    moves(s, s->now, s->c[0], s->c[0] + L, of_x, moved);
    for (int i = 0; i < N; i++)
        if (is_finite(moved[i]))
            s->at.size_x[i] = max_of(s->at.size_x[i], NEGLIGIBLE*time*moved[i]);
#if SWITCHED
    sizes_of_switches(s);
#endif
}

#if LAW
#if GENERAL
/* Whether y is rounding in n rows, and the motion more than that: rows that are nearly parallel move x by many times it. */
static int moves_by_rounding(const model_pieces *s, int n, const int *a, const double *motion)
{
    double of_x[N], of_l[M];
    for (int j = 0; j < N; j++)
        of_x[j] = fabs(s->c[0][j]);
    for (int j = 0; j < M; j++)
        of_l[j] = fabs(s->c[0][L + j]);
    for (int i = 0; i < n; i++)
        if (!(fabs(s->c[0][Y + a[i]]) <= TERM_ROUNDING*terms_of(s, a[i], of_x, of_l)))
            return 0;
    for (int j = 0; j < N; j++)
        if (fabs(motion[j]) > TIE*max_of(of_x[j], s->at.size_x[j]))
            return 1;
    return 0;
}
#endif

/* Move x so that what no l acts on directly is 0 in these rows, along the least motion. */
static void project(model_pieces *s, const signed char *rows)
{
#if ORTHOGONAL
    for (int pass = 0; pass < PROJECTIONS; pass++) {
        int any = 0;
        memcpy(s->c[0], s->at.x, sizeof s->at.x);
        s->c[0][T] = s->at.t;
        h_first(s);
        for (int i = 0; i < M; i++) {
            const double y = s->c[0][Y + i];
            double sum = 0;
            if (!rows[i] || y == 0)
                continue;
            any = 1;
            for (int e = C_start[i]; e < C_start[i + 1]; e++)
                sum += C_value[e]*C_value[e];
            for (int e = C_start[i]; e < C_start[i + 1]; e++)
                s->at.x[C_column[e]] -= C_value[e]*(y/sum);
        }
        if (!any)
            break;
    }
#else
    for (int pass = 0; pass < PROJECTIONS; pass++) {
        int a[M], n = 0, any = 0, rank = 0, q = 0;
        double y[M], *U = s->work_u;
        for (int i = 0; i < M; i++)
            if (rows[i])
                a[n++] = i;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                s->work_a[i*n + j] = D_AT(a[i], a[j]);
        if (n)
            rank = generalised_inverse(n, s->work_a, s->work_b, U, s->work_v);
        for (int u = 0; u < n - rank; u++) { /* the combinations that no l acts on, made orthogonal one after the other */
            double *row = s->row + q*N, size = 0, rest = 0, terms[N];
            y[q] = 0;
            memset(row, 0, N*sizeof *row);
            memset(terms, 0, sizeof terms);
            for (int i = 0; i < n; i++) {
                const double weight = U[i*n + rank + u];
                y[q] += weight*s->c[0][Y + a[i]];
                for (int j = 0; j < N; j++) {
                    row[j] += weight*C_AT(a[i], j);
                    terms[j] += fabs(weight*C_AT(a[i], j));
                }
            }
            any |= y[q] != 0;
            for (int j = 0; j < N; j++) {
                if (fabs(row[j]) <= TIE*terms[j]) /* rounding, as y of rows that are the same: their quotient would be any motion */
                    row[j] = 0;
                size += row[j]*row[j];
            }
            for (int v = 0; v < q; v++) {
                double dot = 0;
                for (int j = 0; j < N; j++)
                    dot += s->row[v*N + j]*row[j];
                for (int j = 0; j < N; j++)
                    row[j] -= dot*s->row[v*N + j];
                y[q] -= dot*y[v];
            }
            for (int j = 0; j < N; j++)
                rest += row[j]*row[j];
            if (!(rest > DEPENDENT*size))
                continue;
            rest = sqrt(rest);
            for (int j = 0; j < N; j++)
                row[j] /= rest;
            y[q++] /= rest;
        }
        if (!any)
            break;
        double motion[N];
        memset(motion, 0, sizeof motion);
        for (int v = 0; v < q; v++)
            for (int j = 0; j < N; j++)
                motion[j] += y[v]*s->row[v*N + j];
        if (moves_by_rounding(s, n, a, motion))
            break;
        for (int j = 0; j < N; j++)
            s->at.x[j] -= motion[j];
        expand(s, 1);
    }
#endif
}
#endif

#if LAW
/* Move x back to y = 0 in rows that only y' holds, once their drift is seen: each piece leaves its share of rtol. */
static int hold(model_pieces *s)
{
    double y[M];
    signed char rows[M];
    int seen = 0, status;
    s->now[0] = s->at.t;
    equations(s, s->now, s->at.x, s->c[0] + L, s->f, y);
    for (int i = 0; i < M; i++) {
        rows[i] = s->at.codes[i] == 0;
        if (rows[i] && !feeds[i])
            seen |= fabs(y[i]) > s->rtol*size_y(s, i);
    }
    if (!seen)
        return MODEL_OK;
    if ((status = expand_finite(s, 1)))
        return status;
    project(s, rows);
    return MODEL_OK;
}
#endif

/* f + g where x_i is another. */
static SELDOM void rates_at(model_pieces *s, int i, double value, double rates[N])
{
    double y[M + 1];
    memcpy(s->value, s->at.x, sizeof s->at.x);
    s->value[i] = value;
    s->now[0] = s->at.t;
    equations(s, s->now, s->value, s->c[0] + L, rates, y);
}

/* Whether x_i, which rests at 0, may stay there or leave: x' = sqrt x. */
static SELDOM int may_leave_0(model_pieces *s, int i)
{
    double still[N], near[N], nearer[N];
    rates_at(s, i, 0, still);
    for (int side = -1; side <= 1; side += 2) {
        int any = 0, back = 0;
        rates_at(s, i, side*NEAR_0, near);
        rates_at(s, i, side*NEAR_0*NEAR_0, nearer);
        for (int j = 0; j < N; j++) {
            const double steep = (nearer[j] - still[j])/(NEAR_0*NEAR_0);
            const int grows = fabs(steep) > STEEPER*fabs((near[j] - still[j])/NEAR_0);
            any |= grows;
            back |= grows && j == i && side*steep < 0;
        }
        if (any && !back)
            return 1;
    }
    return 0;
}

/* Whether no l acts on a state. */
static int is_free_of_l(const model_pieces *s, int i)
{
    int unmoved = 1;
#if SLOPES
    for (int j = 0; j < M; j++)
        unmoved = unmoved && B_AT(i, j) == 0;
#endif
#if LAW
#if B_NUMBERS
    for (int e = 0; e < B_start[M]; e++)
        unmoved = unmoved && B_row[e] != i;
#endif
#endif
    UNUSED(s);
    UNUSED(i);
    return unmoved;
}

/* Note whether the mode is the only one. */
static int judge_uniqueness(model_pieces *s)
{
    for (int i = 0; i < N; i++)
        if (s->c[0][i] == 0 && s->c[1][i] == 0 && is_free_of_l(s, i) && may_leave_0(s, i))
            return MODEL_NO_MODE;
#if LAW
    if (!count_open(s, M, M + CHOICES) && is_p_matrix(s)) {
        s->at.unique[THE_ONLY_ONE] += 1;
        return MODEL_OK;
    }
#else
    if (!count_open(s, 0, CHOICES)) {
        s->at.unique[THE_ONLY_ONE] += 1;
        return MODEL_OK;
    }
#endif
    if (count_open(s, 0, M + CHOICES) > FEW) {
        s->at.unique[NOT_DECIDED] += 1;
        return MODEL_OK;
    }
    s->at.known = 0;
    const int verdict = compare_modes(s);
    if (verdict == SPLIT)
        return MODEL_NO_MODE;
    s->at.unique[verdict] += 1;
    return MODEL_OK;
}

/* Whether event n = 2^k comes as fast again as event n/2, to a part, four times over. */
static int accumulates(model_pieces *s)
{
    const long n = (long)(s->at.events += 1);
    int k = 0;
    if (n & (n - 1))
        return 0;
    while ((long)1 << k < n)
        k++;
    s->times[k] = s->at.t;
    if (n < MANY)
        return 0;
    double late = 2*(s->times[k] - s->times[k - 1])/(double)n;
    for (int i = 1; i < SPACINGS; i++) {
        const double early = 2*(s->times[k - i] - s->times[k - i - 1])/(double)(n >> i);
        if (!(late < FASTER*early))
            return 0;
        late = early;
    }
    return 1;
}

/* The first known time after t, infinite where there is none. */
static double next_known(const model_pieces *s, double t)
{
#if HELD
    const double *const known_times = s->known_at;
    const long count = s->knowns;
#else
    UNUSED(s);
#if KNOWN
    const long count = KNOWN_TIMES;
#endif
#endif
#if TIMED
    long low = 0, high = count;
    while (low < high) {
        const long middle = (low + high)/2;
        if (known_times[middle] > t)
            high = middle;
        else
            low = middle + 1;
    }
    if (low < count)
        return known_times[low];
#else
    UNUSED(t);
#endif
    return INFINITY;
}

/* Whether t is at a known time, to rounding, or beyond. */
static int reaches(double t, double known) { return known < INFINITY && t >= known*(1 - SAME_TIME); }

/* Choose the mode of the open switches; the next piece begins with an event. */
static int go_on(model_pieces *s)
{
    int status;
    if (!choose_mode(s))
        return MODEL_NO_MODE;
    s->at.known = ORDERS;
    if ((status = judge_uniqueness(s)))
        return status;
    if (s->at.begun == 0) {
        s->at.event_width = 0;
        memset(s->at.impulse, 0, sizeof s->at.impulse);
    }
    s->at.begun = 1;
    return MODEL_OK;
}

#if HELD
/* Set the held states to what they are after the known time of this number. */
static void set_held(model_pieces *s, long number)
{
    double *const held = s->at.x + N - MODEL_PIECES_HELD, *const size = s->at.size_x + N - MODEL_PIECES_HELD;
    for (int i = 0; i < MODEL_PIECES_HELD; i++) {
        held[i] = s->data[MODEL_PIECES_HELD*number + i];
        size[i] = max_of(size[i], fabs(held[i]));
    }
}

#endif
/* Stand at a known time, with the branches of the data after it, and choose the mode. */
static int cross(model_pieces *s, double known)
{
    condition all[2];
    double c[MOST_ORDERS + 1];
    s->at.t = known;
    s->at.late = 0;
#if HELD
    long number = 0;
    while (s->known_at[number] < known)
        number++;
    set_held(s, number);
#endif
    for (int b = 0; b < CHOICES; b++)
        s->at.choice[b] = NAN;
    if (!expand(s, AROUND)) {
        memset(s->at.open, 1, M + CHOICES);
        return go_on(s);
    }
    memset(s->at.open, 0, M + CHOICES);
    for (int of = 0; of < M + CHOICES; of++)
        for (int n = conditions_of(s, of, AROUND, all), i = 0; i < n; i++) {
            coefficients(s, &all[i], c);
            if (!(c[0] > TIE*max_of(size_of(s, &all[i]), largest_of(all[i].orders + 1, c))))
                s->at.open[of] = 1;
        }
    return go_on(s);
}

/* Count an event or a dip that matters at rtol, and keep the first. */
static SELDOM void note_undecided(model_pieces *s, const condition *hit, const isolated *way, int matters)
{
    const double first[] = {1, way->at, way->width, hit->of, way->crosses};
    if (matters && s->at.undecided[0] == 0)
        memcpy(s->at.undecided, first, sizeof first);
    else
        s->at.undecided[0] += matters;
}

/* The largest change of a state's rate at an event, beside its size. */
static double moves_of_event(const model_pieces *s, const double *before)
{
    const double *now = s->at.known ? s->c[1] : s->germs[1];
    double most = 0;
    for (int i = 0; i < N; i++)
        if (s->at.size_x[i] > 0)
            most = max_of(most, fabs(now[i]/s->at.tau - before[i])/s->at.size_x[i]);
    return most;
}

/* Whether no l, nor another switch, acts on what a switch looks at, nor on the rate of a row, whose l has two ends. */
static int stands_alone(const model_pieces *s, int i)
{
#if SWITCHED
    if (i >= M)
        return disc_plain[i - M];
#endif
#if LAW
    double moved[N], unit[M];
    if (SWITCHES_OF_H || !is_finite(lower[i]) || !is_finite(upper[i]))
        return 0;
    for (int j = 0; j < M; j++) {
        memset(moved, 0, sizeof moved);
        memset(unit, 0, sizeof unit);
        unit[j] = 1;
        add_push(s, moved, unit);
        if (feeds[i] || slope_along(s, i, moved) != 0)
            return 0;
    }
#else
    UNUSED(s);
    UNUSED(i);
#endif
    return 1;
}

/* Go to the event to rounding. held: rows that are. */
static int approach(model_pieces *s, const condition *hit, double end, const signed char *held, isolated *way)
{
#if LAW
    int any = 0;
    for (int i = 0; i < M; i++)
        any |= held[i];
#if !ORTHOGONAL
    int status;
    if (any && (status = arrive(s)))
        return status;
#endif
    if (any)
        project(s, held);
#else
    UNUSED(held);
#endif
    return polish(s, hit, end, way);
}

/* Turn the switches that rounding has left on the wrong side, where that side has no number, and choose the mode; where there are
   none it stays at what has failed. */
static SELDOM int past_switches(model_pieces *s, int failed)
{
    int any = 0;
#if SWITCHED
    expand(s, 0);
    for (int b = 0; b < CHOICES; b++)
        if (branch_kind[b] == SIDE && s->at.choice[b]*s->c[0][branch_column[b]] < 0) {
            s->at.open[M + b] = OPEN;
            s->at.choice[b] = -s->at.choice[b];
            any = 1;
        }
#endif
    return any ? go_on(s) : failed;
}

/* Go to the event to rounding, but not beyond a known time, and choose the mode after it. */
static int pass_event(model_pieces *s, const condition *hit, double known, double end)
{
    const model_place begin = s->at;
    condition all[2];
    isolated way;
    int status;
    double c[MOST_ORDERS + 1], after[M + CHOICES + 1], rates[N];
    signed char turned[M + CHOICES + 1] = {0}, rows[M + 1]; /* rows: those that were held, and then the open ones */
    for (int i = 0; i < M; i++)
        rows[i] = s->at.codes[i] == 0;
    if ((status = approach(s, hit, end, rows, &way))) {
        s->at = begin;
        return past_switches(s, status);
    }
    s->at.touches += way.touches;
    for (int i = 0; i < N; i++)
        rates[i] = s->c[1][i]/s->at.tau;
    if (reaches(s->at.t, known)) {
        go_along(s, time_to(s, known)/s->at.tau, AROUND);
        return cross(s, known);
    }
    if (!way.crosses) {
        s->at.begun = s->at.t > begin.t ? 0 : s->at.begun;
        note_undecided(s, hit, &way, way.touches > 0 && way.width > TOLD*s->rtol/LOCAL*fabs(s->at.t));
        return MODEL_OK;
    }
    for (int of = 0; of < M + CHOICES; of++)
        for (int n = conditions_of(s, of, AROUND, all), i = 0; i < n; i++) {
            coefficients(s, &all[i], c);
            const double moves = largest_of(all[i].orders, c + 1), least = TIE*size_of(s, &all[i]);
            const int ends = is_same(&all[i], hit);
            if (s->at.open[of] || !(ends || fabs(c[0]) <= max_of(least, TIE*moves)))
                continue;
            s->at.open[of] = OPEN;
            turned[of] = ends || moves > least;
            after[of] = all[i].after;
        }
    if (stands_alone(s, hit->of)) {
        s->at.open[hit->of] = CROSSED;
        after[hit->of] = hit->of < M ? -s->at.codes[hit->of] : after[hit->of];
    }
#if LAW
    for (int i = 0; i < M; i++)
        rows[i] = rows[i] || s->at.open[i];
    project(s, rows);
#endif
    for (int of = 0; of < M + CHOICES; of++) /* on another branch y may be another */
        if (turned[of])
            turn(s, of, after[of]);
    if ((status = go_on(s)))
        return status;
    s->at.event_width = max_of(s->at.event_width, way.width);
    if (way.width > 0)
        note_undecided(s, hit, &way, moves_of_event(s, rates)*way.width > TOLD*s->rtol/LOCAL);
    return accumulates(s) ? MODEL_NO_MODE : MODEL_OK;
}

/* The sizes that rows are measured beside, where they depend on l directly: along a piece, or after what ends it. */
static void record_sizes(model_pieces *s)
{
#if LAW
    for (int i = 0; i < M; i++) {
#if FEED
        s->piece[AT_SIZE_Y + i] = max_of(s->piece[AT_SIZE_Y + i], feeds[i] ? size_y(s, i) : 1);
        s->piece[AT_SIZE_L + i] = max_of(s->piece[AT_SIZE_L + i], feeds[i] ? size_l(s, i) : 1);
#else
        s->piece[AT_SIZE_Y + i] = s->piece[AT_SIZE_L + i] = 1;
#endif
    }
#else
    UNUSED(s);
#endif
}

/* What is written down of a piece, but where it ends. */
static void record_piece(model_pieces *s, double length, double error)
{
    double *piece = s->piece;
    piece[AT_T] = s->at.t;
    piece[AT_TAU] = s->at.tau;
    s->per_unit = 1/s->at.tau;
    piece[AT_S] = length;
    piece[AT_DEFECT] = error;
    piece[AT_EVENT] = s->at.begun;
    piece[AT_EVENT_WIDTH] = s->at.begun != 0 ? s->at.event_width : 0;
    piece[AT_RESIDUAL] = NAN; /* that of steps */
#if TANGENTS
    memcpy(s->sides, s->at.choice, sizeof s->sides);
#endif
#if LAW
    for (int i = 0; i < M; i++) {
        piece[AT_IMPULSE + i] = s->at.begun != 0 ? s->at.impulse[i] : 0;
        piece[AT_CODES + i] = s->at.codes[i];
        piece[AT_SIZE_Y + i] = piece[AT_SIZE_L + i] = 0;
    }
#endif
    record_sizes(s);
    memcpy(piece + AT_LAST, s->value, sizeof s->at.x);
    for (int k = 0; k <= s->order; k++)
        memcpy(piece + AT_C + k*ROWS, s->c[k], ROWS*sizeof *piece);
}

/* All orders at the place; where they have no number, on the side of switches that rounding has passed. */
static int expand_orders(model_pieces *s)
{
    int status = expand_piece(s);
    if (status == MODEL_OK)
        return status;
    s->at = s->before;
    status = past_switches(s, status);
    return status == MODEL_OK ? expand_piece(s) : status;
}

/* Integrate to the next event, or as far as one expansion goes. */
static int next_piece(model_pieces *s)
{
    condition hit;
    int found = 0, status;
    double error = 0, length, tried = INFINITY;
    s->before = s->at;
    s->before.known = 0;
    s->work = 0;
    if (s->at.still >= MOST_STILL)
        return MODEL_TOO_SHORT;
    if ((status = expand_orders(s)))
        return status;
#if FEED
    if (hides_l(s))
        return MODEL_NO_MODE;
#endif
    length = length_of(s);
    if (length > 1) { /* what is rounding at s = 1 is not at s^p */
        const double unit = unit_of(length*s->at.tau), times = unit/s->at.tau;
        double raised = times;
        for (int k = 1; k <= s->order; k++) {
            for (int j = 0; j < COLUMNS; j++)
                s->c[k][j] *= raised;
            raised *= times;
        }
        length = min_of(length/times, 1.0);
        s->at.tau = unit;
    }
    const double longest = length*s->at.tau, known = next_known(s, s->at.t);
#if STIFF
    const int collocated = collocate(s, &length, time_to(s, known), &hit, &found, &error);
#else
    const int collocated = 0;
    if (s->leaves) {
        if (s->at.stiff[NEXT_LENGTH] > 0 || trial(s, length) > 0)
            return MODEL_NOT_SOLVED;
        let_series(s, 0);
    }
#endif
    if (!collocated) {
        length = min_of(length, time_to(s, known)/s->at.tau);
        if ((status = accept(s, &length, &tried, &hit, &found, &error)))
            return status;
    }
    grow(s, length, min_of(longest, s->at.tau*length));
#if STIFF
    if (collocated)
        memcpy(s->value, s->last, sizeof s->last);
#endif
    record_piece(s, length, error);
    if (length != 0)
        s->at.begun = 0;
#if LAW
    s->at.redundant += HOW.null > 0;
#endif
    memcpy(s->at.x, s->value, sizeof s->at.x);
    pass_time(s, s->at.tau*length);
    s->at.still = length > 0 && s->at.tau*length <= HARDLY*fabs(s->before.t) ? s->at.still + 1 : 0;
    memset(s->at.open, 0, sizeof s->at.open);
    const double start = s->piece[AT_T], unit = s->at.tau, tau = unit*length, end = min_of(collocated ? start + tau + longest : start + unit*tried, known);
    s->at.tau = collocated ? unit_of(ROOM*longest) : unit; /* that of series, and of germs, stays what a series takes */
    if (!found && !reaches(s->at.t, known)) {
#if LAW
        if (HOW.through && (status = hold(s)))
            return status;
#endif
        if (!collocated)
            s->at.tau = unit_of(ROOM*tau);
    }
    else {
        /* In a unit that is longer than a mode's own time coefficients grow. */
        s->at.tau = length == 0 ? s->before.tau : unit_of(length > STUMP ? min_of(longest, LONGER*tau) : longest);
        restart(s);
        if (found) {
            s->at.tiny = tau < TINY*max_of(fabs(s->at.t), s->at.tau) ? s->at.tiny + 1 : 0;
            if (s->at.tiny > TINY_PIECES)
                return MODEL_NO_MODE;
        }
        if ((status = found ? pass_event(s, &hit, known, end) : cross(s, known)))
            return status;
        if (s->at.t > start) {
            s->piece[AT_S] = (s->at.t - start)/unit;
            memcpy(s->piece + AT_LAST, s->at.x, sizeof s->at.x);
        }
    }
    record_sizes(s);
    return s->work < s->budget ? MODEL_OK : MODEL_NOT_SOLVED;
}

/* The next piece that has a length; where that fails the place is as before. BAD_STEP: t + s is t of piece after piece. */
static int advance_piece(model_pieces *s)
{
    int status, tried = 0;
    do
        status = tried++ < TINY_PIECES ? next_piece(s) : MODEL_BAD_STEP;
    while (status == MODEL_OK && !(s->piece[AT_T] + s->piece[AT_TAU]*s->piece[AT_S] > s->piece[AT_T]));
    if (status == MODEL_OK && !(is_finite(s->at.t) && all_finite(N, s->at.x)))
        status = MODEL_NOT_FINITE;
    if (status != MODEL_OK)
        s->at = s->before;
    return status;
}

/* A first unit of time: in which f changes the state by a tenth of its size. */
static SELDOM void choose_unit(model_pieces *s)
{
    double most = 0;
    s->c[0][T] = s->at.t;
    s->c[1][T] = s->at.tau;
    memcpy(s->c[0], s->at.x, sizeof s->at.x);
    f_first(s, 1, s->c[1]);
#if B_NUMBERS
    const double *f = s->c[1];
#else
    const double *f = s->f;
#endif
    for (int i = 0; i < N; i++)
        if (s->at.x[i] != 0 && is_finite(f[i]))
            most = max_of(most, fabs(f[i])/fabs(s->at.x[i]));
    if (most > 0)
        s->at.tau = unit_of(FIRST/most);
    double rates[N];
    memcpy(rates, f, sizeof rates);
    cap_unit(s, rates);
}

#if LAW
/* Codes to begin with: the end that the sign of y asks for, where no l acts on it and it is clear; else y = 0. */
static void take_sides(model_pieces *s)
{
    s->c[0][T] = s->at.t;
    memcpy(s->c[0], s->at.x, sizeof s->at.x);
    memcpy(s->c[0] + L, s->at.l, M*sizeof *s->at.l);
    outputs(s, 0);
#if SLOPES
    slopes_here(s);
#endif
    for (int i = 0; i < M; i++) {
        const double y = s->c[0][Y + i];
        const int clear = !feeds[i] && fabs(y) > NONZERO_SHARE*size_y(s, i);
        s->at.codes[i] = !clear ? 0 : y > 0 ? -is_finite(lower[i]) : is_finite(upper[i]);
    }
}
#endif

#if INPUTS
/* How large everything has been, where it goes on with other inputs; at first s->sizes are 0. */
static void keep_sizes(model_pieces *s)
{
    for (int i = 0; i < N; i++)
        s->at.size_x[i] = max_of(s->at.size_x[i], s->sizes[i]);
    for (int i = 0; i < M; i++) {
        s->at.size_l[i] = max_of(s->at.size_l[i], s->sizes[L + i]);
        s->at.size_y[i] = max_of(s->at.size_y[i], s->sizes[Y + i]);
    }
}

#endif
/* Begin at the state x and time t: choose the mode. */
static SELDOM int begin(model_pieces *s, double t, const double *x)
{
    memset(&s->at, 0, sizeof s->at);
    s->at.t = t;
    s->at.tau = 1;
    for (int i = 0; i < N; i++) {
        s->at.x[i] = x[i];
        s->at.size_x[i] = fabs(x[i]);
    }
    for (int b = 0; b < CHOICES; b++)
        s->at.choice[b] = NAN;
#if LAW
    for (int i = 0; i < M; i++) {
        const int below = is_finite(lower[i]), above = is_finite(upper[i]);
        s->at.l[i] = below && above ? (lower[i] + upper[i])/2 : below ? lower[i] : above ? upper[i] : 0;
        s->at.size_l[i] = below && above ? upper[i] - lower[i] : 0;
    }
#endif
#if INPUTS
    keep_sizes(s);
#endif
    choose_unit(s);
    for (int pass = 0; pass < STARTS; pass++) {
        memset(s->at.open, 1, M + CHOICES);
#if LAW
        take_sides(s);
#endif
        s->work = 0;
        const int found = choose_mode(s); /* in a shorter time the germ of a multiplier may show */
        const double length = expand(s, s->order) ? length_of(s) : 1;
        if (found && length >= TOO_SHORT) {
            grow(s, 0, 0);
            return judge_uniqueness(s);
        }
        s->at.tau = unit_of(min_of(length, TOO_SHORT)*s->at.tau);
    }
    return MODEL_NO_MODE;
}

/* Orders and tolerances; numbers that series are made of. */
static void prepare_pieces(model_pieces *s, double rtol)
{
    s->rtol = LOCAL*min_of(rtol, ROUGHEST);
    s->order = (int)ceil(-log(s->rtol)/2) + BEYOND;
    if (s->order > MOST_ORDERS)
        s->order = MOST_ORDERS;
    s->share = pow(POINT, s->order);
    numbers_on_disc(s);
}

/* What follows from the parameters; NO_MODE where the code, which is that of all values, is not for these. */
static int take_parameters(model_pieces *s)
{
    numbers(s);
#if ENDS_SET
    for (int i = 0; i < M; i++)
        if (!(lower[i] <= upper[i] && lower[i] < INFINITY && upper[i] > -INFINITY))
            return MODEL_BAD_PARAMETER;
#endif
#if JUDGED
    s->unique = is_always_p(s);
#if DIAGONAL
    for (int i = 0; i < M; i++)
        if (!is_finite(W_inverse[i]) || W_inverse[i] == 0)
            return MODEL_NO_MODE;
#else
    if (!all_finite(M*M, D_dense) || !all_finite(M*M, W_dense))
        return MODEL_NO_MODE;
#endif
#if ORTHOGONAL
    for (int i = 0; i < M; i++) {
        double sum = 0;
        for (int e = C_start[i]; e < C_start[i + 1]; e++)
            sum += C_value[e]*C_value[e];
        if (!(sum > 0))
            return MODEL_NO_MODE;
    }
#endif
#endif
    return MODEL_OK;
}
