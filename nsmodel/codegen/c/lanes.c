/* Many runs in step: on its index set a step is an affine map of the state, whose numbers each run has of its own. What a map gives
   is judged in all lanes; a lane in which it is not clear takes the step by attempt(), which finds the next index set. A lane
   takes the same operations in the same order whatever the others do, and however many they are. */

#ifndef MODEL_LANES
#define MODEL_LANES @LANES@
#endif
#define COLUMNS @MAP_COLUMNS@ /* of a map: the places of the state that a step depends on, and 1 */
#define BARE @BARE@ /* unknowns that are exact without the z where nothing moves */
#define LOOK_AFTER 1024 /* steps between two looks at the clock, */
#define LANES_PER_LOOK 16 /* or looks at lanes one by one */
#define HOPELESS 1e-3 /* residual of the law from which on rounding is not asked: it is another index set */

#if defined __clang__ || defined __GNUC__
#define LANE_LOOP _Pragma("omp simd")
#define LANE_LOOP_OR _Pragma("omp simd reduction(|:look)")
#define IN_LINE static inline __attribute__((always_inline))
#define ALIGNED __attribute__((aligned(@ALIGNMENT@)))
#else
#define LANE_LOOP
#define LANE_LOOP_OR
#define IN_LINE static
#define ALIGNED
#endif

typedef double lane[MODEL_LANES];

/* Runs in step, of the cells cell[0], cell[1], ...; lanes without a run, or whose run has ended, are not on. */
typedef struct {
    ALIGNED lane x[2][MODEL_NSTATE]; /* before a step of even number, of odd number */
    ALIGNED lane numbers[@MAP_NUMBERS@], p[MODEL_NP], lower[MODEL_M], upper[MODEL_M];
    ALIGNED lane of_z[MODEL_N*COLUMNS], of_l[MODEL_M*COLUMNS], of_b[MODEL_M*COLUMNS]; /* maps of the state */
    ALIGNED lane keep[BARE + 1]; /* 0 where z is exact without the z where nothing moves */
    ALIGNED lane above[MODEL_M], below[MODEL_M]; /* 1 where y must not be above 0, below 0, else 0 */
    ALIGNED lane least[MODEL_M], most[MODEL_M];  /* the same as ends of y */
    ALIGNED lane per[MODEL_M], reach[MODEL_M];   /* 1/sqrt(w_max) and what bounds the scale of y: see output_scale in affine.c */
    ALIGNED lane worst[2]; /* residual so far, before a step of even number, of odd number */
    ALIGNED lane z[MODEL_N], l[MODEL_M], y[MODEL_M], E[MODEL_N], scale[MODEL_N], size[MODEL_M], wrong[MODEL_M];
    ALIGNED lane inside, residual; /* of the step that was looked at; inside: 0 where l is, and y nearly right, else infinite */
    ALIGNED long long on[MODEL_LANES];     /* -1, or 0 */
    double iterations[MODEL_LANES], alone[MODEL_LANES]; /* alone: steps by attempt() */
    long cell[MODEL_LANES], failed[MODEL_LANES];
    int mapped[MODEL_LANES], status[MODEL_LANES];
    int count; /* lanes that have a run */
    long looks;
    model_solver solver[MODEL_LANES];
} model_lanes;

/* Go on with a batch in the memory g, aligned to 64 bytes, for about `seconds`; 1 where all of it is done. level: of the processor
   that is made use of, 0: none, 1: AVX2, 2: AVX-512, -1: what there is; the bits are the same. */
int model_run_lanes(model_lanes *g, model_cells *b, double seconds, int level);
long model_lanes_size(void);

/* The larger, the second where one is NaN. */
IN_LINE double larger(double a, double b) { return a > b ? a : b; }

IN_LINE double smaller(double a, double b) { return a < b ? a : b; }

/* The ratio of an error and its scale, 0/0 = 0. */
IN_LINE double part_of(double error, double scale) { return error/larger(scale, UNRESOLVED); }

/* What an error bound adds to a scale; nothing where it is infinite. */
IN_LINE double unseen(double error) { return error < INFINITY ? ROUND_OFF/TOLERANCE*error : 0; }

/* Put the inputs of step k into the state before it. */
IN_LINE void set_inputs(model_lanes *g, const model_cells *b, long k)
{
#if INPUTS
    for (int i = 0; i < 2*MODEL_INPUTS; i++)
        for (int j = 0; j < MODEL_LANES; j++)
            g->x[k & 1][BEGIN + i][j] = b->inputs[2*MODEL_INPUTS*k + i];
#else
    (void)g;
    (void)b;
    (void)k;
#endif
}

