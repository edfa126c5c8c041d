/* How far a piece is proved: event_driven/piece_bounds.py. */

#define DISC_T ROW(0)
#define DISC_X(i) ROW(1 + (i))
#define DISC_L(i) DISC_X(N + (i))

/* What of a column is of an order beyond m, up to p: at most this on the disc of radius R; raised: R^(m + 1). */
static double beyond(const double *c, int p, double R, int m, double raised)
{
    double sum = 0;
    for (int k = p; k > m; k--)
        sum = sum*R + fabs(c[(size_t)k*COLUMNS]);
    return sum*raised;
}

/* A column as a ball; what of its slope is of an order beyond 0. */
static double ball_on_disc(double *y, const double *c, int p, double R)
{
    double sum = 0, slope = 0;
    for (int k = p; k > 1; k--) {
        slope = slope*R + sum;
        sum = sum*R + fabs(c[(size_t)k*COLUMNS]);
    }
    y[0] = c[0];
    y[1] = (sum*R + fabs(c[COLUMNS]))*R;
    return (slope*R + 2*sum)*R;
}

/* A column as a form of degree p - 1; nothing of its slope is of an order beyond that. */
static double form_on_disc(double *y, const double *c, int p, double R)
{
    double power = 1;
    for (int k = 0; k < p; k++) {
        y[k] = c[(size_t)k*COLUMNS]*power;
        power *= R;
    }
    y[p] = fabs(c[(size_t)p*COLUMNS])*power;
    return 0;
}

/* x, l and t of a series on the disc; what of the slopes of x is of an order beyond m. */
static void series_on_disc(model_pieces *s, double R, int m, double *of_slope)
{
    const int p = s->order;
    number_on_disc(DISC_T, s->at.t, m);
    DISC_T[1] = s->at.tau*R;
    for (int i = 0; i < N; i++)
        of_slope[i] = m ? form_on_disc(DISC_X(i), s->c[0] + i, p, R) : ball_on_disc(DISC_X(i), s->c[0] + i, p, R);
#if LAW
    for (int i = 0; i < M; i++)
        if (s->at.codes[i])
            number_on_disc(DISC_L(i), s->c[0][L + i], m);
        else if (m)
            form_on_disc(DISC_L(i), s->c[0] + L + i, p, R);
        else
            ball_on_disc(DISC_L(i), s->c[0] + L + i, p, R);
#endif
}

/* Let the unit of time be shorter where f has no bound on the disc that x, on its tangent, and t come to in it. */
static SELDOM void cap_unit(model_pieces *s, const double *rates)
{
    const double tau = s->at.tau;
    for (int k = 0; k < CAPS; k++, s->at.tau = ldexp(s->at.tau, -CAP_OCTAVES)) {
        int bounded = 1;
        DISC_T[0] = s->at.t;
        DISC_T[1] = s->at.tau;
        for (int i = 0; i < N; i++) {
            DISC_X(i)[0] = s->at.x[i];
            DISC_X(i)[1] = fabs(rates[i])*s->at.tau;
        }
        for (int i = 0; i < M; i++) {
            DISC_L(i)[0] = s->c[0][L + i];
            DISC_L(i)[1] = 0;
        }
        run_lines(s, LINES_OF_F, 0, 0);
        for (int i = 0; i < N; i++)
            bounded &= ROW(disc_f[i])[1] < INFINITY;
        if (bounded)
            return;
    }
    s->at.tau = tau;
}

static double share_of(double bound, double most)
{
    return bound == 0 ? 0 : most > 0 && bound == bound ? bound/most : INFINITY;
}

/* How much of MULTIPLIERS times goal, or of what it does while time stands still, a row that begins at an order is. */
static double share_at(double bound, double to_order, double now, double goal)
{
    return bound < INFINITY ? share_of(bound*to_order, MULTIPLIERS*goal + AT_REST + bound*now) : INFINITY;
}

/* The rests of f + g. */
static void rests_of_rate(const model_pieces *s, int m, double *rest)
{
    for (int i = 0; i < N; i++)
        rest[i] = ROW(disc_f[i])[m + 1];
#if LAW
#if B_NUMBERS
    for (int j = 0; j < M; j++)
        for (int e = B_start[j]; e < B_start[j + 1]; e++)
            rest[B_row[e]] += B_value[e] != 0 ? fabs(B_value[e])*DISC_L(j)[m + 1] : 0;
#else
    for (int i = 0; i < N; i++)
        rest[i] += ROW(disc_g[i])[m + 1];
#endif
#endif
}

#if LAW
/* The rest of row i of h. */
static double rest_of_row(const model_pieces *s, int i, int m)
{
    double rest = ROW(disc_h[i])[m + 1];
#if FEED
#if D_NUMBERS
    for (int e = D_start[i]; e < D_start[i + 1]; e++)
        rest += D_value[e] != 0 ? fabs(D_value[e])*DISC_L(D_column[e])[m + 1] : 0;
#endif
#endif
    return rest;
}
#endif

