/* Taylor coefficients of x, l and y in a mode: event_driven/system.py. */

/*
 * The values at s of count polynomials of two orders or more, which lie stride apart. Even and odd orders apart, in s^2, and two
 * columns at once: so that little waits for what is not there yet.
 */
static inline void values_at(const double *c, int stride, int order, double s, int count, double *restrict out)
{
    const double q = s*s;
    int i = 0;
    for (; i + 2 <= count; i += 2) {
        const double *o = c + (long)order*stride + i;
        double even[2], odd[2];
        for (int j = 0; j < 2; j++) {
            even[j] = o[j];
            odd[j] = o[j - stride];
        }
        for (int k = order - 2; k > 0; k -= 2) {
            o -= 2*stride;
            for (int j = 0; j < 2; j++) {
                even[j] = even[j]*q + o[j];
                odd[j] = odd[j]*q + o[j - stride];
            }
        }
        for (int j = 0; j < 2; j++)
            out[i + j] = order % 2 ? even[j]*s + odd[j] : even[j]*q + odd[j]*s + c[i + j];
    }
    for (; i < count; i++) {
        const double *o = c + (long)order*stride + i;
        double even = o[0], odd = o[-stride];
        for (int k = order - 2; k > 0; k -= 2) {
            o -= 2*stride;
            even = even*q + o[0];
            odd = odd*q + o[-stride];
        }
        out[i] = order % 2 ? even*s + odd : even*q + odd*s + c[i];
    }
}

/* The same of one column at four times, each with the bits of values_at: side by side, so that none waits for another. */
static inline void values_at_four(const double *c, int stride, int order, const double *s, int apart, double *restrict out)
{
    const double s0 = s[0], s1 = s[1], s2 = s[2], s3 = s[3], q0 = s0*s0, q1 = s1*s1, q2 = s2*s2, q3 = s3*s3;
    const double *o = c + (long)order*stride;
    double e0 = o[0], e1 = e0, e2 = e0, e3 = e0, d0 = o[-stride], d1 = d0, d2 = d0, d3 = d0;
    for (int k = order - 2; k > 0; k -= 2) {
        o -= 2*stride;
        const double even = o[0], odd = o[-stride];
        e0 = e0*q0 + even;
        e1 = e1*q1 + even;
        e2 = e2*q2 + even;
        e3 = e3*q3 + even;
        d0 = d0*q0 + odd;
        d1 = d1*q1 + odd;
        d2 = d2*q2 + odd;
        d3 = d3*q3 + odd;
    }
    if (order % 2) {
        out[0] = e0*s0 + d0;
        out[apart] = e1*s1 + d1;
        out[2*apart] = e2*s2 + d2;
        out[3*apart] = e3*s3 + d3;
    }
    else {
        out[0] = e0*q0 + d0*s0 + c[0];
        out[apart] = e1*q1 + d1*s1 + c[0];
        out[2*apart] = e2*q2 + d2*s2 + c[0];
        out[3*apart] = e3*q3 + d3*s3 + c[0];
    }
}

/* s^k. */
static double raised_to(double s, int k)
{
    double raised = 1;
    for (; k; k >>= 1) {
        raised *= k & 1 ? s : 1;
        s *= s;
    }
    return raised;
}

#if !GUESSED
static int all_finite(int n, const double *x)
{
    for (int i = 0; i < n; i++)
        if (!is_finite(x[i]))
            return 0;
    return 1;
}

#endif
/* The power of two that is not below tau. */
static double unit_of(double tau)
{
    int exponent;
    const double fraction = frexp(tau, &exponent);
    return ldexp(1.0, exponent - (fraction == 0.5));
}

/* Move the time of the place by h, and keep what rounding leaves of that: hundreds of pieces come to a time as one does. By
   nothing where rounding takes all of h: so no pole is crept over. */
static void pass_time(model_pieces *s, double h)
{
    if (s->at.t + h == s->at.t)
        return;
    const double whole = h + s->at.late, t = s->at.t + whole;
    s->at.late = whole - (t - s->at.t);
    s->at.t = t;
}

static double time_to(const model_pieces *s, double until) { return until - s->at.t - s->at.late; }

