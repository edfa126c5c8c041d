#if STIFF
/* One piece of a stiff mode: event_driven/radau.py. */

#define UNKNOWN MODEL_PIECES_UNKNOWN
#define STAGES MODEL_PIECES_STAGES
#define OCTAVES_KEPT MODEL_PIECES_OCTAVES
#define WIDE 4 /* columns */

/* The matrices of s stages, see event_driven/collocation.py. */
typedef struct {
    int stages;
    double share;
    const double *nodes, *between, *weights; /* (s) */
    const double *rates; /* a real one, and real and imaginary parts of pairs */
    const double *inverse, *powers, *middle, *values, *slopes; /* (s, s), the third (s + 1, s) */
    const double *left, *right; /* inverse = right rates left, in real blocks */
} collocation;

static int stages_of(int order) { return 2*(order/ORDERS_OF_TWO) + 1; }

static collocation collocation_of(int order)
{
    const int s = stages_of(order);
    const double *a = radau_tables[(s - FEWEST_STAGES)/2];
    collocation of = {s, a[0], a + 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    of.between = of.nodes + s;
    of.weights = of.between + s;
    of.rates = of.weights + s;
    of.inverse = of.rates + s;
    of.powers = of.inverse + s*s;
    of.middle = of.powers + s*s;
    of.values = of.middle + (s + 1)*s;
    of.slopes = of.values + s*s;
    of.left = of.slopes + s*s;
    of.right = of.left + s*s;
    return of;
}

/* How many rows are held. */
static int count_held(const model_pieces *s)
{
#if LAW
    return HOW.n;
#else
    UNUSED(s);
    return 0;
#endif
}

/* out (r, c) = A (r, k) B, where the rows of B lie so far apart; WIDE columns at once, so that sums stay in registers. */
static void multiply(int r, int k, int c, const double *A, const double *B, int apart, double *restrict out)
{
    for (int i = 0; i < r; i++, A += k, out += c) {
        int e = 0;
        for (; e + WIDE <= c; e += WIDE) {
            double sum[WIDE] = {0};
            for (int j = 0; j < k; j++)
                for (int u = 0; u < WIDE; u++)
                    sum[u] += A[j]*B[j*apart + e + u];
            for (int u = 0; u < WIDE; u++)
                out[e + u] = sum[u];
        }
        for (; e < c; e++) {
            double sum = 0;
            for (int j = 0; j < k; j++)
                sum += A[j]*B[j*apart + e];
            out[e] = sum;
        }
    }
}

/* The inverse of (a + i b) E - h J, of (x, l of held rows), as real blocks, transposed; one block where b is 0. */
static int inverse_at(const model_pieces *s, double h, double a, double b, double *out)
{
    const int q = N + count_held(s), n = b != 0 ? 2*q : q;
    memset(out, 0, n*n*sizeof *out);
    for (int block = 0; block < n; block += q) {
        for (int i = 0; i < q; i++) {
            double *row = out + (block + i)*n + block;
            for (int j = 0; j < q; j++)
                row[j] = j < N ? -h*s->jacobian[j*q + i] : s->jacobian[j*q + i];
            if (i < N) {
                row[i] += a;
                out[(block + i)*n + (n - q - block) + i] += block ? -b : b;
            }
        }
    }
    return inverse_of(n, out);
}

/* The inverses for a piece of length h: that of the error, and those of the stages; NULL where one is singular. */
static const double *inverses_for(model_pieces *s, const collocation *of, double h)
{
    int e, slot = 0; /* of powers of two all others are kept, while the slopes stay */
    if (frexp(h, &e) == 0.5)
        slot = 1 + (e % OCTAVES_KEPT + OCTAVES_KEPT) % OCTAVES_KEPT;
    const int q = N + count_held(s);
    double *const kept = s->inverses[slot], *inverse = kept + q*q;
    if (s->lengths[slot] == h)
        return kept;
    s->lengths[slot] = 0;
    if (!inverse_at(s, h, 1/of->share, 0, kept))
        return NULL;
    for (int block = 0; block < of->stages; block += block ? 2 : 1) {
        if (!inverse_at(s, h, of->rates[block], block ? of->rates[block + 1] : 0, inverse))
            return NULL;
        inverse += (block ? 2 : 1)*(block ? 2 : 1)*q*q;
    }
    s->lengths[slot] = h;
    return kept;
}

/* Stand where a series of the mode has just been made: x, l, y, what branches look at, and the slopes there. */
static void stand(model_pieces *s)
{
    const int q = N + count_held(s);
    double f_x[N*N], g_l[N*M + 1], h_x[M*N + 1], h_l[M*M + 1], before[UNKNOWN*UNKNOWN];
    memcpy(before, s->jacobian, sizeof before);
    memcpy(s->first, s->c[0], ROWS*sizeof *s->first);
#if SWITCHED
    for (int b = 0; b < CHOICES; b++)
        s->first[ROWS + b] = s->c[0][branch_column[b]];
#endif
    s->now[0] = s->at.t;
    slopes_on_sides(s, s->now, s->first, s->first + L, f_x, g_l, h_x, h_l);
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++)
            s->jacobian[i*q + j] = f_x[i*N + j];
#if LAW
    for (int a = 0; a < HOW.n; a++) {
        const int held = HOW.active[a];
        for (int j = 0; j < N; j++) {
            s->jacobian[j*q + N + a] = g_l[j*M + held];
            s->jacobian[(N + a)*q + j] = h_x[held*N + j];
        }
        for (int b = 0; b < HOW.n; b++)
            s->jacobian[(N + a)*q + N + b] = h_l[held*M + HOW.active[b]];
    }
#endif
    if (q != s->unknown || memcmp(before, s->jacobian, q*q*sizeof *before) != 0)
        memset(s->lengths, 0, sizeof s->lengths);
    s->unknown = q;
}

