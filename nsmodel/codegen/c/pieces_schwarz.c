/* How far a piece is proved: pieces/schwarz.py. */

#define TIERS 3
#define STRIDE_OF_DISC (MOST_ORDERS + 2)
#define DISC_T (s->discs)
#define DISC_X(i) (s->discs + (size_t)(1 + (i))*STRIDE_OF_DISC)
#define DISC_L(i) DISC_X(N + (i))
#define DISC_F(i) DISC_X(N + M + (i))
#define DISC_H(i) DISC_X(2*N + M + (i))
#define DISC_G(i) DISC_X(2*N + 2*M + (i)) /* f alone, where g = B l */
#define DISC_W(b) DISC_X(3*N + 2*M + (b)) /* what branches look at */
#define DISC_ROWS DISC_X(3*N + 2*M + CHOICES)

/* A polynomial of n coefficients as a form of degree m on the disc of radius R. */
static void fill_disc(double *y, const double *c, int n, double R, int m)
{
    double power = 1, rest = 0;
    for (int k = 0; k < n; k++) {
        if (k <= m)
            y[k] = c[k]*power;
        else
            rest += fabs(c[k])*power;
        power *= R;
    }
    for (int k = n; k <= m; k++)
        y[k] = 0;
    y[m + 1] = rest;
}

/* f, g and h, and what branches look at, on the disc: x, l and t are there. */
static void run_part(model_pieces *s, const disc_graph *graph, int m)
{
    double *rows = DISC_ROWS;
    for (int i = 0; i < graph->given; i++) {
        const int *at = graph->inputs + 3*i;
        double *y = ROW(at[0]);
        if (at[1] == 3) {
            memset(y, 0, (m + 2)*sizeof *y);
            y[0] = s->c[0][T + 1 + at[2]];
        } else
            memcpy(y, at[1] == 0 ? DISC_T : at[1] == 1 ? DISC_X(at[2]) : DISC_L(at[2]), (m + 2)*sizeof *y);
    }
    run_graph(s, graph, rows, m);
}