static int spend_on(model_pieces *s) { return s->work < s->budget ? (s->work++, 1) : 0; }

#if LAW
/* Order k of y anew from order k of h and of l. */
static void refresh_y(model_pieces *s, int k)
{
#if FEED
#if D_NUMBERS
    add_D(s, s->c[k] + Y, s->c[k] + H, s->c[k] + L);
#else
    if (k)
        h_later(s, k);
    else
        h_first(s);
#endif
#else
    UNUSED(s);
    UNUSED(k);
#endif
}

static void outputs(model_pieces *s, int k)
{
    if (k)
        h_later(s, k);
    else
        h_first(s);
#if D_NUMBERS
    refresh_y(s, k);
#endif
}
#endif

#if LAW
#if !B_NUMBERS
/* Order k + 1 of x from s->f and order k of g. */
static void add_g(model_pieces *s, int k, double factor)
{
    for (int i = 0; i < N; i++)
        s->c[k + 1][i] = factor*(s->f[i] + s->value[i]);
}

#endif
#endif
/* Order k + 1 of x from order k of f, l, and g; what f is made of is brought to order k. */
static void rate(model_pieces *s, int k)
{
    const double factor = s->at.tau/(k + 1);
    double *next = s->c[k + 1];
    if (k)
        f_later(s, k, factor, next);
    else
        f_first(s, factor, next);
#if LAW
#if B_NUMBERS
#if FEED
    add_B(s, next, s->c[k] + L, factor);
#else
    if (k == 0)
        add_B(s, next, s->c[k] + L, factor);
#endif
#else
    if (k)
        g_later(s, k);
    else
        g_first(s);
    add_g(s, k, factor);
#endif
#endif
}

#if LAW
/* l_j, with what it moves by in the unit of time. */
static double pushing(const model_pieces *s, int j)
{
    return fabs(s->c[0][L + j]) + fabs(s->c[1][L + j]);
}

/* size += |g_l| |l|. */
static void add_pushed(const model_pieces *s, double *size, const double *l)
{
#if SLOPES
    for (int i = 0; i < N; i++)
        for (int j = 0; j < M; j++)
            size[i] += fabs(B_AT(i, j)*l[j]);
#else
    UNUSED(s);
    for (int j = 0; j < M; j++)
        for (int e = B_start[j]; e < B_start[j + 1]; e++)
            size[B_row[e]] += fabs(B_value[e]*l[j]);
#endif
}
#endif

/* By what multipliers push each state in the unit of time, in size. */
static void pushes(const model_pieces *s, double *out)
{
    memset(out, 0, N*sizeof *out);
#if LAW
    double l[M];
    for (int j = 0; j < M; j++)
        l[j] = s->c[1][T]*pushing(s, j);
    add_pushed(s, out, l);
#else
    UNUSED(s);
#endif
}

#if LAW
/* |h_x| of row i times these sizes of states. */
static double terms_of_x(const model_pieces *s, int i, const double *of_x)
{
    double sum = 0;
#if SLOPES
    for (int j = 0; j < N; j++)
        sum += fabs(s->slopes.C[i*N + j])*of_x[j];
#else
    UNUSED(s);
    for (int e = C_start[i]; e < C_start[i + 1]; e++)
        sum += fabs(C_value[e])*of_x[C_column[e]];
#endif
    return sum;
}

/* |h_l| of row i times these sizes of multipliers. */
static double terms_of_l(const model_pieces *s, int i, const double *of_l)
{
    double sum = 0;
#if SLOPES
    for (int j = 0; j < M; j++)
        sum += fabs(s->slopes.D[i*M + j])*of_l[j];
#else
    UNUSED(s);
#if FEED
    for (int e = D_start[i]; e < D_start[i + 1]; e++)
        sum += fabs(D_value[e])*of_l[D_column[e]];
#else
    UNUSED(i);
    UNUSED(of_l);
#endif
#endif
    return sum;
}

