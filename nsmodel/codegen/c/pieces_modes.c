/* How multipliers follow in a mode: event_driven/multipliers.py. */

static void exchange(double *a, double *b)
{
    const double kept = *a;
    *a = *b;
    *b = kept;
}

/* A (n, n) becomes its inverse, by Gauss and Jordan with pivots; 0 where it is singular. */
static int inverse_of(int n, double *A)
{
    int from[2*(N + M)];
    for (int k = 0; k < n; k++) {
        int p = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(A[i*n + k]) > fabs(A[p*n + k]))
                p = i;
        if (!(fabs(A[p*n + k]) > 0))
            return 0;
        from[k] = p;
        for (int j = 0; j < n && p != k; j++)
            exchange(&A[k*n + j], &A[p*n + j]);
        const double d = 1/A[k*n + k];
        A[k*n + k] = 1;
        for (int j = 0; j < n; j++)
            A[k*n + j] *= d;
        for (int i = 0; i < n; i++) {
            const double a = A[i*n + k];
            if (i == k || a == 0)
                continue;
            A[i*n + k] = 0;
            for (int j = 0; j < n; j++)
                A[i*n + j] -= a*A[k*n + j];
        }
    }
    for (int k = n - 1; k >= 0; k--)
        for (int i = 0; i < n && from[k] != k; i++)
            exchange(&A[i*n + k], &A[i*n + from[k]]);
    return 1;
}

#if LAW
#define HOW (s->kept[s->current])

#if MATRICES
#if SLOPES
static void slopes_here(model_pieces *s)
{
    slopes(s, s->c[0] + T, s->c[0], s->c[0] + L, s->slopes.B, s->slopes.D, s->slopes.C);
}

#define B_AT(i, j) s->slopes.B[(i)*M + (j)]
#define D_AT(i, j) s->slopes.D[(i)*M + (j)]
#define C_AT(i, j) s->slopes.C[(i)*N + (j)]

static double W_at(const model_pieces *s, int i, int j)
{
    double sum = 0;
    for (int k = 0; k < N; k++)
        sum += C_AT(i, k)*B_AT(k, j);
    return sum;
}
#define W_AT(i, j) W_at(s, i, j)
#else
#define D_AT(i, j) D_dense[(i)*M + (j)]
#define W_AT(i, j) W_dense[(i)*M + (j)]
#endif

/* Factors of rows and columns that bring the largest entries of A (n, n) near 1. */
static void units(int n, const double *A, double *r, double *c)
{
    for (int i = 0; i < n; i++)
        r[i] = c[i] = 1;
    for (int pass = 0; pass < BALANCING; pass++) {
        double rows[M] = {0}, columns[M] = {0};
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                const double a = fabs(A[i*n + j])*r[i]*c[j];
                rows[i] = max_of(rows[i], a);
                columns[j] = max_of(columns[j], a);
            }
        for (int i = 0; i < n; i++) {
            r[i] /= rows[i] > 0 ? sqrt(rows[i]) : 1;
            c[i] /= columns[i] > 0 ? sqrt(columns[i]) : 1;
        }
    }
}

/*
 * Singular values by one-sided rotations (Hestenes): A (n, n) becomes U times them, largest first, V the right vectors.
 * Columns of U beyond the rank are completed to an orthonormal basis. Return the rank.
 */