/* f + g at x and l of a row at this time; y, and what branches look at, into the row. */
static void at_place(model_pieces *s, double t, double *row, double *rate)
{
    double y[M + 1];
    s->now[0] = t;
#if SWITCHED
    double looked[CHOICES];
    sides(s, s->now, row, row + L, rate, y, looked);
    memcpy(row + ROWS, looked, sizeof looked);
#else
    equations(s, s->now, row, row + L, rate, y);
#endif
    memcpy(row + Y, y, M*sizeof *y);
}

/* h (f + g) less slopes of the polynomial, and -y of held rows, at each row of places at these times: into s->missed. */
static void miss(model_pieces *s, const collocation *of, double h, const double *times, const double *slopes, double *places)
{
    const int q = N + count_held(s);
    double Z[STAGES*N], rates[STAGES*N];
    for (int j = 0; j < of->stages; j++)
        for (int i = 0; i < N; i++)
            Z[j*N + i] = s->nodal[j*SIDES + i] - s->first[i];
    multiply(of->stages, of->stages, N, slopes, Z, N, rates);
    for (int j = 0; j < of->stages; j++) {
        double *row = places + j*SIDES, *missed = s->missed + j*q;
        at_place(s, s->at.t + h*times[j], row, s->f);
        for (int i = 0; i < N; i++)
            missed[i] = h*s->f[i] - rates[j*N + i];
#if LAW
        for (int a = 0; a < HOW.n; a++)
            missed[N + a] = -row[Y + HOW.active[a]];
#endif
    }
}

/* The rounding of a solution by the inverse, of x and l of held rows of these sizes: of |inverse| |matrix| times these. */
static void round_off(const model_pieces *s, double h, double share, const double *inverse, const double *size, double *out)
{
    const int q = N + count_held(s);
    memset(out, 0, q*sizeof *out);
    for (int k = 0; k < q; k++) {
        double terms = 0;
        for (int i = 0; i < q; i++) {
            double entry = (k < N ? -h : 1)*s->jacobian[k*q + i];
            if (i == k && k < N)
                entry += 1/share;
#if LAW
            terms += fabs(entry)*size[i < N ? i : L + HOW.active[i - N]];
#else
            terms += fabs(entry)*size[i];
#endif
        }
        for (int i = 0; i < q; i++)
            out[i] += STAGE_ROUNDING*fabs(inverse[k*q + i])*terms;
    }
}

