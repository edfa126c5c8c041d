/* Where a piece ends, and the same to rounding: event_driven/event_location.py. */

/* A condition is at least this on a piece of this length. */
static double least_on(const model_pieces *s, const condition *of, double length)
{
    double least = 0;
    for (int k = of->orders; k > 0; k--) {
        least = of->sign*s->c[k][of->column] + least;
        least = least < 0 ? least*length : 0;
    }
    return of->sign*s->c[0][of->column] + of->shift + least;
}

/* The row that a condition looks at, on the disc: x, l and t are there. */
static SELDOM void look_on_disc(model_pieces *s, const condition *of, int m, double *y)
{
    run_lines(s, DISC_LINES, m, 1);
#if SWITCHED
    if (of->acts == NOBODY)
        copied(y, ROW(disc_looked[of->of - M]), m);
#endif
#if LAW
    if (of->acts == OF_Y)
        copied(y, ROW(disc_h[of->of]), m);
#if FEED
#if D_NUMBERS
    for (int e = of->acts == OF_Y ? D_start[of->of] : 0; of->acts == OF_Y && e < D_start[of->of + 1]; e++)
        disc_sum(y, y, D_value[e], DISC_L(D_column[e]), m);
#endif
#endif
#endif
}

/* What a condition at the place is known to, where states are known to this share of their size so far: TIE is rounding. */
static SELDOM double tie_of(model_pieces *s, const condition *of, double share)
{
    const double largest = share*size_of(s, of);
    if (of->acts == OF_L)
        return largest;
    double y[2] = {0}, pushed[N];
    pushes(s, pushed);
    DISC_T[0] = s->at.t;
    DISC_T[1] = EPS*fabs(s->at.t);
    for (int i = 0; i < N; i++) {
        DISC_X(i)[0] = s->c[0][i];
        DISC_X(i)[1] = share*(s->at.size_x[i] + RESTS*pushed[i]);
    }
    for (int i = 0; i < M; i++) {
        DISC_L(i)[0] = s->c[0][L + i];
        DISC_L(i)[1] = share*s->at.size_l[i];
    }
    s->rounded = 1;
    look_on_disc(s, of, 0, y);
    s->rounded = 0;
    return min_of(y[1], largest);
}

/* Whether the slope for |s| <= width is about c[1] < 0. */
static int falls(int n, const double *c, double width)
{
    double turned = 0;
    for (int k = n - 1; k > 1; k--)
        turned = (turned + k*fabs(c[k]))*width;
    return c[1] < 0 && turned <= STEEP*-c[1];
}

/* Whether c falls to 0 near s = 0, once, where its sign is not known; in an instant, by its first order. */
static int is_simple(int n, const double *c, double tie, double instant)
{
    const double width = n > 1 && c[1] < 0 ? 2*(fabs(c[0]) + tie)/-c[1] : INFINITY;
    return width <= instant || (width < NEAR && falls(n, c, width));
}

/* The sum of the sizes of the terms of c at s but the first. */
static double terms_at(int n, const double *c, double s)
{
    double terms = 0;
    for (int k = n - 1; k > 0; k--)
        terms = (terms + fabs(c[k]))*s;
    return terms;
}

/* The part of [0, 1] on which rounding does not hide c[0] > 0 behind the other terms, whose sum is given: all of it, but for octaves. */
static double seen_of(int n, const double *c, double terms)
{
    for (double part = 1; part > LEAST_PART && c[0] > 0; part /= 4)
        if (DIP*(part < 1 ? terms_at(n, c, part) : terms) < c[0]/4)
            return part;
    return 1;
}

/* A polynomial of n coefficients about another point. */
static void recentre(int n, double *c, double by)
{
    for (int first = 0; first < n - 1; first++)
        for (int k = n - 2; k >= first; k--)
            c[k] += c[k + 1]*by;
}

/* No second derivative on [0, s] is larger. */
static double bend_of(int n, const double *c, double s)
{
    double total = 0;
    for (int k = n - 1; k > 1; k--)
        total = total*s + k*(k - 1)*fabs(c[k]);
    return total;
}

/* The first root in (0, 1] of c, known to rounding and a margin, of its last order, at 1; NONE where it is above these. Where it
   comes so near to 0 long before its root, or has none, that. terms: the sum of their sizes but the first. */