static int singular_values(int n, double *A, double *sigma, double *V)
{
    memset(V, 0, n*n*sizeof *V);
    for (int i = 0; i < n; i++)
        V[i*n + i] = 1;
    for (int sweep = 0, turned = 1; sweep < ROTATIONS && turned; sweep++) {
        turned = 0;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                double a = 0, b = 0, g = 0;
                for (int i = 0; i < n; i++) {
                    a += A[i*n + p]*A[i*n + p];
                    b += A[i*n + q]*A[i*n + q];
                    g += A[i*n + p]*A[i*n + q];
                }
                if (g == 0 || fabs(g) <= EPS*sqrt(a*b))
                    continue;
                const double z = (b - a)/(2*g), t = (z < 0 ? -1 : 1)/(fabs(z) + sqrt(1 + z*z)), co = 1/sqrt(1 + t*t), si = co*t;
                turned = 1;
                for (int i = 0; i < n; i++) {
                    const double u = A[i*n + p], v = V[i*n + p];
                    A[i*n + p] = co*u - si*A[i*n + q];
                    A[i*n + q] = si*u + co*A[i*n + q];
                    V[i*n + p] = co*v - si*V[i*n + q];
                    V[i*n + q] = si*v + co*V[i*n + q];
                }
            }
    }
    for (int j = 0; j < n; j++) {
        double sum = 0;
        for (int i = 0; i < n; i++)
            sum += A[i*n + j]*A[i*n + j];
        sigma[j] = sqrt(sum);
    }
    for (int j = 0; j < n; j++) {
        int best = j;
        for (int k = j + 1; k < n; k++)
            if (sigma[k] > sigma[best])
                best = k;
        for (int i = 0; i < n && best != j; i++) {
            exchange(&A[i*n + j], &A[i*n + best]);
            exchange(&V[i*n + j], &V[i*n + best]);
        }
        exchange(&sigma[j], &sigma[best]);
    }
    int rank = 0;
    while (rank < n && sigma[rank] > SINGULAR*sigma[0])
        rank++;
    for (int j = 0; j < rank; j++)
        for (int i = 0; i < n; i++)
            A[i*n + j] /= sigma[j];
    for (int j = rank; j < n; j++) { /* the unit vector with the most outside of what is there */
        double most = -1, best[M] = {0}, v[M];
        for (int e = 0; e < n; e++) {
            double size = 0;
            for (int i = 0; i < n; i++)
                v[i] = i == e;
            for (int pass = 0; pass < 2; pass++)
                for (int k = 0; k < j; k++) {
                    double dot = 0;
                    for (int i = 0; i < n; i++)
                        dot += A[i*n + k]*v[i];
                    for (int i = 0; i < n; i++)
                        v[i] -= dot*A[i*n + k];
                }
            for (int i = 0; i < n; i++)
                size += v[i]*v[i];
            if (size > most) {
                most = size;
                for (int i = 0; i < n; i++)
                    best[i] = v[i];
            }
        }
        for (int i = 0; i < n; i++)
            A[i*n + j] = best[i]/sqrt(most);
    }
    return rank;
}

/* Whether A (n, n) with this inverse is clear of being singular in its units: |A||A^-1| bounds the ratio of its singular values. */
static int is_clear(int n, const double *A, const double *inverse, const double *r, const double *c)
{
    double size = 0, of_inverse = 0;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const double a = A[i*n + j]*r[i]*c[j], b = inverse[i*n + j]/(c[i]*r[j]);
            size += a*a;
            of_inverse += b*b;
        }
    return size*of_inverse < CLEAR_RATIO*CLEAR_RATIO;
}

/* Whether A A^-1 is I: a small D may make A regular, where it stands by itself, and so may rounding. */
static int is_inverse(int n, const double *A, const double *inverse)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            double missed = i == j;
            for (int k = 0; k < n; k++)
                missed -= A[i*n + k]*inverse[k*n + j];
            if (!(fabs(missed) <= SINGULAR))
                return 0;
        }
    return 1;
}

/* A^+ (n, n), and bases of the left and the right null space in the last columns of U and V; A is overwritten. Return the rank. */
static int generalised_inverse(int n, double *A, double *plus, double *U, double *V)
{
    double r[M], c[M], sigma[M];
    int any = 0, off = 0, holes = 0, finite = 1;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            any |= A[i*n + j] != 0;
            off |= i != j && A[i*n + j] != 0;
            holes |= i == j && A[i*n + j] == 0;
            finite &= is_finite(A[i*n + j]);
        }
    memset(plus, 0, n*n*sizeof *plus);
    if (!any || !finite) {
        for (int i = 0; i < n*n; i++) {
            U[i] = V[i] = i % (n + 1) == 0;
            plus[i] = finite ? 0 : NAN;
        }
        return finite ? 0 : n;
    }
    if (!off && !holes) {
        for (int i = 0; i < n; i++)
            plus[i*n + i] = 1/A[i*n + i];
        return n;
    }
    units(n, A, r, c);
    memcpy(plus, A, n*n*sizeof *plus);
    if (inverse_of(n, plus) && is_clear(n, A, plus, r, c))
        return n;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            U[i*n + j] = A[i*n + j]*r[i]*c[j];
    const int rank = singular_values(n, U, sigma, V);
    memcpy(plus, A, n*n*sizeof *plus);
    if (sigma[n - 1] > n*TERM_ROUNDING*sigma[0] && inverse_of(n, plus) && (rank == n || is_inverse(n, A, plus)))
        return n;
    memset(plus, 0, n*n*sizeof *plus);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            for (int k = 0; k < rank; k++)
                plus[i*n + j] += c[i]*V[i*n + k]*(U[j*n + k]/sigma[k]*r[j]);
    for (int i = 0; i < n; i++)
        for (int k = rank; k < n; k++) {
            U[i*n + k] *= r[i];
            V[i*n + k] *= c[i];
        }
    return rank;
}