#if !LINEAR
/* The largest share by which l of held rows moved by d of what it is the sum of: of itself, and of A times the terms of h. */
static double moved_by(const model_pieces *s, const double *A, const double *d, const double *of_x)
{
    const int n = HOW.n;
    double of_l[M], terms[M], most = 0;
    for (int i = 0; i < M; i++)
        of_l[i] = fabs(s->c[0][L + i]);
    for (int b = 0; b < n; b++)
        terms[b] = terms_of_x(s, HOW.active[b], of_x) + terms_of_l(s, HOW.active[b], of_l);
    for (int a = 0; a < n; a++) {
        double sum = NOTHING + of_l[HOW.active[a]];
        for (int b = 0; b < n; b++)
            sum += fabs(A[a*n + b])*terms[b];
        most = worse_of(most, fabs(d[a])/sum);
    }
    return most;
}
#endif

/* Let the multipliers of held rows move by d at order k, and x at order k + 1. */
static void push(model_pieces *s, int k, const double *d)
{
#if B_NUMBERS
    const double factor = s->at.tau/(k + 1);
    double *next = s->c[k + 1];
    for (int a = 0; a < HOW.n; a++) {
        const int j = HOW.active[a];
        s->c[k][L + j] += d[a];
        for (int e = B_start[j]; e < B_start[j + 1]; e++)
            next[B_row[e]] += factor*(B_value[e]*d[a]);
    }
#else
    for (int a = 0; a < HOW.n; a++)
        s->c[k][L + HOW.active[a]] += d[a];
    if (k)
        g_again_later(s, k);
    else
        g_again_first(s);
    add_g(s, k, s->at.tau/(k + 1));
#endif
}

/* d = -A y/unit on held rows, A = N. */
static void through(const model_pieces *s, const double *y, double unit, double *d)
{
    const int n = HOW.n;
    for (int a = 0; a < n; a++) {
#if DIAGONAL
        d[a] = -unit*(W_inverse[HOW.active[a]]*y[HOW.active[a]]);
#else
        double sum = 0;
        for (int b = 0; b < n; b++)
            sum += HOW.rates[a*n + b]*y[HOW.active[b]];
        d[a] = -unit*sum;
#endif
    }
}

/* l of order k from y, where it depends on it directly; the share by which order 0 moved, of what is not linear in l. */
static double direct(model_pieces *s, int k)
{
    double moved = 0;
#if FEED
    const int n = HOW.n;
    double *y = s->c[k] + Y, *l = s->c[k] + L, d[M];
    if (!HOW.direct)
        return 0;
    for (int a = 0; a < n; a++) {
        double sum = 0;
        for (int b = 0; b < n; b++)
            sum += HOW.plus[a*n + b]*y[HOW.active[b]];
        l[HOW.active[a]] -= d[a] = sum;
    }
#if !LINEAR
    double of_x[N];
    for (int i = 0; i < N; i++)
        of_x[i] = fabs(s->c[0][i]);
    moved = k ? 0 : moved_by(s, HOW.plus, d, of_x);
#endif
    refresh_y(s, k);
    if (!HOW.through)
        for (int a = 0; a < n; a++)
            y[HOW.active[a]] = 0;
#else
    UNUSED(s);
    UNUSED(k);
#endif
    return moved;
}

/*
 * Whether order k > 0 lets the rows that nothing acts on stay at 0 by themselves. Where x rests its coefficients are rounding of what
 * multipliers push it by, or exactly 0, and y of curved rows is what their products are.
 */
static int stays(const model_pieces *s, int k)
{
#if MATRICES
    const int n = HOW.n;
    const double *y = s->c[k] + Y;
    double size = 0, pushed[N], rounding[M];
    if (!HOW.null)
        return 1;
    pushes(s, pushed);
    for (int i = 0; i < N; i++)
        size = max_of(size, fabs(s->c[k][i]));
    for (int a = 0; a < n; a++) {
        size = max_of(size, fabs(y[HOW.active[a]]));
        rounding[a] = TERM_ROUNDING*terms_of_x(s, HOW.active[a], pushed);
    }
    for (int z = 0; z < HOW.null; z++) {
        double sum = 0, least = 0;
        for (int a = 0; a < n; a++) {
            const double share = HOW.rest[a*HOW.null + z];
            sum += share*y[HOW.active[a]];
            least += fabs(share)*rounding[a];
        }
        if (!(fabs(sum) <= max_of(STAYS*size, least)))
            return 0;
    }
#else
    UNUSED(s);
    UNUSED(k);
#endif
    return 1;
}