/* The polynomials of the values at the nodes about the middle of the piece, in its own length. */
static void about_middle(model_pieces *s, const collocation *of, double *c)
{
    const int stages = of->stages;
    double *Z = s->between, more[(STAGES + 1)*SIDES];
    for (int j = 0; j < stages; j++)
        for (int i = 0; i < SIDES; i++)
            Z[j*SIDES + i] = s->nodal[j*SIDES + i] - s->first[i];
    multiply(stages + 1, stages, SIDES, of->middle, Z, SIDES, c);
    for (int j = 0; j < stages; j++) /* what that misses at the nodes is put right */
        for (int i = 0; i < SIDES; i++) {
            double v = 0;
            for (int k = stages; k >= 0; k--)
                v = v*(of->nodes[j] - 0.5) + c[k*SIDES + i];
            Z[j*SIDES + i] -= v;
        }
    multiply(stages + 1, stages, SIDES, of->middle, Z, SIDES, more);
    for (int i = 0; i < (stages + 1)*SIDES; i++)
        c[i] += more[i];
    for (int i = 0; i < SIDES; i++)
        c[i] += s->first[i];
}

/* An estimate of what the polynomials err by, in units of rtol, and where it is at most 1 a bound of it. */
static double error_of_fit(model_pieces *s, const collocation *of, double h, double rtol, const double *inverse, double *estimate)
{
    const int stages = of->stages, q = N + count_held(s);
    double size[SIDES], rounding[UNKNOWN], worst = 0, *off = s->moved;
    memcpy(size, s->at.size_x, N*sizeof *size);
    memset(size + N, 0, (SIDES - N)*sizeof *size);
#if LAW
    memcpy(size + L, s->at.size_l, M*sizeof *size);
    memcpy(size + Y, s->at.size_y, M*sizeof *size);
#endif
    for (int j = 0; j < stages; j++)
        for (int i = 0; i < N + M; i++) {
            const int at = i < N ? i : L + i - N;
            size[at] = max_of(size[at], fabs(s->nodal[j*SIDES + at]));
        }
#if LAW /* of y, and of what branches look at, not by what they come to: that may be beyond where they are 0 */
    for (int i = 0; i < M; i++)
        size[Y + i] = max_of(max_of(size[Y + i], fabs(s->first[Y + i])), terms_of(s, i, size, size + L));
#endif
#if SWITCHED
    for (int b = 0; b < CHOICES; b++)
        size[ROWS + b] = max_of(s->at.size_switches[b], fabs(s->first[ROWS + b]));
#endif
    for (int j = 0; j < stages; j++)
        for (int i = 0; i < SIDES; i++)
            s->work_stages[j*SIDES + i] = s->nodal[j*SIDES + i] - s->first[i];
    multiply(stages, stages, SIDES, of->values, s->work_stages, SIDES, s->between);
    for (int j = 0; j < stages; j++)
        for (int i = 0; i < SIDES; i++)
            s->between[j*SIDES + i] += s->first[i];
    memcpy(s->work_stages, s->between, stages*SIDES*sizeof *s->between);
    miss(s, of, h, of->between, of->slopes, s->work_stages);
    multiply(stages, q, q, s->missed, inverse, q, off);
    round_off(s, h, of->share, inverse, size, rounding);
    for (int j = 0; j < stages; j++)
        for (int i = 0; i < N; i++) {
            const double allowed = rtol*size[i] + INNER_SHARE*s->atol[i];
            worst = beside(worst, off[j*q + i], rounding[i], of->weights[j], allowed);
            if (s->residuals)
                worst = beside(worst, s->missed[j*q + i]*of->weights[j], STAGE_ROUNDING*size[i], 1, allowed);
        }
#if LAW
    double y_floor = 0, l_floor = 0;
    for (int i = 0; i < M; i++)
        if (s->at.codes[i])
            y_floor = max_of(y_floor, SMALL*size[Y + i]);
        else
            l_floor = max_of(l_floor, SMALL*size[L + i]);
    for (int i = 0; i < M; i++) {
        size[Y + i] = max_of(size[Y + i], y_floor);
        size[L + i] = max_of(size[L + i], l_floor);
    }
    for (int a = 0; a < HOW.n; a++)
        for (int j = 0; j < stages; j++)
            worst = beside(worst, off[j*q + N + a], rounding[N + a], 1, MULTIPLIERS*rtol*size[L + HOW.active[a]]);
    for (int i = 0; i < M; i++)
        for (int j = 0, y = Y + i; j < stages && s->at.codes[i]; j++, y += SIDES)
            worst = beside(worst, s->between[y] - s->work_stages[y], STAGE_ROUNDING*size[Y + i], 1, MULTIPLIERS*rtol*size[Y + i]);
#endif
#if SWITCHED
    double floor_of = 0;
    for (int b = 0; b < CHOICES; b++)
        floor_of = max_of(floor_of, SMALL*size[ROWS + b]);
    for (int b = 0; b < CHOICES; b++) {
        const double own = size[ROWS + b] = max_of(size[ROWS + b], floor_of);
        for (int j = 0, i = ROWS + b; j < stages; j++, i += SIDES)
            worst = beside(worst, s->between[i] - s->work_stages[i], STAGE_ROUNDING*own, 1, MULTIPLIERS*rtol*own);
    }
#endif
    *estimate = worst;
    if (worst <= 1) {
        double c[(STAGES + 1)*SIDES];
        about_middle(s, of, c);
        worst = max_of(worst, cover(s, c, stages + 1, h, rtol, inverse, q, size, rounding));
    }
    return worst;
}

