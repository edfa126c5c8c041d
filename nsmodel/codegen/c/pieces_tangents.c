/*
 * Derivatives along pieces and through switches: S = dx/dp, column by column (derivatives/piece_tangents.py, run_tangents.py). A piece
 * is cut into parts on which steps of two orders agree: of Radau IIA, or by the exponential of a matrix that is the same all along.
 *
 * What these do not go on with has a status: a jump of the state, a switch that is only touched, several at once whose order matters,
 * multipliers that are not unique. Known times do not move here.
 */

#define BY @TANGENTS@ /* columns of S */
#define DEEPEST 45 /* times that a piece is halved, at most */
#if AFFINE_FLOW
#define TANGENT_LEFT 1e-3 /* of S: of which S + growth S would have lost three digits */
#define PHI_TERMS 16 /* of the last phi(Z), |Z| <= 1: the next one is rounding */
#else
#define TANGENT_UNKNOWNS (MOST_TANGENT_STAGES*N)
#define TANGENT_WIDTH ((TANGENT_UNKNOWNS + BY + 3)/4*4) /* of a row of the equations of a step, right sides behind */
#endif
#define TANGENT_PARTS (200000L/N) /* halvings in a run, at most */
#define TANGENT_LOOSEST 1e-9 /* the most of TANGENT_SHARE rtol: up to here few stages do, and what they err by is far below it */
#define TANGENT_OFF 1e-9 /* of its terms: rows of S that are nearer to 0 lie on the surface */

/* Which equations give the multipliers of the rows with code 0: mix (n, n) times y of these, from the row `rank` on times its rate. */
typedef struct {
    int n, rank, active[M + 1];
    double mix[M*M + 1], free[M*M + 1]; /* free: multipliers by which y does not move, from the column `rank` on */
} model_mode_rows;

/* Where a piece is linearised: F = f + g, y and its rate by x, l and p, row by row; L = by_state S + own of the active rows. */
typedef struct {
    double t, x[N], l[M + 1];
    double F_x[N*N], F_l[N*M + 1], F_p[N*BY], y_x[M*N + 1], y_l[M*M + 1], y_p[M*BY + 1], rate_x[M*N + 1], rate_l[M*M + 1], rate_p[M*BY + 1];
    double by_state[M*N + 1], own[M*BY + 1];
} model_linearised;

typedef struct {
#if AFFINE_FLOW
    double flow[N*N], pace, push[N*M + 1]; /* S' = flow S + F_p + push r on the last piece, r: right sides of its rows; |flow| in units of x */
    double h, whole[N*N], growth[N*N], phi[MOST_TANGENT_STAGES*N*N], psi[MOST_TANGENT_STAGES*N*N]; /* of parts of length h */
#endif
    double S[N*BY], size[N]; /* at the time reached; of the states */
    double lower_p[M*BY + 1], upper_p[M*BY + 1]; /* ends of the law */
    double piece[MODEL_PIECES_RECORD], sides[CHOICES + 1]; /* the piece before, and the sides of its switches */
    model_mode_rows rows; /* of that */
    model_linearised at, then;
    long parts;
    int begun;
#if AFFINE_FLOW
#else
    double system[TANGENT_UNKNOWNS*TANGENT_WIDTH];
#endif
} model_tangents;

/* A X = B by elimination, X (n, k) in place of B; whether A is regular, beside the largest entry of each of its rows. */
static int eliminate(int n, double *restrict A, int k, double *restrict B)
{
    for (int i = 0; i < n; i++) {
        double size = 0;
        for (int j = 0; j < n; j++)
            size = worse_of(fabs(A[i*n + j]), size);
        if (!(size > 0 && is_finite(size)))
            return 0;
        const double share = 1/size;
        for (int j = 0; j < n; j++)
            A[i*n + j] *= share;
        for (int j = 0; j < k; j++)
            B[i*k + j] *= share;
    }
    for (int c = 0; c < n; c++) {
        int p = c;
        for (int i = c + 1; i < n; i++)
            if (fabs(A[i*n + c]) > fabs(A[p*n + c]))
                p = i;
        if (!(fabs(A[p*n + c]) > SINGULAR))
            return 0;
        if (p != c) {
            for (int j = c; j < n; j++)
                exchange(&A[c*n + j], &A[p*n + j]);
            for (int j = 0; j < k; j++)
                exchange(&B[c*k + j], &B[p*k + j]);
        }
        const double pivot = 1/A[c*n + c];
        const double *restrict from = A + c*n, *restrict right = B + c*k;
        for (int i = c + 1; i < n; i++) {
            double *restrict row = A + i*n, *restrict own = B + i*k;
            const double factor = row[c]*pivot;
            if (factor == 0)
                continue;
            for (int j = c + 1; j < n; j++)
                row[j] -= factor*from[j];
            for (int j = 0; j < k; j++)
                own[j] -= factor*right[j];
        }
    }
    for (int i = n - 1; i >= 0; i--)
        for (int j = 0; j < k; j++) {
            double sum = B[i*k + j];
            for (int c = i + 1; c < n; c++)
                sum -= A[i*n + c]*B[c*k + j];
            B[i*k + j] = sum/A[i*n + i];
        }
    return 1;
}