/* Let the unit of time be shorter where f has no bound on the disc that x, on its tangent, and t come to in it. */
static void cap_unit(model_pieces *s, const double *rates)
{
    const double tau = s->at.tau;
    double *rows = DISC_ROWS;
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
        run_part(s, &f_graph, 0);
        for (int i = 0; i < N; i++)
            bounded &= ROW(f_graph.outputs[i])[1] < INFINITY;
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

/* Keep what the branches of a part look at. */
static void keep_looked(model_pieces *s, const disc_graph *graph, int m)
{
    double *rows = DISC_ROWS;
    for (int b = 0; b < graph->branches; b++)
        memcpy(DISC_W(graph->choices + b), ROW(graph->looked[b]), (m + 2)*sizeof(double));
}

/* f + g, h and what branches look at on the disc, of which x, l and t are there. */
static void on_disc(model_pieces *s, int m)
{
    double *rows = DISC_ROWS;
    run_part(s, &f_graph, m);
    keep_looked(s, &f_graph, m);
    for (int i = 0; i < N; i++) {
        memcpy(DISC_F(i), ROW(f_graph.outputs[i]), (m + 2)*sizeof(double));
        memcpy(DISC_G(i), DISC_F(i), (m + 2)*sizeof(double));
    }
#if LAW
#if B_NUMBERS
    for (int j = 0; j < M; j++)
        for (int e = B_start[j]; e < B_start[j + 1]; e++)
            disc_sum(DISC_F(B_row[e]), DISC_F(B_row[e]), B_value[e], DISC_L(j), m);
#else
    run_part(s, &g_graph, m);
    keep_looked(s, &g_graph, m);
    for (int i = 0; i < N; i++)
        disc_sum(DISC_F(i), DISC_F(i), 1, ROW(g_graph.outputs[i]), m);
#endif
    run_part(s, &h_graph, m);
    keep_looked(s, &h_graph, m);
    for (int i = 0; i < M; i++)
        memcpy(DISC_H(i), ROW(h_graph.outputs[i]), (m + 2)*sizeof(double));
#if FEED
#if D_NUMBERS
    for (int i = 0; i < M; i++)
        for (int e = D_start[i]; e < D_start[i + 1]; e++)
            disc_sum(DISC_H(i), DISC_H(i), D_value[e], DISC_L(D_column[e]), m);
#endif
#endif
#endif
}

/* Where x, l and y begin, what of them is of an order beyond m, and of the slopes of x: at most this on the disc. */
static void beyond_order(const model_pieces *s, int p, const double *power, int m, double *of, double *of_slope)
{
    const int count = N + 2*M;
    memset(of, 0, count*sizeof *of);
    memset(of_slope, 0, N*sizeof *of_slope);
    for (int k = m + 1; k <= p; k++)
        for (int i = 0; i < count; i++)
            of[i] += fabs(s->c[k][i])*power[k];
    for (int k = m + 2; k <= p; k++)
        for (int i = 0; i < N; i++)
            of_slope[i] += k*fabs(s->c[k][i])*power[k - 1];
#if LAW
    for (int i = 0; i < M; i++)
        if (s->at.codes[i])
            of[L + i] = 0;
#endif
}

/* x, l and t of a series on the disc. */
static void series_on_disc(model_pieces *s, const double *power, int m, const double *beyond)
{
    const double t[] = {s->at.t, s->at.tau};
    fill_disc(DISC_T, t, 2, power[1], m);
    for (int i = 0; i < N + M; i++) {
        double *y = DISC_X(i);
        const int orders = i >= N && s->at.codes[i - N] ? 0 : m;
        for (int k = 0; k <= orders; k++)
            y[k] = s->c[k][i]*power[k];
        for (int k = orders + 1; k <= m; k++)
            y[k] = 0;
        y[m + 1] = beyond[i];
    }
}

#if LAW
/* The worst of x with what lies along g_l of held rows as an error of l: of P D, P = 1 - B N C, and of N C D. */
static double beside_multipliers(model_pieces *s, const double *with_l, const double *without, const double *most, double share,
                                 double now, double length, double rtol)
{
    double moved[N] , left[M + 1], unit[N], of_y[M], d[M], along[M], worst = 0;
    memset(moved, 0, sizeof moved);
    memset(left, 0, sizeof left);
    for (int j = 0; j < N; j++) {
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
            if (fabs(unit[i]) > CANCELLED)
                moved[i] += fabs(unit[i])*without[j];
    }
    for (int i = 0; i < N; i++)
        worst = max_of(worst, share_of(moved[i]*share, most[i]));
    for (int a = 0; a < HOW.n; a++) {
        const int i = HOW.active[a];
        double at_end;
        values_at(s->c[0] + L + i, COLUMNS, s->order, length, 1, &at_end);
        const double size = max_of(size_l(s, i), max_of(fabs(s->c[0][L + i]), fabs(at_end)));
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
            s->bound[i] *= ROUNDING*s->at.tau;
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
static double worst_on_disc(model_pieces *s, double R, double length, int m, int *known)
{
    const int p = s->order;
    const double q = length/R, rtol = s->rtol/LOCAL;
    const double still = AS_NOW*max_of(fabs(s->at.t)/s->at.tau, length); /* in which nothing moves: time is not known better */
    double share = 1, now = 1, power[DEGREES], beyond[N + 2*M], of_slope[N], most[N], with_l[N], without[N], worst = 0;
    power[0] = 1;
    for (int k = 0; k < p; k++) {
        share *= q;
        now *= min_of(still/R, 1);
        power[k + 1] = power[k]*R;
    }
    beyond_order(s, p, power, m, beyond, of_slope);
    series_on_disc(s, power, m, beyond);
    on_disc(s, m);
    values_at(s->c[0], COLUMNS, p, length, N, s->value);
    for (int i = 0; i < N; i++) {
        double rate = 0;
        for (int k = p; k >= 1; k--)
            rate = rate*length + k*s->c[k][i];
        const double size = max_of(max_of(s->at.size_x[i], fabs(s->value[i])), fabs(rate*length));
        with_l[i] = of_slope[i] + s->at.tau*DISC_F(i)[m + 1];
        without[i] = with_l[i];
#if B_NUMBERS
        without[i] = of_slope[i] + s->at.tau*DISC_G(i)[m + 1];
#endif
        most[i] = ((p + 1)*(rtol*size + s->atol[i]/LOCAL + AT_REST) + (with_l[i] < INFINITY ? now*still*with_l[i] : 0))/length;
        worst = max_of(worst, share_of(with_l[i]*share, most[i]));
    }
#if LAW
    double of_x[N];
    for (int i = 0; i < N; i++)
        of_x[i] = max_of(s->at.size_x[i], fabs(s->value[i]));
#endif
    if (!(worst <= 1)) {
        worst = 0;
        for (int i = 0; i < N; i++) {
            most[i] += noise_of(s, known)[i];
            worst = max_of(worst, share_of(with_l[i]*share, most[i]));
        }
    }
    UNUSED(without);
#if LAW
    if (!(worst <= 1) && HOW.through)
        worst = beside_multipliers(s, with_l, without, most, share, now, length, rtol);
    if (!(worst < INFINITY))
        return worst;
    double of_l[M], largest = 0, of_rows = share;
    values_at(s->c[0] + L, COLUMNS, p, length, M, s->value + L);
    for (int i = 0; i < M; i++) {
        of_l[i] = max_of(s->at.size_l[i], fabs(s->at.codes[i] ? s->c[0][L + i] : s->value[L + i]));
        largest = max_of(largest, s->at.size_y[i]);
    }
    double of_now = now;
    if (HOW.feeds && !HOW.through) {
        of_rows *= q;
        of_now *= min_of(still/R, 1);
    }
    for (int i = 0; i < M; i++) {
        const double off = DISC_H(i)[m + 1] + (s->at.codes[i] ? beyond[Y + i] : 0);
        const double size = max_of(max_of(s->at.size_y[i], terms_of(s, i, of_x, of_l)), SMALL*largest);
        worst = max_of(worst, share_at(off, of_rows, of_now, rtol*size));
        s->margins_now[i] = off*of_rows;
    }
#endif
#if SWITCHED
    for (int b = 0; b < CHOICES; b++) {
        double of = 0;
        for (int k = m + 1; k < p; k++)
            of += fabs(s->c[k][branch_column[b]])*power[k];
        const double size = max_of(s->at.size_switches[b], fabs(s->c[0][branch_column[b]]));
        worst = max_of(worst, share_at(DISC_W(b)[m + 1] + of, share, now, rtol*size));
        s->margins_now[M + b] = (DISC_W(b)[m + 1] + of)*share;
    }
#endif
    return worst;
}

/* Whether no state moves by more than rtol of its size while time stands still: so far a singularity of f is stepped over. */
static int rests_for(const model_pieces *s, double still)
{
    for (int i = 0; i < N; i++) {
        const double size = max_of(s->at.size_x[i], fabs(s->c[0][i]));
        if (!(fabs(s->c[1][i])*still <= (s->rtol*size + s->atol[i])/LOCAL + AT_REST))
            return 0;
    }
    return still > 0;
}

/* The length that is proved, at most the one given, and the bound of the error there in units of rtol. */
static int prove(model_pieces *s, double *length, double *error)
{
    static const double radius[TIERS] = {RADIUS_OF_BALL, WIDE_RADIUS, CLOSE_RADIUS};
    const int p = s->order;
    const double still = AS_NOW*fabs(s->at.t)/s->at.tau;
    double disc = *length, best = 0, bound = 0;
    int known = 0;
    memset(s->margins, 0, sizeof s->margins);
    if (!(*length > 0))
        return MODEL_OK;
    for (int k = 0; k < SHRINKINGS; k++) {
        for (int tier = 0; tier < TIERS && best < PROVED*disc; tier++) {
            const double w = worst_on_disc(s, radius[tier]*disc, disc, tier ? p - 1 : 0, &known);
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
        if (!rests_for(s, best))
            return MODEL_TOO_SHORT;
    }
    *length = min_of(best, *length);
    *error = min_of(bound, 1);
    return MODEL_OK;
}