/* One iteration of Newton's method at the nodes: by how much x moved beside its size, and l of held rows beside itself. */
static void iterate(model_pieces *s, const collocation *of, double h, const double *inverse, double *moved)
{
    const int stages = of->stages, q = N + count_held(s);
    double *w = s->work_stages, *step = s->moved;
    miss(s, of, h, of->nodes, of->inverse, s->nodal);
    multiply(stages, stages, q, of->left, s->missed, q, w);
    for (int block = 0; block < stages; block += block ? 2 : 1) {
        const int n = block ? 2*q : q;
        multiply(1, n, n, w + block*q, inverse, n, s->missed + block*q);
        inverse += n*n;
    }
    multiply(stages, stages, q, of->right, s->missed, q, step);
    moved[0] = moved[1] = 0;
    for (int j = 0; j < stages; j++) {
        double *row = s->nodal + j*SIDES;
        for (int i = 0; i < N; i++) {
            const double size = max_of(max_of(s->at.size_x[i], fabs(s->first[i])) + INNER_SHARE*s->atol[i], NOTHING);
            row[i] += step[j*q + i];
            moved[0] = worse_of(moved[0], fabs(step[j*q + i])/max_of(size, fabs(row[i] - s->first[i])));
        }
#if LAW
        for (int a = 0; a < HOW.n; a++) {
            double *l = row + L + HOW.active[a];
            *l += step[j*q + N + a];
            moved[1] = worse_of(moved[1], fabs(step[j*q + N + a])/(fabs(*l) + NOTHING));
        }
#endif
    }
}