/* out (n, k) += factor A B, A (n, m). */
static inline void add_product(int n, int m, int k, double factor, const double *A, const double *B, double *restrict out)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++)
            if (A[i*m + j] != 0)
                for (int c = 0; c < k; c++)
                    out[i*k + c] += factor*A[i*m + j]*B[j*k + c];
}

/* The slopes of a piece at a point of its unit. */
static void slopes_of_piece(const model_pieces *s, const double *piece, const double *sides, double where, model_linearised *at)
{
    double value[ROWS];
    values_at(piece + AT_C, ROWS, s->order, where, N + M, value);
    at->t = piece[AT_T] + piece[AT_TAU]*where;
    memcpy(at->x, value, sizeof at->x);
    memcpy(at->l, value + L, M*sizeof *value);
    linearised_on_sides(s, &at->t, at->x, at->l, sides, at->F_x, at->F_l, at->F_p, at->y_x, at->y_l, at->y_p, at->rate_x, at->rate_l, at->rate_p);
}

#if LAW
/* The rows of the mode of a piece, by what y moves by l in its middle. */
static void read_rows(const double *piece, const model_linearised *middle, model_mode_rows *rows)
{
    rows->n = 0;
    for (int i = 0; i < M; i++)
        if (piece[AT_CODES + i] == 0)
            rows->active[rows->n++] = i;
    const int n = rows->n;
    for (int i = 0; i < n*n; i++)
        rows->mix[i] = rows->free[i] = i % (n + 1) == 0;
    rows->rank = 0;
#if MATRICES
    double D[M*M], plus[M*M], left[M*M], right[M*M];
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            D[i*n + j] = middle->y_l[rows->active[i]*M + rows->active[j]];
    if (n)
        rows->rank = generalised_inverse(n, D, plus, left, right);
    if (0 < rows->rank && rows->rank < n)
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                rows->mix[j*n + i] = left[i*n + j];
                rows->free[i*n + j] = right[i*n + j];
            }
#else
    UNUSED(middle);
#endif
}

/* The slopes by p of the end at which a row of the law is. */
static const double *end_slopes(const model_tangents *d, const double *piece, int row)
{
    return (piece[AT_CODES + row] < 0 ? d->lower_p : d->upper_p) + row*BY;
}

/* The equations of the active rows: A (n, n) by their multipliers, the right sides by x, row by row. */
static void fill_mode_equations(const model_mode_rows *rows, const model_linearised *at, double *A, double *by_state)
{
    const int n = rows->n, *a = rows->active;
    memset(A, 0, n*n*sizeof *A);
    memset(by_state, 0, n*N*sizeof *by_state);
    for (int r = 0; r < n; r++) {
        const double *by_x = r < rows->rank ? at->y_x : at->rate_x, *by_l = r < rows->rank ? at->y_l : at->rate_l;
        for (int i = 0; i < n; i++) {
            const double share = rows->mix[r*n + i];
            if (share == 0)
                continue;
            for (int j = 0; j < n; j++)
                A[r*n + j] += share*by_l[a[i]*M + a[j]];
            for (int j = 0; j < N; j++)
                by_state[r*N + j] -= share*by_x[a[i]*N + j];
        }
    }
}

/* The right sides of these by p, and own of the rows that are at an end. */
static void fill_own_sides(const model_tangents *d, const double *piece, const model_mode_rows *rows, model_linearised *at, double *right)
{
    const int n = rows->n, *a = rows->active;
    memset(at->own, 0, sizeof at->own);
    memset(right, 0, n*BY*sizeof *right);
    for (int i = 0; i < M; i++)
        if (piece[AT_CODES + i] != 0)
            memcpy(at->own + i*BY, end_slopes(d, piece, i), BY*sizeof *at->own);
    for (int r = 0; r < n; r++) {
        const double *by_l = r < rows->rank ? at->y_l : at->rate_l, *by_p = r < rows->rank ? at->y_p : at->rate_p;
        for (int i = 0; i < n; i++) {
            const double share = rows->mix[r*n + i];
            if (share == 0)
                continue;
            for (int j = 0; j < BY; j++)
                right[r*BY + j] -= share*by_p[a[i]*BY + j];
            for (int j = 0; j < M; j++)
                if (piece[AT_CODES + j] != 0 && by_l[a[i]*M + j] != 0)
                    for (int c = 0; c < BY; c++)
                        right[r*BY + c] -= share*by_l[a[i]*M + j]*at->own[j*BY + c];
        }
    }
}