/* N = V (U' W_aa V)^+ U', and the left null space of D_aa and W_aa, of rows held by their rate alone. */
static void held_by_rate(model_pieces *s, int rank)
{
    const int n = HOW.n, q = n - rank;
    const int *a = HOW.active;
    double *A = s->work_a, *P = s->work_b, *U = s->work_u, *V = s->work_v;
    double plus[M*M], left[M*M], right[M*M];
    memset(A, 0, q*q*sizeof *A);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const double w = W_AT(a[i], a[j]);
            if (w != 0)
                for (int u = 0; u < q; u++)
                    for (int v = 0; v < q; v++)
                        A[u*q + v] += U[i*n + rank + u]*w*V[j*n + rank + v];
        }
    const int inner = generalised_inverse(q, A, plus, left, right);
    memset(P, 0, n*q*sizeof *P);
    for (int i = 0; i < n; i++)
        for (int u = 0; u < q; u++)
            for (int v = 0; v < q; v++)
                P[i*q + u] += V[i*n + rank + v]*plus[v*q + u];
    memset(HOW.rates, 0, n*n*sizeof *P);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            for (int u = 0; u < q; u++)
                HOW.rates[i*n + j] += P[i*q + u]*U[j*n + rank + u];
    HOW.null = q - inner;
    for (int i = 0; i < n; i++)
        for (int z = 0; z < HOW.null; z++) {
            double sum = 0;
            for (int u = 0; u < q; u++)
                sum += U[i*n + rank + u]*left[u*q + inner + z];
            HOW.rest[i*HOW.null + z] = sum;
        }
}

/* The matrices of the mode at the place. */
static void find_mode(model_pieces *s)
{
    const int n = HOW.n;
    const int *a = HOW.active;
    int any = 0, feeds = 0;
    HOW.direct = HOW.through = HOW.feeds = HOW.null = 0;
    if (n == 0)
        return;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            s->work_a[i*n + j] = D_AT(a[i], a[j]);
            any |= s->work_a[i*n + j] != 0;
        }
    for (int i = 0; i < M; i++)
        for (int j = 0; j < n; j++)
            feeds |= D_AT(i, a[j]) != 0;
    if (!any) { /* all by their rate */
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                s->work_a[i*n + j] = W_AT(a[i], a[j]);
        const int rank = generalised_inverse(n, s->work_a, HOW.rates, s->work_u, s->work_v);
        HOW.through = 1;
        HOW.feeds = feeds;
        HOW.null = n - rank;
        for (int i = 0; i < n; i++)
            for (int z = 0; z < HOW.null; z++)
                HOW.rest[i*HOW.null + z] = s->work_u[i*n + rank + z];
        return;
    }
    const int rank = generalised_inverse(n, s->work_a, HOW.plus, s->work_u, s->work_v);
    HOW.direct = 1;
    if (rank < n) {
        HOW.through = 1;
        HOW.feeds = feeds;
        held_by_rate(s, rank);
    }
}
#endif

static void solve_mode(model_pieces *s)
{
    int n = 0;
    for (int i = 0; i < M; i++)
        n += s->at.codes[i] == 0;
#if MATRICES
    signed char held[M];
    for (int i = 0; i < M; i++)
        held[i] = s->at.codes[i] == 0;
#if SLOPES
    if (!n) { /* of slopes that nothing asks for here */
        HOW.n = s->count = 0;
        find_mode(s);
        return;
    }
    slopes_here(s);
    if (s->count && memcmp(held, HOW.held, sizeof held) == 0 && memcmp(&s->slopes, &s->solved, sizeof s->slopes) == 0)
        return;
    s->solved = s->slopes;
    s->count = 1;
#else
    for (int k = 0; k < s->count; k++) {
        if (memcmp(held, HOW.held, sizeof held) == 0)
            return;
        s->current = (s->current + 1) % s->count;
    }
    if (s->count < KEPT)
        s->current = s->count++;
    else {
        s->current = s->next;
        s->next = (s->next + 1) % KEPT;
    }
#endif
    memcpy(HOW.held, held, sizeof held);
#endif
    for (int i = 0, a = 0; i < M; i++)
        if (s->at.codes[i] == 0)
            HOW.active[a++] = i;
    HOW.n = n;
#if MATRICES
    find_mode(s);
#else
    HOW.through = n > 0;
#endif
}

#if JUDGED
/* Whether D + a little W is so far from having a negative direction that all its Schur complements pass is_p_matrix. */
static int is_always_p(model_pieces *s)
{
#if DIAGONAL
    for (int i = 0; i < M; i++)
        if (!(W_inverse[i] > 0))
            return 0;
#else
    double d = 0, w = 0, size = 0, *K = s->work_a, *G = s->work_b;
    for (int i = 0; i < M*M; i++) {
        d = max_of(d, fabs(D_dense[i]));
        w = max_of(w, fabs(W_dense[i]));
    }
    const double little = d != 0 && w != 0 ? SHORT*d/w : 1;
    for (int i = 0; i < M*M; i++) {
        K[i] = D_dense[i] + W_dense[i]*little;
        size += K[i]*K[i];
    }
    for (int i = 0; i < M; i++)
        for (int j = 0; j <= i; j++) {
            double sum = (K[i*M + j] + K[j*M + i])/2 - (i == j ? FAR_FROM_SINGULAR*sqrt(size) : 0);
            for (int k = 0; k < j; k++)
                sum -= G[i*M + k]*G[j*M + k];
            if (i == j && !(sum > 0))
                return 0;
            G[i*M + j] = i == j ? sqrt(sum) : sum/G[j*M + j];
        }
#endif
    return 1;
}
#endif