/* Sizes at the end of a piece: of x with its motion, of x and l. */
typedef struct {
    double moving[N], x[N], l[M + 1];
} sizes_at_end;

static void find_sizes(const model_pieces *s, double length, sizes_at_end *of)
{
    const int p = s->order;
    for (int i = 0; i < N; i++) {
        double v = 0, d = 0;
        for (int k = p; k > 0; k--) {
            d = d*length + v;
            v = v*length + s->c[k][i];
        }
        d = d*length + v;
        of->x[i] = max_of(s->at.size_x[i], fabs(v*length + s->c[0][i]));
        of->moving[i] = max_of(of->x[i], fabs(d*length));
    }
#if LAW
    for (int i = 0; i < M; i++) {
        double v = s->c[0][L + i];
        if (!s->at.codes[i])
            values_at(s->c[0] + L + i, COLUMNS, p, length, 1, &v);
        of->l[i] = max_of(s->at.size_l[i], fabs(v));
    }
#endif
}

#if LAW
/* The worst of x with what lies along g_l of held rows as an error of l: of P D, P = 1 - B N C, and of N C D. */
static double beside_multipliers(model_pieces *s, const sizes_at_end *of, const double *with_l, const double *of_slope,
                                 const double *most, int m, double share, double now, double rtol)
{
    double moved[N], without[N], left[M + 1], unit[N], of_y[M], d[M], along[M], worst = 0;
    UNUSED(of_slope);
    UNUSED(m);
    memset(moved, 0, sizeof moved);
    memset(left, 0, sizeof left);
    for (int j = 0; j < N; j++) {
#if B_NUMBERS
        without[j] = of_slope[j] + s->at.tau*ROW(disc_f[j])[m + 1];
#else
        without[j] = with_l[j];
#endif
        if (with_l[j] == 0 && without[j] == 0)
            continue;
        memset(unit, 0, sizeof unit);
        memset(along, 0, sizeof along);
        unit[j] = 1;
        for (int a = 0; a < HOW.n; a++)
            of_y[HOW.active[a]] = slope_along(s, HOW.active[a], unit);
        through(s, of_y, 1, d);
        for (int a = 0; a < HOW.n; a++) {
            along[HOW.active[a]] = d[a];
            left[a] += d[a] != 0 ? fabs(d[a])*with_l[j] : 0;
        }
        add_push(s, unit, along);
        for (int i = 0; i < N; i++)
            if (fabs(unit[i]) > ENTRY_CANCELLED)
                moved[i] += fabs(unit[i])*without[j];
    }
    for (int i = 0; i < N; i++)
        worst = max_of(worst, share_of(moved[i]*share, most[i]));
    for (int a = 0; a < HOW.n; a++) {
        const int i = HOW.active[a];
        const double size = max_of(size_l(s, i), max_of(fabs(s->c[0][L + i]), of->l[i]));
        worst = max_of(worst, share_at(left[a]/s->at.tau, share, now, rtol*size));
    }
    return worst;
}
#endif

/* What f + g may err by at the values, evaluated where it is not known yet. */
static const double *bound_of(model_pieces *s, int *known)
{
    if (!*known) {
        rounding(s, s->now, s->value, s->value + N, s->bound);
        for (int i = 0; i < N; i++)
            s->bound[i] *= TERM_ROUNDING*s->at.tau;
        *known = 1;
    }
    return s->bound;
}

/* The same of tau (f + g) where the piece begins: no piece is to be better. */
static const double *noise_of(model_pieces *s, int *known)
{
    if (!*known) {
        s->now[0] = s->at.t;
        memcpy(s->value, s->c[0], (N + M)*sizeof *s->value);
    }
    return bound_of(s, known);
}