static double where(model_pieces *s, int n, const double *c, double terms, double margin)
{
    double about[MOST_ORDERS + 1];
    const double rounding = DIP*(c[0] + terms);
    if (!(c[0] > 0))
        return first_root(s, n, c);
    memcpy(about, c, n*sizeof *c);
    about[0] -= rounding;
    about[n - 1] -= margin;
    const double near = c[0] > rounding && n > 1 ? first_root(s, n, about) : 0;
    if (near > 1)
        return near;
    const double v = value_of(n, c, near), rate = slope_of(n, c, near), beyond = near - 2*v/rate;
    if (rate < 0 && value_of(n, c, beyond) < 0 && bend_of(n, c, beyond)*(beyond - near) <= STEEP*-rate) {
        const double simple = simple_root(n, c, near, beyond, near - v/rate);
        return simple <= 1 ? simple : NONE;
    }
    const double root = first_root(s, n, c);
    if (root > 1)
        return near;
    memcpy(about, c, n*sizeof *c);
    recentre(n, about, root);
    return falls(n, about, root - near) ? root : near;
}

/* But for one switch, the condition that ends first, put into hit, and where; *length where none ends before: then 0 is returned. */
static int first_event(model_pieces *s, double *length, condition *hit, const double *margins, int but)
{
    const int p = s->order;
    const double whole = *length;
    double raised = 1, share = 0, c[MOST_ORDERS + 1], germ[MOST_ORDERS + 1];
    int found = 0;
    condition all[2];
    for (int of = 0; of < M + CHOICES; of++)
        for (int count = conditions_of(s, of, p, all), i = 0; i < count; i++) {
            const condition *one = &all[i];
            if (of == but)
                continue;
            double margin = margins && one->acts != OF_L ? margins[of] : 0;
            if (margin > 0 && *length < whole)
                margin *= pow(*length/whole, one->orders + 1);
            if (!s->at.open[of] && least_on(s, one, *length) > margin)
                continue;
            const int n = one->orders + 1;
            coefficients(s, one, germ);
            raised = 1;
            double sum = 0;
            for (int k = 0; k < n; k++) {
                c[k] = germ[k]*raised;
                raised *= *length;
                sum += k ? fabs(c[k]) : 0;
            }
            if (c[0] - margin > sum)
                continue;
            const double largest = largest_of(n, c);
            double least = TIE*size_of(s, one);
            if (largest <= least && largest <= (least = tie_of(s, one, TIE)))
                continue;
            int first = 0;
            if (c[0] <= (s->at.open[of] ? least : 0)) {
                share = share > 0 ? share : pace(s);
                first = leading(n, germ, s->at.open[of] ? least : 0, share);
                if (s->at.open[of] && first != 1 && (least = tie_of(s, one, TIE)) > 0) {
                    first = lowest(n, germ, least);
                    if (first >= 0 && germ[first] < 0) /* what ends at once would be chosen again, as it was */
                        first = leading(n, germ, least, share);
                }
                first = first < 0 ? ORDERS + 1 : first;
                if (first >= n || largest_of(n - first, c + first) <= least)
                    continue;
                if (c[first] < 0) { /* at once */
                    *length = 0;
                    *hit = *one;
                    return 1;
                }
                sum = terms_at(n - first, c + first, 1);
            }
            double *const d = c + first;
            const int left = n - first;
            const double part = seen_of(left, d, sum);
            if (part < 1) {
                raised = 1;
                for (int k = 0; k < left; k++, raised *= part)
                    d[k] *= raised;
                sum = terms_at(left, d, 1);
            }
            const double at = where(s, left, d, sum, margin);
            if (at > 1 && part == 1)
                continue;
            *length *= part*min_of(at, 1);
            *hit = *one;
            found = at <= 1;
            const int tail = left < TAIL ? left : TAIL;
            if (found && at > 0 && (one->acts == OF_L || !margins) && largest_of(tail, d + left - tail) > LOST*largest_of(left, d)) {
                *length /= 2; /* a root of what was cut off */
                found = 0;
            }
        }
    return found;
}

/* The condition that watches the same end as hit, as it stands now; 0 where there is none. */
static int own_condition(const model_pieces *s, const condition *hit, int orders, condition *own)
{
    condition all[2];
    for (int count = conditions_of(s, hit->of, orders, all), i = 0; i < count; i++)
        if (is_same(&all[i], hit)) {
            *own = all[i];
            return 1;
        }
    return 0;
}

/* Move the place along an expansion of these orders, by d in its unit of time. */
static void go_along(model_pieces *s, double d, int orders)
{
    values_at(s->c[0], COLUMNS, orders, d, N, s->at.x);
    pass_time(s, d*s->at.tau);
}

/* How the way to an event went: the time in which a sign was not known, and where that was; dips that were passed; an event. */
typedef struct {
    double width, at;
    int touches, crosses;
} isolated;