/* The piece of length h from where it stands, at the nodes: its error in units of rtol; NAN where Newton's method does not settle. */
static double fit(model_pieces *s, double h, double *estimate)
{
    const collocation of = collocation_of(s->order);
    const int stages = of.stages, q = N + count_held(s);
    const double rtol = INNER_SHARE*(s->rtol/LOCAL);
    const double *inverses = inverses_for(s, &of, h);
    double moved[2] = {INFINITY, INFINITY};
    *estimate = INFINITY;
    spend_on(s);
    if (inverses == NULL)
        return NAN;
    for (int j = 0; j < stages; j++)
        memcpy(s->nodal + j*SIDES, s->first, SIDES*sizeof *s->first);
    for (int iteration = 0;; iteration++) {
        const double before[] = {moved[0], moved[1]};
        double foretold = 0;
        if (iteration == STAGE_ITERATIONS)
            return NAN;
        iterate(s, &of, h, inverses + q*q, moved);
        for (int i = 0; i < 2; i++)
            foretold = worse_of(foretold, moved[i]*(iteration && moved[i] < before[i] ? moved[i]/before[i] : 1));
        const int l_comes_nearer = iteration == 0 || moved[1] < SLOW*before[1]; /* x = -D l may be rounding of its size before */
        if (foretold <= STAGE_SETTLED || (moved[0] <= STAGE_SETTLED && !l_comes_nearer))
            break;
        if (iteration > 1 && !(moved[0] <= SLOW*before[0] || l_comes_nearer)) { /* the second mends rounding of the inverse */
            if (moved[0] <= max_of(STAGE_NEAR*rtol, STAGE_ROUNDING))
                break;
            return NAN;
        }
    }
    for (int j = 0; j < stages; j++) {
        double *row = s->nodal + j*SIDES;
        at_place(s, s->at.t + h*of.nodes[j], row, s->f);
#if LAW
        for (int a = 0; a < HOW.n; a++)
            row[Y + HOW.active[a]] = 0;
#endif
    }
    return error_of_fit(s, &of, h, rtol, inverses, estimate);
}

/* Put the polynomials into the columns, in the unit of time of the length h, and what is at the end; their length in it. */
static double write_fit(model_pieces *s, double h)
{
    const collocation of = collocation_of(s->order);
    const int stages = of.stages;
    double *Z = s->between, *c = s->work_stages, raised = 1, more[STAGES*SIDES];
    for (int j = 0; j < stages; j++)
        for (int i = 0; i < SIDES; i++)
            Z[j*SIDES + i] = s->nodal[j*SIDES + i] - s->first[i];
#if LAW
    for (int a = 0; a < HOW.n; a++)
        for (int j = 0; j < stages; j++)
            Z[j*SIDES + Y + HOW.active[a]] = 0;
#endif
    multiply(stages, stages, SIDES, of.powers, Z, SIDES, c);
    for (int j = 0; j < stages; j++) /* what that misses at the nodes is put right */
        for (int i = 0; i < SIDES; i++) {
            double v = 0;
            for (int k = stages - 1; k >= 0; k--)
                v = (v + c[k*SIDES + i])*of.nodes[j];
            Z[j*SIDES + i] -= v;
        }
    multiply(stages, stages, SIDES, of.powers, Z, SIDES, more);
    s->at.tau = unit_of(h);
    for (int k = 0; k <= s->order; k++) {
        double *to = s->c[k], *from = k ? c + (k - 1)*SIDES : s->first;
        for (int i = 0; i < SIDES && 0 < k && k <= stages; i++)
            from[i] = (from[i] + more[(k - 1)*SIDES + i])*raised;
        if (k > stages)
            memset(from = more, 0, SIDES*sizeof *more);
#if SWITCHED
        for (int b = 0; b < CHOICES; b++)
            to[branch_column[b]] = from[ROWS + b];
#endif
        to[T] = k == 0 ? s->at.t : k == 1 ? s->at.tau : 0;
        memcpy(to, from, ROWS*sizeof *to);
        raised *= s->at.tau/h;
    }
#if LAW
    for (int a = 0; a < HOW.n; a++)
        s->c[0][Y + HOW.active[a]] = 0;
#endif
    memcpy(s->last, s->nodal + (stages - 1)*SIDES, sizeof s->last);
    return h/s->at.tau;
}
#endif