/* L = by_state S + own of all rows; whether it is unique. */
static int solve_multipliers(const model_tangents *d, const double *piece, const model_mode_rows *rows, model_linearised *at)
{
    const int n = rows->n, k = N + BY;
    double A[M*M], by_state[M*N], own[M*BY], right[M*(N + BY)];
    fill_mode_equations(rows, at, A, by_state);
    fill_own_sides(d, piece, rows, at, own);
    memset(at->by_state, 0, sizeof at->by_state);
    for (int r = 0; r < n; r++) {
        memcpy(right + r*k, by_state + r*N, N*sizeof *right);
        memcpy(right + r*k + N, own + r*BY, BY*sizeof *right);
    }
    if (!eliminate(n, A, k, right))
        return 0;
    for (int r = 0; r < n; r++) {
        memcpy(at->by_state + rows->active[r]*N, right + r*k, N*sizeof *right);
        memcpy(at->own + rows->active[r]*BY, right + r*k + N, BY*sizeof *right);
    }
    return 1;
}
#endif

/* A piece at a point: its slopes, and L there; whether that is unique. */
static int linearise(const model_pieces *s, const model_tangents *d, const double *piece, const double *sides, const model_mode_rows *rows, double where, model_linearised *at)
{
    slopes_of_piece(s, piece, sides, where, at);
#if LAW
    return solve_multipliers(d, piece, rows, at);
#else
    UNUSED(d);
    UNUSED(rows);
    return 1;
#endif
}

/* What steps of two orders may differ by. */
static double allowed_difference(const model_pieces *s) { return max_of(min_of(TANGENT_SHARE*s->rtol/LOCAL, TANGENT_LOOSEST), TANGENT_ROUNDING); }

/* The stages of the one of them that is kept. */
static int highest_stages(const model_pieces *s) { return allowed_difference(s) < TANGENT_LOOSEST ? MOST_TANGENT_STAGES : FEWEST_TANGENT_STAGES + 1; }

#if AFFINE_FLOW
/* flow (N, N) of the last piece and how its rows push x, from its slopes at a point: they are the same all along. Whether L is unique. */
static int take_flow(model_tangents *d, const model_linearised *at)
{
    memcpy(d->flow, at->F_x, sizeof d->flow);
    d->h = 0;
#if LAW
    const int n = d->rows.n;
    double A[M*M], by_state[M*N], inverse[M*M];
    add_product(N, M, N, 1, at->F_l, at->by_state, d->flow);
    fill_mode_equations(&d->rows, at, A, by_state);
    for (int i = 0; i < n*n; i++)
        inverse[i] = i % (n + 1) == 0;
    if (!eliminate(n, A, n, inverse))
        return 0;
    memset(d->push, 0, sizeof d->push);
    for (int i = 0; i < N; i++)
        for (int r = 0; r < n; r++)
            for (int j = 0; j < n; j++)
                d->push[i*n + j] += at->F_l[i*M + d->rows.active[r]]*inverse[r*n + j];
#endif
    d->pace = 0;
    for (int a = 0; a < N; a++) {
        double sum = 0;
        for (int b = 0; b < N; b++)
            sum += fabs(d->flow[a*N + b])*d->size[b]/d->size[a];
        d->pace = worse_of(sum, d->pace);
    }
    return is_finite(d->pace);
}

/* out (N, N) = one two + factor of the unit matrix. */
static void multiply_square(const double *one, const double *two, double factor, double *restrict out)
{
    for (int i = 0; i < N*N; i++)
        out[i] = i % (N + 1) == 0 ? factor : 0;
    add_product(N, N, N, 1, one, two, out);
}

/*
 * whole = exp(h A), growth = exp(h A) - 1, and psi_k = the integral of exp((1 - c) h A) P_k(c) over c from 0 to 1, P_k Legendre's polynomials there, by
 * phi_k = the integral of exp((1 - c) h A) c^(k - 1)/(k - 1)!: a sum of powers where |h A| <= 1, else doubled (Skaflestad and Wright, The
 * scaling and modified squaring method for matrix functions related to the exponential, 2009). exp - 1 keeps the digits of slow motions,
 * exp those of what has died away.
 */