/*
 * Whether the open rows have a P-matrix, D + a little W, or D alone where it moves, those with code 0 that are not open held, and no
 * two of their l are coupled; or x is unique in all modes.
 */
static int is_p_matrix(model_pieces *s)
{
#if UNIQUE
    UNUSED(s);
    return 1;
#else
#if JUDGED
    if (s->unique)
        return 1;
#endif
#if DIAGONAL
    UNUSED(s);
    return 0;
#else
    int o[M], h[M], n = 0, q = 0, r = 0;
    double *S = s->work_a, *among = s->work_b, *plus = s->work_u, largest = 0;
#if D_NUMBERS
    double d = 0, w = 0;
    for (int i = 0; i < M; i++)
        for (int j = 0; j < M; j++) {
            d = max_of(d, fabs(D_AT(i, j)));
            w = max_of(w, fabs(W_AT(i, j)));
        }
    const double little = d != 0 && w != 0 ? SHORT*d/w : 1;
#define K_AT(i, j) (D_AT(i, j) + W_AT(i, j)*little)
#else
#define K_AT(i, j) D_AT(i, j)
#endif
    for (int i = 0; i < M; i++)
        if (s->at.open[i])
            o[n++] = i;
        else if (s->at.codes[i] == 0)
            h[q++] = i;
#if !LINEAR
    for (int i = 0; i < M; i++)
        for (int j = 0; j < M; j++)
            if (coupled[i*M + j] && (s->at.open[i] || s->at.codes[i] == 0) && (s->at.open[j] || s->at.codes[j] == 0))
                return 0;
#endif
    for (int i = 0; i < q; i++)
        for (int j = 0; j < q; j++)
            among[i*q + j] = K_AT(h[i], h[j]);
    if (q && generalised_inverse(q, among, plus, s->work_a, s->work_v) < q)
        return 0;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            double sum = K_AT(o[i], o[j]);
            for (int a = 0; a < q; a++)
                for (int b = 0; b < q; b++)
                    sum -= K_AT(o[i], h[a])*plus[a*q + b]*K_AT(h[b], o[j]);
            S[i*n + j] = sum;
            largest = max_of(largest, fabs(sum));
        }
    /* S + S' by Cholesky */
    double *G = s->work_b;
    for (r = 0; r < n; r++) {
        for (int j = 0; j <= r; j++) {
            double sum = S[r*n + j] + S[j*n + r] - (r == j ? SINGULAR*largest : 0);
            for (int k = 0; k < j; k++)
                sum -= G[r*n + k]*G[j*n + k];
            if (j < r)
                G[r*n + j] = sum/G[j*n + j];
            else if (!(sum > 0))
                goto minors;
            else
                G[r*n + r] = sqrt(sum);
        }
    }
    return 1;
minors:
    if (n > MOST_MINORS)
        return 0;
    for (int set = 1; set < 1 << n; set++) {
        int rows[MOST_MINORS], k = 0;
        double det = 1, scale = 1;
        for (int i = 0; i < n; i++)
            if (set >> i & 1)
                rows[k++] = i;
        for (int i = 0; i < k; i++) {
            double most = 0;
            for (int j = 0; j < k; j++) {
                G[i*k + j] = S[rows[i]*n + rows[j]];
                most = max_of(most, fabs(G[i*k + j]));
            }
            scale *= most;
        }
        for (int c = 0; c < k; c++) {
            int p = c;
            for (int i = c + 1; i < k; i++)
                if (fabs(G[i*k + c]) > fabs(G[p*k + c]))
                    p = i;
            for (int j = 0; j < k && p != c; j++)
                exchange(&G[c*k + j], &G[p*k + j]);
            det *= p != c ? -G[c*k + c] : G[c*k + c];
            for (int i = c + 1; i < k && G[c*k + c] != 0; i++) {
                const double a = G[i*k + c]/G[c*k + c];
                for (int j = c; j < k; j++)
                    G[i*k + j] -= a*G[c*k + j];
            }
        }
        if (!(det > SINGULAR*scale))
            return 0;
    }
    return 1;
#endif
#endif
}
#endif