/* Take steps from number k to number `to`, up to one in which a lane must be looked at: its number. */
IN_LINE long take_steps(model_lanes *g, const model_cells *b, long k, long to)
{
    for (; k < to; k++) {
        set_inputs(g, b, k);
        const lane *x = (const lane *)g->x[k & 1];
        lane *next = g->x[~k & 1];
        const double *worst = g->worst[k & 1];
        double *worse = g->worst[~k & 1];
        long long look = 0;
        LANE_LOOP_OR
        for (int j = 0; j < MODEL_LANES; j++) {
@STEPS@            const int clear = (r <= EXPLAINED) & @SETTLED@;
            worse[j] = clear & (r > worst[j]) ? r : worst[j];
            look |= g->on[j] & -(long long)!clear;
        }
        if (look)
            return k;
    }
    return to;
}

/* Take step k in all lanes and judge it: the residual, infinite where l is outside of its box, or y far from what it must be. */
IN_LINE void look_at_step(model_lanes *g, const model_cells *b, long k)
{
    set_inputs(g, b, k);
    const lane *x = (const lane *)g->x[k & 1];
    lane *next = g->x[~k & 1];
    LANE_LOOP
    for (int j = 0; j < MODEL_LANES; j++) {
@JUDGED@            g->inside[j] = @INSIDE@ ? 0.0 : INFINITY;
            g->residual[j] = g->inside[j] == 0 ? r : INFINITY;
    }
}

/* Where a residual is not clear, rounding enters its scale, as in newton.c. */
IN_LINE void look_at_rounding_of(model_lanes *g, long k, double h)
{
    const lane *x = (const lane *)g->x[k & 1];
    (void)h;
    LANE_LOOP
    for (int j = 0; j < MODEL_LANES; j++) {
@ERRORS@            const double refined = r <= EXPLAINED ? r + g->inside[j] : INFINITY;
            g->residual[j] = g->residual[j] <= EXPLAINED ? g->residual[j] : refined;
    }
}

/* The same for each kind of processor: sums, products and quotients alone, nothing contracted, so the bits are the same. */
typedef struct {
    long (*take_steps)(model_lanes *g, const model_cells *b, long k, long to);
    void (*look)(model_lanes *g, const model_cells *b, long k);
    void (*look_closer)(model_lanes *g, long k, double h);
} lane_code;

#define STEPS_FOR(NAME, TARGET) TARGET static long take_steps_##NAME(model_lanes *g, const model_cells *b, long k, long to) \
    { return take_steps(g, b, k, to); }
#define LOOKS_FOR(NAME, TARGET) \
    TARGET static void look_##NAME(model_lanes *g, const model_cells *b, long k) { look_at_step(g, b, k); } \
    TARGET static void look_closer_##NAME(model_lanes *g, long k, double h) { look_at_rounding_of(g, k, h); }

STEPS_FOR(any, )
LOOKS_FOR(any, )
#if defined __x86_64__ && defined __GNUC__
STEPS_FOR(avx, __attribute__((target("avx2"))))
LOOKS_FOR(avx, __attribute__((target("avx2"))))
STEPS_FOR(wide, __attribute__((target("avx512f,avx512dq"))))
#endif