static void take_exponentials(model_tangents *d, int K, double h)
{
    enum { SIZE = N*N };
    double Z[SIZE], next[SIZE], inverse[MOST_TANGENT_STAGES + 1] = {1}, halves[MOST_TANGENT_STAGES + 1] = {1}, last = 1, part = h;
    int doublings = 0;
    if (h == d->h)
        return;
    d->h = h;
    for (; part*d->pace > 1; part /= 2)
        doublings++;
    for (int i = 0; i < SIZE; i++)
        Z[i] = part*d->flow[i];
    for (int k = 1; k <= K; k++) {
        inverse[k] = inverse[k - 1]/k;
        halves[k] = halves[k - 1]/2;
    }
    double terms[PHI_TERMS];
    for (int k = 0; k < PHI_TERMS; k++)
        last = terms[k] = k ? last/(K + k) : inverse[K];
    double *top = d->phi + (K - 1)*SIZE;
    memset(top, 0, sizeof next);
    for (int k = PHI_TERMS - 1; k >= 0; k--) {
        multiply_square(Z, top, terms[k], next);
        memcpy(top, next, sizeof next);
    }
    for (int k = K - 1; k >= 1; k--)
        multiply_square(Z, d->phi + k*SIZE, inverse[k], d->phi + (k - 1)*SIZE);
    multiply_square(Z, d->phi, 0, d->growth);
    multiply_square(Z, d->phi, 1, d->whole);
    for (; doublings > 0; doublings--) {
        for (int k = K; k >= 1; k--) {
            double *own = d->phi + (k - 1)*SIZE;
            multiply_square(d->growth, own, 0, next);
            for (int i = 0; i < SIZE; i++)
                next[i] += own[i];
            for (int j = 1; j <= k; j++)
                for (int i = 0; i < SIZE; i++)
                    next[i] += inverse[k - j]*d->phi[(j - 1)*SIZE + i];
            for (int i = 0; i < SIZE; i++)
                own[i] = next[i]*halves[k];
        }
        multiply_square(d->whole, d->whole, 0, next);
        memcpy(d->whole, next, sizeof next);
        multiply_square(d->growth, d->growth, 0, next);
        for (int i = 0; i < SIZE; i++)
            d->growth[i] = 2*d->growth[i] + next[i];
    }
    memset(d->psi, 0, sizeof d->psi);
    for (int k = 0; k < K; k++)
        for (int j = 0; j <= k; j++)
            for (int i = 0; i < SIZE; i++)
                d->psi[k*SIZE + i] += legendre[k*MOST_TANGENT_STAGES + j]*d->phi[j*SIZE + i];
}

/* What S' has beside flow S at a point of the last piece. */
static void forcing_at(const model_pieces *s, model_tangents *d, double where, double *rate)
{
    const double *piece = s->piece;
    double value[ROWS];
    values_at(piece + AT_C, ROWS, s->order, where, N + M, value);
    const double t = piece[AT_T] + piece[AT_TAU]*where;
    forcing_on_sides(s, &t, value, value + L, s->sides, rate, d->at.y_p, d->at.rate_p);
#if LAW
    double right[M*BY];
    fill_own_sides(d, piece, &d->rows, &d->at, right);
    add_product(N, M, BY, 1, d->at.F_l, d->at.own, rate);
    add_product(N, d->rows.n, BY, 1, d->push, right, rate);
#endif
}

/* exp(h A) S, column by column as S + growth S or, where next to nothing is left of it, as whole S. */
static void take_along(const model_tangents *d, double *restrict next)
{
    double product[N*BY] = {0};
    memcpy(next, d->S, N*BY*sizeof *next);
    add_product(N, N, BY, 1, d->growth, d->S, next);
    add_product(N, N, BY, 1, d->whole, d->S, product);
    for (int c = 0; c < BY; c++) {
        double size = 0, left = 0;
        for (int a = 0; a < N; a++) {
            size = max_of(fabs(d->S[a*BY + c])/d->size[a], size);
            left = worse_of(fabs(next[a*BY + c])/d->size[a], left);
        }
        for (int a = 0; a < N && left < TANGENT_LEFT*size; a++)
            next[a*BY + c] = product[a*BY + c];
    }
}