#if !LINEAR
/* Of l_i the middle of its ends, or the end that there is, or 0. */
static double middle_of(int i)
{
    if (is_finite(lower[i]) && is_finite(upper[i]))
        return (lower[i] + upper[i])/2;
    return is_finite(lower[i]) ? lower[i] : is_finite(upper[i]) ? upper[i] : 0;
}
#endif

/* Order 0 of l and order 1 of x, from l as it stands; 0 where the mode has none. */
static int settle(model_pieces *s)
{
    double d[M];
    for (int iteration = 0; iteration < NEWTON; iteration++) {
        double moved = direct(s, 0);
        rate(s, 0);
#if LINEAR
        if (!HOW.through)
            return 1;
#else
        if (!HOW.n)
            return 1;
#endif
        outputs(s, 1);
        if (HOW.through) {
            through(s, s->c[1] + Y, 1/s->at.tau, d);
            push(s, 0, d);
            for (int a = 0; a < HOW.n; a++)
                if (!is_finite(d[a]))
                    return 0;
#if !LINEAR
            double of_x[N];
            for (int i = 0; i < N; i++)
                of_x[i] = fabs(s->c[1][i])/s->at.tau;
            moved = worse_of(moved, moved_by(s, HOW.rates, d, of_x));
#endif
            if (HOW.feeds)
                refresh_y(s, 0);
        }
        if (!is_finite(moved))
            return 0;
#if LINEAR
        return 1;
#else
        if (iteration && moved <= SETTLED*NEWTON)
            return 1;
        solve_mode(s);
        outputs(s, 0);
#endif
    }
    return 0;
}
#endif

/* Orders beyond those that are known, see expand; 0: rows that nothing acts on do not stay at 0. */
static int extend(model_pieces *s, int known, int orders)
{
#if LAW
    double d[M];
    for (int k = known + 1; k <= orders; k++)
        memset(s->c[k] + L, 0, M*sizeof *d);
#endif
    for (int k = known; k <= orders; k++) {
#if LAW
        if (k)
            direct(s, k);
#endif
        if (k == orders)
            break;
        if (k)
            rate(s, k);
#if LAW
        if (!HOW.through) {
            outputs(s, k + 1);
            continue;
        }
        if (k) {
            outputs(s, k + 1);
            through(s, s->c[k + 1] + Y, (k + 1)/s->at.tau, d);
            push(s, k, d);
            if (HOW.feeds) {
                refresh_y(s, k);
                for (int a = 0; a < HOW.n; a++)
                    s->c[k][Y + HOW.active[a]] = 0;
            }
        }
#if !STILL
        outputs(s, k + 1);
#endif
        if (known == 0 && k < HELD_ORDERS && !stays(s, k + 1))
            return 0;
#endif
    }
#if LAW
    if (HOW.through)
        for (int k = known + 1; k <= orders; k++)
            for (int a = 0; a < HOW.n; a++)
                s->c[k][Y + HOW.active[a]] = 0;
#endif
    return 1;
}

#if LAW
/* The end of l_i that a code stands for, or l_i as it was where there is none. */
static double end_or_last(const model_pieces *s, int i, int code)
{
    const double end = code < 0 ? lower[i] : upper[i];
    return code && is_finite(end) ? end : s->at.l[i];
}

#endif
/* Orders 0, ..., orders of x and y, and of l as far as its index lets; 0: the mode has no solution. */
static int expand(model_pieces *s, int orders)
{
    double *c = s->c[0];
    c[T] = s->at.t;
    s->c[1][T] = s->at.tau;
    memcpy(c, s->at.x, sizeof s->at.x);
    spend_on(s);
#if LAW
    int settled = 0;
    for (int k = 1; k <= orders; k++)
        memset(s->c[k] + L, 0, M*sizeof *c);
#if LINEAR
    for (int i = 0; i < M; i++) {
        const int code = s->at.codes[i];
        c[L + i] = code ? end_or_last(s, i, code) : 0;
    }
    outputs(s, 0);
    solve_mode(s);
    settled = settle(s);
    memcpy(s->at.l, c + L, M*sizeof *c);
    if (!settled)
        return 0;
#else
    for (int from = 0; from < 2 && !settled; from++) { /* from the guess that l is, then from the middle of its ends */
        for (int i = 0; i < M; i++) {
            const int code = s->at.codes[i];
            s->at.l[i] = end_or_last(s, i, code);
            c[L + i] = code == 0 && from ? middle_of(i) : s->at.l[i];
        }
        outputs(s, 0);
        solve_mode(s);
        settled = settle(s);
    }
    if (!settled)
        return 0;
    memcpy(s->at.l, c + L, M*sizeof *c);
    solve_mode(s);
#endif
#else
    rate(s, 0);
#endif
    if (!extend(s, 0, orders))
        return 0;
#if LAW
#if SLOPES
    slopes_here(s);
#endif
#endif
    return 1;
}