/* The largest bound on a piece of this length, in units of what it may be; infinite where the disc holds a singularity. */
static NOT_INLINE double worst_on_disc(model_pieces *s, const sizes_at_end *of, double R, double length, int m, int *known)
{
    const int p = s->order;
    const double q = length/R, rtol = s->rtol/LOCAL, share = raised_to(q, p), raised = m ? raised_to(R, p) : R;
    const double still = AS_NOW*max_of(fabs(s->at.t)/s->at.tau, length); /* in which nothing moves: time is not known better */
    const double now = raised_to(min_of(still/R, 1), p);
    double of_slope[N], most[N], with_l[N], worst = 0;
    UNUSED(raised);
    series_on_disc(s, R, m, of_slope);
    run_lines(s, DISC_LINES, m, 0);
    rests_of_rate(s, m, with_l);
    for (int i = 0; i < N; i++) {
        with_l[i] = of_slope[i] + s->at.tau*with_l[i];
        const double least = (p + 1)*(rtol*of->moving[i] + s->atol[i]/LOCAL + AT_REST);
        most[i] = (least + (with_l[i] < INFINITY ? now*still*with_l[i] : 0))/length;
        worst = max_of(worst, share_of(with_l[i]*share, most[i]));
    }
    if (!(worst <= 1)) {
        worst = 0;
        for (int i = 0; i < N; i++) {
            most[i] += noise_of(s, known)[i];
            worst = max_of(worst, share_of(with_l[i]*share, most[i]));
        }
    }
#if LAW
    if (!(worst <= 1) && HOW.through)
        worst = beside_multipliers(s, of, with_l, of_slope, most, m, share, now, rtol);
    if (!(worst < INFINITY))
        return worst;
    double largest = 0, of_rows = share, of_now = now;
    for (int i = 0; i < M; i++)
        largest = max_of(largest, s->at.size_y[i]);
    if (HOW.feeds && !HOW.through) {
        of_rows *= q;
        of_now *= min_of(still/R, 1);
    }
    for (int i = 0; i < M; i++) {
        const double off = rest_of_row(s, i, m) + (s->at.codes[i] ? beyond(s->c[0] + Y + i, p, R, m, raised) : 0);
        const double size = max_of(max_of(s->at.size_y[i], terms_of(s, i, of->x, of->l)), SMALL*largest);
        worst = max_of(worst, share_at(off, of_rows, of_now, rtol*size));
        s->margins_now[i] = off*of_rows;
    }
#endif
#if SWITCHED
    for (int b = 0; b < CHOICES; b++) {
        const double off = ROW(disc_looked[b])[m + 1] + beyond(s->c[0] + branch_column[b], p - 1, R, m, raised);
        const double size = max_of(s->at.size_switches[b], fabs(s->c[0][branch_column[b]]));
        worst = max_of(worst, share_at(off, share, now, rtol*size));
        s->margins_now[M + b] = off*share;
    }
#endif
    return worst;
}

/* How far each state would move in s, at the rate that it has so much later on its tangent. */
static SELDOM void moved_in(model_pieces *s, double time, double moved[N])
{
    double y[M + 1];
    for (int i = 0; i < N; i++)
        s->value[i] = s->c[0][i] + time*s->c[1][i];
    s->now[0] = s->at.t + s->at.tau*time;
    equations(s, s->now, s->value, s->c[0] + L, moved, y);
    for (int i = 0; i < N; i++)
        moved[i] = fabs(s->at.tau*moved[i]*time);
}

/* Whether a state moves by more than rounding, at a rate that is much larger than a little before and later. */
static SELDOM int grows_about(model_pieces *s, double time)
{
    double before[N], later[N];
    moved_in(s, -time, before);
    moved_in(s, time, later);
    for (int i = 0; i < N; i++) {
        const double here = fabs(s->c[1][i])*time, least = EPS*FAR*max_of(fabs(s->c[0][i]), s->at.size_x[i]);
        if (here > least && here > GROWS*max_of(before[i], later[i]))
            return 1;
    }
    return 0;
}

/* Whether no state moves by more than rtol of its size while time stands still, and no rate grows as near a pole: so far a
   singularity of f is stepped over. */
static SELDOM int rests_here(model_pieces *s)
{
    const double still = AS_NOW*fabs(s->at.t)/s->at.tau;
    for (int i = 0; i < N; i++) {
        const double size = max_of(s->at.size_x[i], fabs(s->c[0][i]));
        if (!(fabs(s->c[1][i])*still <= (s->rtol*size + s->atol[i])/LOCAL + AT_REST))
            return 0;
    }
    return still > 0 && !grows_about(s, FAR*still);
}

/* The length that is proved, at most the one given, and the bound of the error there in units of rtol. */
static int prove(model_pieces *s, double *length, double *error)
{
    static const double radius[] = {RADIUS_OF_BALL, WIDE_RADIUS, CLOSE_RADIUS};
    const int p = s->order;
    const double still = AS_NOW*fabs(s->at.t)/s->at.tau;
    double disc = *length, best = 0, bound = 0;
    int known = 0;
    memset(s->margins, 0, sizeof s->margins);
    if (!(*length > 0))
        return MODEL_OK;
    for (int k = 0; k < SHRINKINGS; k++) {
        sizes_at_end of;
        find_sizes(s, disc, &of);
        for (int tier = 0; tier < (int)(sizeof radius/sizeof *radius) && best < PROVED*disc; tier++) {
            const double w = worst_on_disc(s, &of, radius[tier]*disc, disc, tier ? p - 1 : 0, &known);
            const double proved = w <= 1 ? disc : w < INFINITY ? disc*NEARLY*pow(w, -1.0/p) : 0;
            if (!spend_on(s))
                return MODEL_NOT_SOLVED;
            if (proved > best) {
                best = proved;
                bound = proved == disc ? w : w*pow(proved/disc, p);
                memcpy(s->margins, s->margins_now, sizeof s->margins);
            }
        }
        if (best >= PROVED*disc)
            break;
        if (disc <= still)
            break;
        disc = max_of(k < SLOWLY || best > disc/QUICKLY ? disc/2 : max_of(disc/QUICKLY, 2*best), still);
    }
    if (!(best > 0)) {
        best = still;
        bound = 1;
        if (!rests_here(s))
            return MODEL_TOO_SHORT;
    }
    *length = min_of(best, *length);
    *error = min_of(bound, 1);
    return MODEL_OK;
}