/* S over a part of the last piece: exp(h A) S and the integral of exp((1 - c) h A) h b, b by its values at the nodes of Radau IIA. */
static int step_over(const model_pieces *s, model_tangents *d, int stages, double begin, double end, double *next)
{
    const double h = (end - begin)*s->piece[AT_TAU];
    const double *nodes = tangent_tables[stages - FEWEST_TANGENT_STAGES], *parts = nodes + stages;
    double rate[N*BY], b[MOST_TANGENT_STAGES*N*BY] = {0};
    take_exponentials(d, highest_stages(s), h);
    for (int j = 0; j < stages; j++) {
        forcing_at(s, d, begin + (end - begin)*nodes[j], rate);
        for (int k = 0; k < stages; k++)
            for (int i = 0; i < N*BY; i++)
                b[k*N*BY + i] += parts[k*stages + j]*rate[i];
    }
    take_along(d, next);
    for (int k = 0; k < stages; k++)
        add_product(N, N, BY, h, d->psi + k*N*N, b + k*N*BY, next);
    return all_finite(N*BY, next);
}
#else
#if defined(__GNUC__) && !defined(__clang__)
#define IN_VECTORS __attribute__((optimize("tree-vectorize"))) /* its loops are long */
#else
#define IN_VECTORS
#endif

/* n equations of a step, solved in place of their right sides; whether they are regular. */
IN_VECTORS static int solve_step(int n, double *restrict system)
{
    const int width = (n + BY + 3)/4*4;
    for (int c = 0; c < n; c++) {
        const int first = c/4*4; /* what lies before c is not read again */
        int p = c;
        for (int i = c + 1; i < n; i++)
            if (fabs(system[i*width + c]) > fabs(system[p*width + c]))
                p = i;
        if (!(fabs(system[p*width + c]) > 0 && is_finite(system[p*width + c])))
            return 0;
        double *restrict from = system + c*width;
        if (p != c)
            for (int j = first; j < width; j++)
                exchange(&from[j], &system[p*width + j]);
        const double pivot = 1/from[c];
        for (int i = c + 1; i < n; i++) {
            double *restrict row = system + i*width;
            const double factor = row[c]*pivot;
            if (factor != 0)
                for (int j = first; j < width; j++)
                    row[j] -= factor*from[j];
        }
    }
    for (int i = n - 1; i >= 0; i--) {
        double *restrict right = system + i*width + n;
        for (int j = i + 1; j < n; j++)
            for (int k = 0; k < BY; k++)
                right[k] -= system[i*width + j]*system[j*width + n + k];
        for (int k = 0; k < BY; k++)
            right[k] /= system[i*width + i];
    }
    return 1;
}

/* S over a part of the last piece by one step of Radau IIA; whether that is possible. */
static int step_over(const model_pieces *s, model_tangents *d, int stages, double begin, double end, double *next)
{
    const double h = (end - begin)*s->piece[AT_TAU];
    const double *nodes = tangent_tables[stages - FEWEST_TANGENT_STAGES], *inverse = nodes + stages;
    const int unknowns = stages*N, width = (unknowns + BY + 3)/4*4;
    double rate[N*BY], flow[N*N];
    memset(d->system, 0, (size_t)unknowns*width*sizeof *d->system);
    for (int i = 0; i < stages; i++)
        for (int j = 0; j < stages; j++)
            for (int a = 0; a < N; a++)
                d->system[(i*N + a)*width + j*N + a] = inverse[i*stages + j];
    for (int j = 0; j < stages; j++) {
        if (!linearise(s, d, s->piece, s->sides, &d->rows, begin + (end - begin)*nodes[j], &d->at))
            return 0;
        memcpy(flow, d->at.F_x, sizeof flow);
        memcpy(rate, d->at.F_p, sizeof rate);
#if LAW
        add_product(N, M, N, 1, d->at.F_l, d->at.by_state, flow);
        add_product(N, M, BY, 1, d->at.F_l, d->at.own, rate);
#endif
        add_product(N, N, BY, 1, flow, d->S, rate);
        for (int a = 0; a < N; a++) {
            double *row = d->system + (j*N + a)*width;
            const double share = h/d->size[a];
            for (int b = 0; b < N; b++)
                row[j*N + b] -= share*flow[a*N + b]*d->size[b];
            for (int c = 0; c < BY; c++)
                row[unknowns + c] = share*rate[a*BY + c];
        }
    }
    if (!solve_step(unknowns, d->system))
        return 0;
    const double *moved = d->system + (unknowns - N)*width + unknowns;
    for (int a = 0; a < N; a++)
        for (int c = 0; c < BY; c++)
            next[a*BY + c] = d->S[a*BY + c] + d->size[a]*moved[a*width + c];
    return all_finite(N*BY, next);
}

#endif