#if LAW
/* The size of what y_i is the sum of, with these sizes of states and multipliers. */
static double terms_of(const model_pieces *s, int i, const double *of_x, const double *of_l)
{
    return terms_of_x(s, i, of_x) + terms_of_l(s, i, of_l);
}

/* h_x of row i times a rate of x. */
static double slope_along(const model_pieces *s, int i, const double *rate)
{
    double sum = 0;
#if SLOPES
    for (int j = 0; j < N; j++)
        sum += C_AT(i, j)*rate[j];
#else
    UNUSED(s);
    for (int e = C_start[i]; e < C_start[i + 1]; e++)
        sum += C_value[e]*rate[C_column[e]];
#endif
    return sum;
}

/* rate += g_l l. */
static void add_push(const model_pieces *s, double *rate, const double *l)
{
#if SLOPES
    for (int i = 0; i < N; i++)
        for (int j = 0; j < M; j++)
            rate[i] += B_AT(i, j)*l[j];
#else
    UNUSED(s);
    for (int j = 0; j < M; j++)
        for (int e = B_start[j]; e < B_start[j + 1]; e++)
            rate[B_row[e]] += B_value[e]*l[j];
#endif
}

/* What y_i is measured beside. */
static double size_y(const model_pieces *s, int i)
{
    double pushed = 0;
#if SLOPES
    for (int j = 0; j < M; j++)
        for (int k = 0; k < N; k++)
            pushed += fabs(C_AT(i, k)*B_AT(k, j))*pushing(s, j);
#else
    for (int e = W_start[i]; e < W_start[i + 1]; e++)
        pushed += W_value[e]*pushing(s, W_column[e]);
#endif
    return max_of(s->at.size_y[i], terms_of(s, i, s->at.size_x, s->at.size_l) + RESTS*(s->c[1][T]*pushed));
}

/* A part of the largest l of the rows that row i is tied to. */
static double little_l(const model_pieces *s, int i)
{
    double largest = 0;
    for (int j = 0; j < M; j++)
        if (row_group[j] == row_group[i])
            largest = max_of(largest, s->at.size_l[j]);
    return LITTLE*largest;
}

/* What l_i is measured beside. */
static double size_l(const model_pieces *s, int i) { return max_of(s->at.size_l[i], little_l(s, i)); }

#if FEED
/* Whether rounding hides l of a held row beside the largest it is tied to, as where D is small: `ModeSystem.rounding` knows more. */
static int hides_l(const model_pieces *s)
{
    double of_x[N], of_l[M], terms[M];
    if (!HOW.direct)
        return 0;
    for (int j = 0; j < N; j++)
        of_x[j] = fabs(s->c[0][j]);
    for (int i = 0; i < M; i++)
        of_l[i] = fabs(s->c[0][L + i]);
    for (int b = 0; b < HOW.n; b++)
        terms[b] = terms_of(s, HOW.active[b], of_x, of_l);
    for (int a = 0; a < HOW.n; a++) {
        double sum = 0, largest = 0;
        for (int b = 0; b < HOW.n; b++)
            sum += fabs(HOW.plus[a*HOW.n + b])*terms[b];
        for (int i = 0; i < M; i++)
            if (row_group[i] == row_group[HOW.active[a]])
                largest = max_of(largest, of_l[i]);
        if (EPS*sum > HIDDEN*largest && largest > 0)
            return 1;
    }
    return 0;
}
#endif
#endif