/* The coefficients of a condition about the place, in s/R, and what it may differ from them by on the disc; how many. */
static SELDOM int about_place(model_pieces *s, const condition *of, double R, double *c, double *e)
{
    const int p = of->acts == OF_L ? of->orders : s->order > DEGREE ? s->order : DEGREE;
    double power[DEGREES], sum = 0, y[DEGREES] = {0};
    power[0] = 1;
    for (int k = 0; k < p; k++)
        power[k + 1] = power[k]*R;
    if (of->acts == OF_L) {
        coefficients(s, of, c);
        for (int k = 0; k <= p; k++)
            c[k] *= power[k];
        *e = 0;
    } else {
        number_on_disc(DISC_T, s->at.t, p);
        DISC_T[1] = s->at.tau*R;
        for (int i = 0; i < N + M; i++) {
            double *x = DISC_X(i);
            number_on_disc(x, s->c[0][i], p);
            for (int k = 1; k <= s->order; k++)
                x[k] = s->c[k][i]*power[k];
        }
        look_on_disc(s, of, p, y);
        for (int k = 0; k <= p; k++)
            c[k] = of->sign*y[k];
        c[0] += of->shift;
        *e = y[p + 1];
    }
    for (int k = 0; k <= p; k++)
        sum += fabs(c[k]);
    *e += tie_of(s, of, TIE) + EPS*sum;
    return p + 1;
}

/* The first s in [0, 1] at which c is no more than e; NONE where it is more on all of it. */
static SELDOM double positive_until(model_pieces *s, int n, const double *c, double e)
{
    double row[MOST_ORDERS + 1];
    memcpy(row, c, n*sizeof *c);
    row[0] -= e;
    return row[0] > 0 ? first_root(s, n, row) : 0;
}

/* Where in [0, 1] a condition known to e, c(1) < -e, is 0. A root of order 3, 5, ... of one that is known to e alone is told best by
   the derivative that has a simple root there. */
static SELDOM double crossing_in(model_pieces *s, int n, const double *c, double e)
{
    for (int order = (n - 2 < MOST_MULTIPLE ? n - 2 : MOST_MULTIPLE)/2*2; order > 0; order -= 2) {
        double d[DEGREES], here[DEGREES], sum = 0;
        for (int k = order; k < n; k++) {
            d[k - order] = c[k];
            for (int j = 0; j < order; j++)
                d[k - order] *= k - j;
            sum += d[k - order];
        }
        if (!(d[0]*sum < 0))
            continue;
        for (int k = n - order - 1; k >= 0; k--)
            d[k] = d[0] < 0 ? -d[k] : d[k];
        const double root = first_root(s, n - order, d);
        memcpy(here, c, n*sizeof *c);
        recentre(n, here, root);
        if (largest_of(order, here) <= e)
            return root;
    }
    return c[0] > 0 ? min_of(first_root(s, n, c), 1) : 0;
}

/* How far on the sign is known again; *root: where on the way it changes, NONE where it does not. 0: not up to the end. */
static SELDOM double beyond_root(model_pieces *s, const condition *of, double end, double *root)
{
    double c[MOST_ORDERS + 1], e, R = EPS*fabs(s->at.t);
    for (R = R > 0 ? R : EPS*s->at.tau; R < end - s->at.t && spend_on(s); R *= WIDER) {
        const int n = about_place(s, of, R/s->at.tau, c, &e);
        const double v = value_of(n, c, 1);
        if (fabs(v) > e) {
            *root = v > 0 ? NONE : R*crossing_in(s, n, c, e);
            return R;
        }
    }
    return 0;
}

/* Move the place over what is proved to be positive, and over dips, to the first crossing, or to the time end. */
static SELDOM int isolate(model_pieces *s, const condition *hit, double end, isolated *found)
{
    const int p = s->order;
    double c[MOST_ORDERS + 1], e, R = end - s->at.t;
    int status = expand_finite(s, p);
    condition own;
    *found = (isolated){0, s->at.t, 0, 0};
    for (int pass = 0; !status && pass < MOST_DISCS; pass++) {
        R = min_of(R, end - s->at.t);
        if (!(R > 0) || !own_condition(s, hit, p, &own))
            return MODEL_OK;
        if (!spend_on(s))
            return MODEL_NOT_SOLVED;
        const int n = about_place(s, &own, R/s->at.tau, c, &e);
        const double at = positive_until(s, n, c, e);
        double step = at > 1 ? R : ALMOST*at*R;
        if (at <= 1 && s->at.t + step == s->at.t) {
            if (R > EPS*fabs(s->at.t)) {
                R /= CLOSER;
                continue;
            }
            double root = NONE;
            const double known = beyond_root(s, &own, end, &root), wide = known > 0 ? known : end - s->at.t;
            found->crosses = known > 0 && root < NONE;
            if (found->crosses || wide > found->width) {
                found->width = wide;
                found->at = s->at.t;
            }
            found->touches += !found->crosses;
            step = found->crosses ? root : wide;
            R = wide;
            if (found->crosses)
                found->at = s->at.t + step;
        } else
            R = at > 1 ? 2*R : at < 0.5 ? max_of(R/4, 2*step) : R/2;
        condition other;
        double clear = step/s->at.tau;
        const int stopped = first_event(s, &clear, &other, 0, hit->of) || clear < step/s->at.tau;
        go_along(s, clear, p);
        status = expand_finite(s, p);
        if (stopped)
            found->crosses = 0;
        if (stopped || found->crosses)
            return status;
    }
    return status;
}