/* Whether two S differ by what is allowed of the largest entry of each column. */
static int are_near(const model_pieces *s, const model_tangents *d, const double *one, const double *two)
{
    for (int c = 0; c < BY; c++) {
        double off = 0, size = 0;
        for (int a = 0; a < N; a++) {
            off = worse_of(fabs(one[a*BY + c] - two[a*BY + c])/d->size[a], off);
            size = max_of(max_of(fabs(d->S[a*BY + c]), fabs(two[a*BY + c]))/d->size[a], size);
        }
        if (!(off <= allowed_difference(s)*size || off == 0))
            return 0;
    }
    return 1;
}

/* S over a part of the last piece by steps of two orders: the higher one, and whether they agree; -1: there is none. */
static int try_part(const model_pieces *s, model_tangents *d, double begin, double end, double *next)
{
    double low[N*BY];
    const int stages = highest_stages(s);
    const int found = step_over(s, d, stages - 1, begin, end, low) && step_over(s, d, stages, begin, end, next);
    return found ? are_near(s, d, low, next) : -1;
}

/* S from one point of the last piece to another: parts are halved until steps of two orders agree. */
static int follow(model_pieces *s, model_tangents *d, double begin, double until)
{
    double ends[DEEPEST], next[N*BY];
    int top = 0;
    ends[0] = until;
    while (top >= 0) {
        const double end = ends[top];
        const int found = try_part(s, d, begin, end, next);
        if (found < 0)
            return MODEL_NOT_SOLVED;
        if (found) {
            memcpy(d->S, next, sizeof next);
            begin = end;
            top--;
            continue;
        }
        if (++d->parts > TANGENT_PARTS || top + 1 == DEEPEST)
            return MODEL_NOT_SOLVED;
        ends[++top] = (begin + end)/2;
    }
    return MODEL_OK;
}

#if LAW
/* S with y = 0 in the rows that are held through their rate, moved as their multipliers push x; at: where the piece begins. */
static int project_tangents(model_tangents *d, const model_mode_rows *rows, const model_linearised *at)
{
    const int n = rows->n, held = n - rows->rank;
    const int *a = rows->active;
    double off[M*BY], W[M*M], push[N*M], largest[BY] = {0};
    int is_off = 0;
    for (int i = 0; i < N; i++)
        for (int c = 0; c < BY; c++)
            largest[c] = max_of(fabs(d->S[i*BY + c])/d->size[i], largest[c]);
    memset(W, 0, sizeof W);
    memset(push, 0, sizeof push);
    memset(off, 0, sizeof off);
    for (int r = 0; r < held; r++)
        for (int i = 0; i < n; i++) {
            const double share = rows->mix[(rows->rank + r)*n + i];
            const double *y_x = at->y_x + a[i]*N, *y_l = at->y_l + a[i]*M, *y_p = at->y_p + a[i]*BY;
            double size = 0;
            for (int j = 0; j < N; j++) {
                size += fabs(y_x[j])*d->size[j];
                for (int c = 0; c < BY; c++)
                    off[r*BY + c] += share*y_x[j]*d->S[j*BY + c];
            }
            for (int c = 0; c < BY; c++) {
                off[r*BY + c] += share*y_p[c];
                for (int j = 0; j < M; j++)
                    off[r*BY + c] += share*y_l[j]*at->own[j*BY + c]; /* of those with code 0 they cancel */
            }
            for (int v = 0; v < held; v++)
                for (int j = 0; j < n; j++)
                    W[r*held + v] += share*at->rate_l[a[i]*M + a[j]]*rows->free[j*n + rows->rank + v];
            for (int c = 0; c < BY; c++)
                is_off |= fabs(off[r*BY + c]) > TANGENT_OFF*(fabs(share)*size*largest[c] + fabs(share*y_p[c]));
        }
    if (!eliminate(held, W, BY, off)) /* rows that follow from others */
        return is_off ? MODEL_NOT_SOLVED : MODEL_OK;
    for (int i = 0; i < N; i++)
        for (int v = 0; v < held; v++)
            for (int j = 0; j < n; j++)
                push[i*held + v] += at->F_l[i*M + a[j]]*rows->free[j*n + rows->rank + v];
    add_product(N, held, BY, -1, push, off, d->S);
    return MODEL_OK;
}
#endif

/* What becomes 0 at a switch: by how much p moves it at a fixed time, its rate, how far it is from 0 in time. */
typedef struct {
    double moved[BY], rate, off;
} model_guard;