static lane_code code_for(int level)
{
    lane_code code = {take_steps_any, look_any, look_closer_any};
#if defined __x86_64__ && defined __GNUC__
    if (level != 0 && __builtin_cpu_supports("avx2")) {
        const lane_code avx = {take_steps_avx, look_avx, look_closer_avx};
        code = avx;
    }
    if ((level < 0 || level > 1) && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq"))
        code.take_steps = take_steps_wide;
#else
    (void)level;
#endif
    return code;
}

/* ------------------------------------------------------------------ the map of an index set */

/* Lane j has no map: nothing is clear there. */
static void forget_map(model_lanes *g, int j)
{
    g->mapped[j] = 0;
    for (int i = 0; i < MODEL_M*COLUMNS; i++)
        g->of_l[i][j] = NAN;
}

/* D, as if E were g's rows alone: column c of -E_z^{-1} E. */
static void solve_E(const model_solver *s, const double *E, int c, double *v)
{
    for (int i = 0; i < MODEL_N; i++)
        v[i] = -E[COLUMNS*i + c];
#if !IDENTITY
    lu_solve(MODEL_N, s->newton.lu, s->newton.pivot, v);
#else
    (void)s;
#endif
}

#if EXACT_ROWS
static const int bare[BARE + 1] = {@BARE_COLUMNS@};

static int is_bare(int column)
{
    for (int i = 0; i < BARE; i++)
        if (bare[i] == column)
            return 1;
    return 0;
}

/* What rows give exactly is exact, as in make_exact. */
static void make_map_exact(model_lanes *g, int j, const double *guess, const double *E, const double *Y_0, double (*D)[COLUMNS])
{
    const model_solver *s = &g->solver[j];
    signed char exact[MODEL_N] = {0};
#if UNIT_ROWS
    double shift[MODEL_N][COLUMNS]; /* of z_j from where nothing moves */
    for (int i = 0; i < MODEL_UNIT; i++)
        if (s->index[unit_row[i]] == 0) {
            const int column = unit_column[i];
            for (int c = 0; c < COLUMNS; c++) {
                const double whole = -Y_0[COLUMNS*unit_row[i] + c]/unit_factor[i] + 0.0;
                shift[column][c] = whole - guess[COLUMNS*column + c];
                D[column][c] = is_bare(column) ? whole : shift[column][c];
            }
            exact[column] = 1;
        }
#if FOLLOW_ROWS
    for (int i = 0; i < MODEL_FOLLOW; i++) {
        const int row = follow_row[i];
        int known = 1;
        for (int k = follow_start[i]; k < follow_start[i + 1]; k++)
            known &= exact[follow_column[k]];
        for (int c = 0; known && c < COLUMNS; c++) {
            double moved = E[COLUMNS*row + c];
            for (int k = follow_start[i]; k < follow_start[i + 1]; k++)
                moved += s->newton.E_z[MODEL_N*row + follow_column[k]]*shift[follow_column[k]][c];
            D[row][c] = -moved/s->newton.E_z[MODEL_N*row + row] + 0.0;
        }
    }
#else
    (void)shift;
#endif
#else
    (void)guess;
    (void)Y_0;
#endif
    (void)E;
#if REST_ROWS
    int moving = 0;
    for (int i = 0; i < MODEL_REST; i++)
        moving |= s->index[rest_row[i]] != 0;
    for (int i = 0; i < MODEL_N && !moving; i++) {
        for (int c = 0; c < COLUMNS; c++)
            D[i][c] = is_bare(i) ? 0 : 0 - guess[COLUMNS*i + c];
        exact[i] = 1;
    }
#endif
    for (int i = 0; i < BARE; i++)
        g->keep[i][j] = !exact[bare[i]];
}

#endif
/* The map of lane j on the index set of its solver. */
static void form_map(model_lanes *g, int j)
{
    model_solver *s = &g->solver[j];
    double guess[MODEL_N*COLUMNS], E[MODEL_N*COLUMNS], Y[MODEL_M*COLUMNS], Y_0[MODEL_M*COLUMNS];
    double D[MODEL_N][COLUMNS], W[MODEL_M*MODEL_M], v[MODEL_N], l[MODEL_M], r[MODEL_M];
    int free[MODEL_M], n = 0, pivot[MODEL_M];
    forget_map(g, j);
    if (s->newton.prepared == UNKNOWN && !read_matrices(s))
        return;
    if (!eliminate(s))
        return;
    lane_parts(s, guess, E, Y, Y_0);
    for (int i = 0; i < MODEL_M; i++) {
        const int code = s->index[i];
        const double root = sqrt(largest(MODEL_M, s->newton.W + MODEL_M*i));
        g->per[i][j] = root > 0 ? 1/root : 0;
        g->reach[i][j] = GROWTH*root;
        g->above[i][j] = code >= 0;
        g->below[i][j] = code <= 0;
        g->most[i][j] = code < 0 ? INFINITY : 0;
        g->least[i][j] = code > 0 ? -INFINITY : 0;
        if (code == 0)
            free[n++] = i;
    }
    for (int i = 0; i < n; i++)
        for (int k = 0; k < n; k++)
            W[n*i + k] = s->newton.W[MODEL_M*free[i] + free[k]];
    if (lu_factor(n, W, pivot))
        return;
    for (int c = 0; c < COLUMNS; c++) {
        const int last = c == COLUMNS - 1;
        solve_E(s, E, c, v);
        for (int i = 0; i < MODEL_M; i++)
            l[i] = last && s->index[i] ? (s->index[i] < 0 ? LOWER[i] : UPPER[i]) : 0;
        for (int i = 0; i < MODEL_M; i++)
            g->of_b[COLUMNS*i + c][j] = Y[COLUMNS*i + c] + Y_z_times(s, i, v);
        for (int i = 0; i < n; i++)
            r[i] = -(g->of_b[COLUMNS*free[i] + c][j] + dot(MODEL_M, s->newton.W + MODEL_M*free[i], l));
        lu_solve(n, W, pivot, r);
        for (int i = 0; i < n; i++)
            l[free[i]] = r[i];
        for (int i = 0; i < MODEL_M; i++)
            g->of_l[COLUMNS*i + c][j] = l[i];
        for (int i = 0; i < MODEL_N; i++)
            D[i][c] = v[i];
        S_times(s, l, v);
        for (int i = 0; i < MODEL_N; i++)
            D[i][c] -= v[i];
    }
#if EXACT_ROWS
    make_map_exact(g, j, guess, E, Y_0, D);
#endif
    for (int i = 0; i < MODEL_N; i++)
        for (int c = 0; c < COLUMNS; c++)
            g->of_z[COLUMNS*i + c][j] = D[i][c];
    g->mapped[j] = 1;
}

/* ------------------------------------------------------------------ lanes one by one */

/* Lane j ends with a status at step k. */
static void end_lane(model_lanes *g, int j, int status, long k)
{
    g->on[j] = 0;
    g->status[j] = status;
    g->failed[j] = k;
}

/* Put the run of a cell into lane j. */
static void fill_lane(model_lanes *g, model_cells *b, int j, long cell)
{
    model_solver *s = &g->solver[j];
    double numbers[@MAP_NUMBERS@];
    g->cell[j] = b->cell = cell;
    g->worst[0][j] = g->worst[1][j] = g->iterations[j] = g->alone[j] = 0;
    const int status = begin_cell(s, b);
    g->on[j] = -1;
    g->status[j] = MODEL_OK;
    lane_numbers(s, numbers);
    for (int i = 0; i < @MAP_NUMBERS@; i++)
        g->numbers[i][j] = numbers[i];
    for (int i = 0; i < MODEL_NP; i++)
        g->p[i][j] = s->p[i];
    for (int i = 0; i < MODEL_NSTATE; i++)
        g->x[b->step & 1][i][j] = s->x[i];
    for (int i = 0; i < MODEL_M; i++) {
        g->lower[i][j] = LOWER[i];
        g->upper[i][j] = UPPER[i];
    }
    forget_map(g, j);
    if (status != MODEL_OK)
        end_lane(g, j, status, b->step);
}

/* Put the cells that come next into lanes. */
static void fill_lanes(model_lanes *g, model_cells *b)
{
    int count = 0;
    long first = b->cell, cell = b->cell;
    memset(g, 0, sizeof *g);
    for (; cell < b->cells && count < MODEL_LANES; cell++)
        if (b->status[cell] == TO_DO) {
            first = count ? first : cell;
            fill_lane(g, b, count++, cell);
        }
    b->cell = count ? first : cell;
    g->count = count;
}

/* The solver of lane j before step k. */
static int make_lanes_ready(model_lanes *g, model_cells *b, int j, long k)
{
    model_solver *s = &g->solver[j];
    for (int i = 0; i < MODEL_NSTATE; i++)
        s->x[i] = g->x[k & 1][i][j];
    s->t_0 = 0;
    s->steps = k;
    return make_ready(s, b, k);
}

/* Take step k of lane j by attempt(), from what its map says. */
static void step_alone(model_lanes *g, model_cells *b, int j, long k, int kept)
{
    model_solver *s = &g->solver[j];
    if (g->mapped[j])
        for (int i = 0; i < MODEL_M; i++)
            if (is_finite(g->l[i][j]))
                s->l[i] = min_of(max_of(g->l[i][j], LOWER[i]), UPPER[i]);
    int status = make_lanes_ready(g, b, j, k);
    if (status == MODEL_OK)
        status = attempt(s);
    if (status != MODEL_OK) {
        end_lane(g, j, status, k);
        return;
    }
    const int changed = memcmp(s->index, s->work.code, MODEL_M) != 0;
    if (kept)
        keep_row(s, b, g->cell[j]);
    g->worst[~k & 1][j] = larger(s->work.residual, g->worst[k & 1][j]);
    b->changes[g->cell[j]] += changed && k > START_STEPS;
    g->iterations[j] += s->work.iterations;
    g->alone[j] += 1;
    commit(s);
    for (int i = 0; i < MODEL_NSTATE; i++)
        g->x[~k & 1][i][j] = s->x[i];
    if (changed || k == START_STEPS)
        form_map(g, j);
}

/* Accept step k of lane j as its map gave it. */
static void accept_lane(model_lanes *g, model_cells *b, int j, long k, int kept)
{
    model_solver *s = &g->solver[j];
    g->worst[~k & 1][j] = larger(g->residual[j], g->worst[k & 1][j]);
    if (!kept)
        return;
    make_lanes_ready(g, b, j, k);
    s->t = s->t_0 + s->steps*s->h;
    for (int i = 0; i < MODEL_N; i++)
        s->work.z[i] = g->z[i][j];
    for (int i = 0; i < MODEL_M; i++) {
        s->work.l[i] = g->l[i][j];
        s->work.code[i] = s->index[i];
        s->work.y[i] = s->index[i] == 0 ? 0 : g->y[i][j];
    }
    for (int i = 0; i < MODEL_NSTATE; i++)
        s->work.x_next[i] = g->x[~k & 1][i][j];
    s->work.residual = g->residual[j];
    s->work.iterations = 1;
    keep_row(s, b, g->cell[j]);
}

/* Take step k in all lanes, each looked at. */
static void look_at_lanes(model_lanes *g, model_cells *b, const lane_code *code, long k)
{
    const long number = k + 1;
    const int kept = number == b->next || number == b->steps, own = k == b->steps - 1 && b->last != MODEL_STEP;
    int unclear = 0;
    code->look(g, b, k);
    for (int j = 0; j < MODEL_LANES; j++)
        unclear |= g->on[j] && g->residual[j] > EXPLAINED && g->inside[j] == 0;
    if (unclear)
        code->look_closer(g, k, MODEL_STEP);
    for (int j = 0; j < MODEL_LANES; j++) {
        if (!g->on[j])
            continue;
        if (g->residual[j] <= EXPLAINED && !own)
            accept_lane(g, b, j, k, kept);
        else
            step_alone(g, b, j, k, kept);
    }
    if (kept) {
        b->row += 1;
        b->next += b->every;
    }
}

static int any_on(const model_lanes *g)
{
    for (int j = 0; j < MODEL_LANES; j++)
        if (g->on[j])
            return 1;
    return 0;
}

/* Write down what came of the cells in the lanes. */
static void empty_lanes(const model_lanes *g, model_cells *b)
{
    for (int j = 0; j < g->count; j++) {
        const long cell = g->cell[j], end = g->status[j] == MODEL_OK ? b->steps : g->failed[j];
        b->status[cell] = (signed char)g->status[j];
        b->taken[cell] = end > START_STEPS ? (double)(end - START_STEPS) : 0;
        b->worst[cell] = larger(g->worst[0][j], g->worst[1][j]); /* it only grows */
        b->newton[cell] = b->taken[cell] - g->alone[j] + g->iterations[j];
        if (g->status[j] != MODEL_OK)
            b->failed_at[cell] = g->solver[j].t;
        b->cell = cell + 1;
    }
    b->step = -1;
}

/* Go on with the cells in the lanes; 0 where the time is over. */
static int run_group(model_lanes *g, model_cells *b, const lane_code *code, clock_t begin, double seconds)
{
    while (b->step < b->steps && any_on(g)) {
        const long next = b->next < b->steps ? b->next : b->steps;
        long to = next - 1 < b->step + LOOK_AFTER ? next - 1 : b->step + LOOK_AFTER;
        const long k = code->take_steps(g, b, b->step, to);
        const int clear = k == to && to < next - 1;
        b->step = k;
        if (!clear) {
            look_at_lanes(g, b, code, k);
            b->step += 1;
        }
        if ((clear || ++g->looks % LANES_PER_LOOK == 0) && is_over(begin, seconds))
            return 0;
    }
    return 1;
}

int model_run_lanes(model_lanes *g, model_cells *b, double seconds, int level)
{
    const clock_t begin = clock();
    const lane_code code = code_for(level);
    while (b->cell < b->cells) {
        if (b->step < 0)
            fill_lanes(g, b);
        if (g->count == 0)
            break;
        if (!run_group(g, b, &code, begin, seconds))
            return 0;
        empty_lanes(g, b);
        if (is_over(begin, seconds))
            return b->cell >= b->cells;
    }
    return 1;
}

long model_lanes_size(void) { return (long)sizeof(model_lanes); }