/* How far c, or -c, goes until it is above a level, in doubling steps; NEAR where that is further. */
static SELDOM double until(int n, const double *c, double level, double sign)
{
    double at = EPS;
    while (at < NEAR && sign*value_of(n, c, sign > 0 ? -at : at) <= level)
        at *= 2;
    return min_of(at, NEAR);
}

/* The time about a crossing, whose expansion stands, in which the sign is not known where states are known to a share. */
static SELDOM double width_of(model_pieces *s, const condition *own, double share)
{
    double c[MOST_ORDERS + 1], e, power = 1;
    const int n = about_place(s, own, NEAR, c, &e);
    for (int k = 0; k < n; k++, power *= NEAR)
        c[k] /= power;
    e = tie_of(s, own, share);
    return (until(n, c, e, -1) + until(n, c, e, 1))*s->at.tau;
}

/* The expansion at an event; where the mode before has no number there, as near before it as time is known. */
static int arrive(model_pieces *s)
{
    const model_place begun = s->at;
    int status = expand_finite(s, AROUND);
    for (int i = 0; i < LATER && status; i++) {
        s->at.tau = begun.tau;
        creep(s, -ldexp(1, i));
        status = expand_finite(s, AROUND);
    }
    if (status || s->at.t == begun.t)
        return status;
    creep_along(s, begun.t, begun.x);
    return expand_finite(s, AROUND);
}

/* Move the place to where the condition is 0 to rounding, on expansions there; what is no simple root is isolated. */
static int polish(model_pieces *s, const condition *hit, double end, isolated *found)
{
    const double rtol = s->rtol/LOCAL;
    double c[MOST_ORDERS + 1], tie;
    condition own;
    int status, n;
    *found = (isolated){0, s->at.t, 0, 1};
    for (int pass = 0; pass < POLISHING; pass++) {
        if ((status = pass ? expand_finite(s, AROUND) : arrive(s)) || !own_condition(s, hit, AROUND, &own))
            return status;
        n = own.orders + 1;
        coefficients(s, &own, c);
        const double instant = T_ROUNDING*EPS*fabs(s->at.t)/s->at.tau;
        tie = TIE*size_of(s, &own);
        if (!is_simple(n, c, tie, instant) && !is_simple(n, c, tie = tie_of(s, &own, TIE), instant)) {
            if ((status = isolate(s, hit, end, found)))
                return status;
            if (found->crosses && own_condition(s, hit, s->order, &own)) {
                found->width = max_of(found->width, width_of(s, &own, rtol));
                coefficients(s, &own, c);
                const double share = share_of_order(own.orders + 1, c, 1);
                if (fabs(c[1])*share > tie_of(s, &own, TIE))
                    s->at.tau = unit_of(s->at.tau*share);
            }
            return expand_finite(s, AROUND);
        }
        double d = -c[0]/c[1];
        if ((pass && fabs(c[0]) <= ON_EVENT*tie) || fabs(d)*s->at.tau <= EPS*fabs(s->at.t))
            break;
        for (int i = 0; i < STEPS_PER_EXPANSION; i++) {
            const double e = slope_of(n, c, d), v = value_of(n, c, d);
            d -= e != 0 && fabs(v/e) < NEAR ? v/e : 0;
        }
        go_along(s, d, AROUND);
        if (pass == POLISHING - 1 && (status = expand_finite(s, AROUND)))
            return status;
    }
    found->at = s->at.t;
    if (own_condition(s, hit, AROUND, &own)) {
        coefficients(s, &own, c);
        if (!is_simple(own.orders + 1, c, rtol*size_of(s, &own), 0))
            found->width = width_of(s, &own, rtol);
    }
    return MODEL_OK;
}