/* A quantity at the end of the piece before: value, rate, slopes by x, l and p (0: none). */
static model_guard guard_of(const model_tangents *d, double value, double rate, const double *by_x, const double *by_l, const double *by_p)
{
    model_guard made = {{0}, rate, fabs(value/rate)};
    for (int c = 0; c < BY; c++) {
        double sum = by_p ? by_p[c] : 0;
        for (int i = 0; by_x && i < N; i++)
            sum += by_x[i]*d->S[i*BY + c];
        for (int i = 0; by_l && i < M; i++)
            if (by_l[i] != 0) {
                double l = d->at.own[i*BY + c];
                for (int j = 0; j < N; j++)
                    l += d->at.by_state[i*N + j]*d->S[j*BY + c];
                sum += by_l[i]*l;
            }
        made.moved[c] = sum;
    }
    return made;
}

/* All that becomes 0 between the piece before and the last one, and moves; count. value, rate: of x, l, y at the end of that. */
static int guards_between(const model_pieces *s, const model_tangents *d, const double *value, const double *rate, const double *F, model_guard *found)
{
    int count = 0;
#if LAW
    for (int i = 0; i < M; i++) {
        const double code = d->piece[AT_CODES + i], then = s->piece[AT_CODES + i];
        if (code == then)
            continue;
        if (code != 0)
            found[count] = guard_of(d, value[Y + i], rate[Y + i], d->at.y_x + i*N, d->at.y_l + i*M, d->at.y_p + i*BY);
        else {
            double own[M] = {0}, end[BY];
            own[i] = 1;
            for (int c = 0; c < BY; c++)
                end[c] = -(then < 0 ? d->lower_p : d->upper_p)[i*BY + c];
            found[count] = guard_of(d, value[L + i] - (then < 0 ? lower[i] : upper[i]), rate[L + i], 0, own, end);
        }
        count += found[count].rate != 0;
    }
#endif
#if SWITCHED
    double looked[CHOICES], by_t[CHOICES], by_x[CHOICES*N], by_l[CHOICES*M + 1], by_p[CHOICES*BY];
    watched_on_sides(s, &d->at.t, d->at.x, d->at.l, d->sides, looked, by_t, by_x, by_l, by_p);
    for (int b = 0; b < CHOICES; b++) {
        if (d->sides[b] == s->sides[b])
            continue;
        double moves = by_t[b];
        for (int i = 0; i < N; i++)
            moves += by_x[b*N + i]*F[i];
        for (int i = 0; i < M; i++)
            moves += by_l[b*M + i]*rate[L + i];
        const double whole = branch_kind[b] == SIDE ? 0 : rint(looked[b]);
        found[count] = guard_of(d, looked[b] - whole, moves, by_x + b*N, by_l + b*M, by_p + b*BY);
        count += found[count].rate != 0;
    }
#else
    UNUSED(F);
#endif
    UNUSED(s);
    UNUSED(value);
    UNUSED(rate);
    return count;
}

/* Polynomials of x, l and y and their rates at a point of a piece. */
static void values_and_rates(const model_pieces *s, const double *piece, double where, double *value, double *rate)
{
    double c[MOST_ORDERS*ROWS];
    for (int k = 1; k <= s->order; k++)
        for (int j = 0; j < ROWS; j++)
            c[(k - 1)*ROWS + j] = k*piece[AT_C + k*ROWS + j]/piece[AT_TAU];
    values_at(piece + AT_C, ROWS, s->order, where, ROWS, value);
    values_at(c, ROWS, s->order - 1, where, ROWS, rate);
}

/* Whether the time of a guard moves otherwise than that of the first. */
static int moves_apart(const model_guard *first, const model_guard *other)
{
    double off = 0, size = 0;
    for (int c = 0; c < BY; c++) {
        const double one = first->moved[c]/first->rate, two = other->moved[c]/other->rate;
        off = worse_of(fabs(one - two), off);
        size = max_of(max_of(fabs(one), fabs(two)), size);
    }
    return !(off <= TANGENT_SAME*size);
}

/*
 * S past the switch between the piece before and the last one, by which an event begins: S + F- dt - F+ dt, where dt is how p moves the
 * time. rows: of the last piece.
 */
static int pass_switch(model_pieces *s, model_tangents *d, const model_mode_rows *rows)
{
    const double t = s->piece[AT_T], *was = d->piece;
    double value[ROWS], rate[ROWS], before[N], after[N];
    model_guard guards[M + CHOICES + 1];
#if IMPULSES
    for (int i = 0; i < M; i++)
        if (s->piece[AT_IMPULSE + i] != 0)
            return MODEL_NOT_SOLVED;
#endif
    if (next_known(s, t*(1 - 2*SAME_TIME)) <= t*(1 + SAME_TIME))
        return MODEL_OK;
    if (!linearise(s, d, was, d->sides, &d->rows, was[AT_S], &d->at))
        return MODEL_NOT_SOLVED;
    values_and_rates(s, was, was[AT_S], value, rate);
    rate_on_sides(s, &d->at.t, d->at.x, d->at.l, d->sides, before);
    const int count = guards_between(s, d, value, rate, before, guards);
    int first = -1;
    for (int i = 0; i < count; i++)
        if (first < 0 || guards[i].off < guards[first].off)
            first = i;
    if (first < 0)
        return MODEL_NOT_SOLVED;
    const double near = max_of(TANGENT_AT_ONCE*max_of(was[AT_TAU]*was[AT_S], fabs(t)), 2*guards[first].off);
    for (int i = 0; i < count; i++)
        if (guards[i].off <= near && moves_apart(&guards[first], &guards[i]))
            return MODEL_NOT_SOLVED;
    if (!linearise(s, d, s->piece, s->sides, rows, 0, &d->then))
        return MODEL_NOT_SOLVED;
    rate_on_sides(s, &d->then.t, d->then.x, d->then.l, s->sides, after);
    for (int i = 0; i < N; i++)
        for (int c = 0; c < BY; c++)
            d->S[i*BY + c] -= (before[i] - after[i])*(guards[first].moved[c]/guards[first].rate);
    return all_finite(N*BY, d->S) ? MODEL_OK : MODEL_NOT_SOLVED;
}

/* S and L at a point of the last piece, as a row of what is kept. */
static int write_tangents(const model_pieces *s, model_tangents *d, double where, double *out)
{
    memcpy(out, d->S, sizeof d->S);
#if LAW
    if (!linearise(s, d, s->piece, s->sides, &d->rows, where, &d->at))
        return MODEL_NOT_SOLVED;
    memcpy(out + N*BY, d->at.own, M*BY*sizeof *out);
    add_product(M, N, BY, 1, d->at.by_state, d->S, out + N*BY);
#else
    UNUSED(s);
    UNUSED(where);
#endif
    return MODEL_OK;
}

/* Begin with the start of a run. */
static void begin_tangents(const model_pieces *s, model_tangents *d)
{
#if AFFINE_FLOW
    memset(d, 0, sizeof *d);
#else
    memset(d, 0, offsetof(model_tangents, system)); /* it is filled before it is read */
#endif
    start_slopes(s, d->S, d->lower_p, d->upper_p);
}

/* S along the piece that was made last; rows of what is kept at those of the times that it has. */
static int follow_piece(model_pieces *s, model_tangents *d, long count, const double *times, double *out)
{
    const double *piece = s->piece, length = piece[AT_S], end = piece[AT_T] + piece[AT_TAU]*length;
    model_mode_rows rows;
    double at = 0;
    int status = MODEL_OK;
    for (int i = 0; i < N; i++)
        d->size[i] = s->at.size_x[i] > 0 ? s->at.size_x[i] : 1;
    rows.n = rows.rank = 0;
#if LAW
    slopes_of_piece(s, piece, s->sides, length/2, &d->at);
    read_rows(piece, &d->at, &rows);
#endif
    const int begins = !d->begun || piece[AT_EVENT] != 0;
    if (d->begun && piece[AT_EVENT] != 0)
        status = pass_switch(s, d, &rows);
    d->begun = 1;
    memcpy(&d->rows, &rows, sizeof rows);
#if LAW
    if (status == MODEL_OK && begins) {
        if (!linearise(s, d, piece, s->sides, &rows, 0, &d->at))
            return MODEL_NOT_SOLVED;
        status = project_tangents(d, &rows, &d->at);
    }
#else
    UNUSED(begins);
#endif
#if AFFINE_FLOW
    if (status == MODEL_OK && !(linearise(s, d, piece, s->sides, &rows, length/2, &d->at) && take_flow(d, &d->at)))
        return MODEL_NOT_SOLVED;
#endif
    for (long r = 0; status == MODEL_OK && r < count && times[r] <= end; r++) {
        const double where = times[r] == end ? length : (times[r] - piece[AT_T])/piece[AT_TAU];
        if (where > at)
            status = follow(s, d, at, where);
        at = max_of(at, where);
        if (status == MODEL_OK)
            status = write_tangents(s, d, at, out + r*(N + M)*BY);
    }
    if (status == MODEL_OK && length > at)
        status = follow(s, d, at, length);
    memcpy(d->piece, piece, sizeof d->piece);
    memcpy(d->sides, s->sides, sizeof d->sides);
    return status;
}
