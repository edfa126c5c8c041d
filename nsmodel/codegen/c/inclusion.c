/*
 * The step of catching-up: choose a velocity, predict, project on C as well as the tolerance asks.
 *
 *     y = x_k + h v,   v in F(x_k) - S(x_k);     x_{k+1} in C with |x_{k+1} - y|^2 < d_C(y)^2 + eps_k
 */
#if GRAM

/* W = G G' and b = G w + offset of m rows: with -y in N_K(l), y = W l + b, the point w + G' l is the one that l moves w to. */
static void form(model_solver *s, int m, const double *w)
{
    const double *G = s->inclusion.G;
    for (int i = 0; i < m; i++) {
        s->inclusion.b[i] = s->inclusion.offset[i] + dot(MODEL_NX, G + i*MODEL_NX, w);
        for (int j = 0; j <= i; j++)
            s->inclusion.W[i*m + j] = s->inclusion.W[j*m + i] = dot(MODEL_NX, G + i*MODEL_NX, G + j*MODEL_NX);
    }
}

/* Solve it from l = 0 and the index set in code. Return the residual. */
static double solve_form(model_solver *s, int m, double accepted)
{
    const double *lower = s->inclusion.lower, *upper = s->inclusion.upper;
    ZERO(s->inclusion.l, m);
    affine_solve(s, m, s->inclusion.W, s->inclusion.b, lower, upper, s->inclusion.l, s->inclusion.code, accepted);
    return s->affine.residual;
}
#endif
#if SELECTION

/* v = v_0 + A l. */
static void velocity_of_selection(model_solver *s)
{
    const double *A = s->inclusion.A;
    for (int j = 0; j < MODEL_NX; j++)
        s->inclusion.v[j] = s->inclusion.v_0[j] + dot(MODEL_SELECTION, A + j*MODEL_SELECTION, s->inclusion.selection);
}

/* v in F(x) - S(x) and the l that gives it: where S is continuous there is no choice; where u = 0, a tie, the l of least |P_T v|,
   T the tangent cone of C at x, which keeps the state still when it can stay. By Moreau's decomposition that is the least
   |v + grad c' n| over l in its face and n >= 0 on the active constraints. Return the residual of that choice. */
static double select_velocity(model_solver *s)
{
    double *l = s->inclusion.selection, *u = s->inclusion.u, *G = s->inclusion.G;
    signed char *tied = s->inclusion.tied;
    int m = MODEL_SELECTION, ties = 0;
    velocity(s, s->inclusion.v_0, s->inclusion.A, u);
    for (int i = 0; i < MODEL_SELECTION; i++) {
        tied[i] = u[i] == 0;
        l[i] = u[i] > 0 ? face_lower[i] : u[i] < 0 ? face_upper[i] : u[i];
    }
#if SELECTION_CURVED
    int tied_blocks = 0;
    for (int k = 0; k < MODEL_CURVED; k++) {
        const int start = curved[k].start, n = curved[k].size, still = norm(n, u + start) == 0;
        if (still)
            memset(l + start, 0, (size_t)n*sizeof *l);
        else
            set_selected(&curved[k], NUMBERS(k), u + start, l + start);
        memset(tied + start, still, (size_t)n);
        tied_blocks += still;
    }
#endif
    /* Every row keeps its place; one that is not tied gets 0 in G and the answer l = 0. */
    for (int i = 0; i < MODEL_SELECTION; i++) {
        for (int j = 0; j < MODEL_NX; j++)
            G[i*MODEL_NX + j] = tied[i] ? s->inclusion.A[j*MODEL_SELECTION + i] : 0;
        s->inclusion.lower[i] = tied[i] ? face_lower[i] : 0;
        s->inclusion.upper[i] = tied[i] ? face_upper[i] : 0;
        s->inclusion.code[i] = tied[i] ? 0 : -1;
        ties += tied[i];
    }
    velocity_of_selection(s);
    if (ties == 0)
        return 0;
#if SELECTION_CURVED
    if (tied_blocks > 0) /* a law with balls, among them those that are not tied */
        for (int i = 0; i < MODEL_SELECTION; i++)
            if (!is_finite(face_lower[i])) {
                s->inclusion.lower[i] = face_lower[i];
                s->inclusion.upper[i] = face_upper[i];
            }
#endif
#if CONSTRAINED
    constraints(s, &s->t, s->x, s->inclusion.c, s->inclusion.J);
    for (int i = 0; i < MODEL_M; i++) {
        if (s->inclusion.c[i] != s->inclusion.c[i])
            return INFINITY;
        if (s->inclusion.c[i] <= 0) {
            memcpy(G + m*MODEL_NX, s->inclusion.J + i*MODEL_NX, MODEL_NX*sizeof *G);
            s->inclusion.lower[m] = 0;
            s->inclusion.upper[m] = INFINITY;
            s->inclusion.code[m] = 0;
            m++;
        }
    }
#endif
    ZERO(s->inclusion.offset, m);
    form(s, m, s->inclusion.v);
    for (int i = 0; i < MODEL_SELECTION; i++)
        if (!tied[i])
            s->inclusion.W[i*m + i] = 1;
    const double residual = solve_form(s, m, TOLERANCE/STRICTER);
    for (int i = 0; i < MODEL_SELECTION; i++)
        if (tied[i])
            l[i] = s->inclusion.l[i];
    velocity_of_selection(s);
    return residual;
}
#endif
#if BOX_C

/* x = P_C(y), C a box. The law -(x - y) in N_C(x) holds exactly or, where something is not finite, not at all: return whether. */
static int clip_to_box(model_solver *s)
{
    int on_graph = 1;
    for (int i = 0; i < MODEL_NX; i++) {
        const double y = s->work.predictor[i], lo = X_LOWER[i], up = X_UPPER[i], x = y < lo ? lo : y > up ? up : y, e = x - y;
        s->work.z[i] = x;
        s->inclusion.defect[i] = e;
        if (!(is_finite(e) && lo <= x && x <= up && (e == 0 || (e > 0 && x == lo) || (e < 0 && x == up))))
            on_graph = 0;
    }
#if CONSTRAINED
    constraints(s, &s->inclusion.end, s->work.z, s->inclusion.c, s->inclusion.J);
    for (int i = 0; i < MODEL_M; i++) { /* row i of J is the unit vector that points inwards from its bound */
        double n = 0;
        for (int j = 0; j < MODEL_NX; j++)
            n += s->inclusion.J[i*MODEL_NX + j]*s->inclusion.defect[j];
        s->work.l[i] = worse_of(n, 0.0);
        s->work.code[i] = n > 0 ? 0 : -1;
    }
#endif
    s->work.residual = on_graph ? 0 : INFINITY;
    s->work.iterations = 0;
    return on_graph;
}
#if APPROXIMATE


/* From p in the box, component i of the way to its middle. */
static double inwards(int i, double p)
{
    const double lo = X_LOWER[i], up = X_UPPER[i];
    if (is_finite(lo))
        return is_finite(up) ? lo/2 + up/2 - p : 1 + fabs(p);
    return is_finite(up) ? -1 - fabs(p) : 0;
}

/* Move the projection x towards the middle of the box, as far as |x - y|^2 <= d^2 + 0.9 eps. */
static void use_tolerance(model_solver *s)
{
    const double used = USED*s->inclusion.tolerance;
    double *x = s->work.z, size = 0, slope = 0;
    for (int i = 0; i < MODEL_NX; i++) {
        const double d = inwards(i, x[i]);
        size += d*d;
        slope += s->inclusion.defect[i]*d; /* >= 0: the defect is a normal of the box at x */
    }
    const double both = slope + sqrt(slope*slope + size*used), part = both > 0 ? min_of(used/both, 1.0) : 0;
    for (int i = 0; i < MODEL_NX; i++) {
        const double moved = x[i] + part*inwards(i, x[i]);
        x[i] = moved < X_LOWER[i] ? X_LOWER[i] : moved > X_UPPER[i] ? X_UPPER[i] : moved;
    }
}
#endif
#endif
#if CUTS


/* Evaluate c and J at x; return whether x is in C. */
static int admissible(model_solver *s, const double *x)
{
    constraints(s, &s->inclusion.end, x, s->inclusion.c, s->inclusion.J);
    for (int i = 0; i < MODEL_M; i++)
        if (!(s->inclusion.c[i] >= 0))
            return 0;
    return 1;
}

/* To the m cuts that hold the foot z add those at z: C lies in every {c(z) + J(z)(x - z) >= 0}. The others are dropped, and so is
   a cut with the gradient of the new one: between the two points its c, being concave, is affine, and the cuts are the same.
   Where there is no room for them all, the new ones have to do. Return their number. */
static int add_cuts(model_solver *s, int m, const double *z)
{
    double *G = s->inclusion.G, *offset = s->inclusion.offset;
    const double *J = s->inclusion.J;
    int *constraint = s->inclusion.constraint, kept = 0;
    constraints(s, &s->inclusion.end, z, s->inclusion.c, s->inclusion.J);
    for (int k = 0; k < m; k++) {
        const int acts = fabs(dot(MODEL_NX, G + k*MODEL_NX, z) + offset[k]) <= ACTS*(1 + fabs(offset[k]));
        if (!acts || memcmp(G + k*MODEL_NX, J + constraint[k]*MODEL_NX, MODEL_NX*sizeof *G) == 0)
            continue;
        memmove(G + kept*MODEL_NX, G + k*MODEL_NX, MODEL_NX*sizeof *G);
        offset[kept] = offset[k];
        constraint[kept++] = constraint[k];
    }
    if (kept + MODEL_M > MODEL_CUTS)
        kept = 0;
    memcpy(G + kept*MODEL_NX, J, MODEL_M*MODEL_NX*sizeof *G);
    for (int i = 0; i < MODEL_M; i++) {
        offset[kept + i] = s->inclusion.c[i] - dot(MODEL_NX, J + i*MODEL_NX, z);
        constraint[kept + i] = i;
    }
    return kept + MODEL_M;
}

/* The foot of y on the m cuts; return whether it passes. */
static int project_on_cuts(model_solver *s, int m)
{
    form(s, m, s->work.predictor);
    for (int i = 0; i < m; i++) {
        s->inclusion.lower[i] = 0;
        s->inclusion.upper[i] = INFINITY;
        s->inclusion.code[i] = s->inclusion.b[i] < 0 ? 0 : -1;
    }
    if (!(solve_form(s, m, CUT_TOLERANCE) <= TOLERANCE))
        return 0;
    for (int j = 0; j < MODEL_NX; j++) {
        double moved = 0;
        for (int i = 0; i < m; i++)
            moved += s->inclusion.G[i*MODEL_NX + j]*s->inclusion.l[i];
        s->inclusion.foot[j] = s->work.predictor[j] + moved;
    }
    return 1;
}

/* x: the first point of C from the foot towards the interior point (c is concave: one crossing). Return whether there is one. */
static int pull_back(model_solver *s, double *x)
{
    const double *z = s->inclusion.foot;
    double *point = s->inclusion.point, low = 0, high = 1;
    memcpy(x, z, sizeof s->inclusion.foot);
    if (admissible(s, z))
        return 1;
    for (int i = 0; i < BISECTIONS && high - low > SUM_ERROR*EPS*high; i++) {
        const double middle = (low + high)/2;
        for (int j = 0; j < MODEL_NX; j++)
            point[j] = z[j] + middle*(interior[j] - z[j]);
        if (admissible(s, point)) {
            high = middle;
            memcpy(x, point, sizeof s->inclusion.point);
        } else
            low = middle;
    }
    return high < 1;
}
#endif

static double distance2(const double *x, const double *y)
{
    double sum = 0;
    for (int i = 0; i < MODEL_NX; i++)
        sum += (x[i] - y[i])*(x[i] - y[i]);
    return sum;
}
#if CUTS

/* x in C with |x - y|^2 < d^2 + eps: d, the distance of y to a polyhedron that contains C, is at most d_C(y). */
static int approximate(model_solver *s, double *d2)
{
    const double *y = s->work.predictor;
    double *x = s->work.z;
    int m = 0;
    s->work.iterations = 0;
    memcpy(x, y, sizeof s->work.predictor);
    memset(s->work.l, 0, sizeof s->work.l);
    memset(s->work.code, -1, sizeof s->work.code);
    *d2 = 0;
    if (admissible(s, y)) {
        s->work.residual = 0;
        return OUTER_APPROXIMATION;
    }
    memcpy(s->inclusion.foot, y, sizeof s->inclusion.foot);
    for (int i = 1; i <= CUT_ITERATIONS && spend(s); i++) {
        m = add_cuts(s, m, s->inclusion.foot);
        if (!project_on_cuts(s, m)) { /* many cuts that are nearly the same: the new ones alone are an outer approximation too */
            m = add_cuts(s, 0, s->inclusion.foot);
            if (!project_on_cuts(s, m))
                return NONE;
        }
        *d2 = distance2(s->inclusion.foot, y);
        if (pull_back(s, x) && distance2(x, y) - *d2 < s->inclusion.tolerance) {
            s->work.residual = 0;
            s->work.iterations = i;
            for (int k = 0; k < m; k++)
                s->work.l[s->inclusion.constraint[k]] += s->inclusion.l[k];
            for (int k = 0; k < MODEL_M; k++)
                s->work.code[k] = s->work.l[k] > 0 ? 0 : -1;
            return OUTER_APPROXIMATION;
        }
    }
    return NONE;
}
#endif

/* Project the predictor y on C: x in s->work.z, and *d2 = d^2, d <= d_C(y). Return the solver. */
static int project_predictor(model_solver *s, double *d2)
{
#if BOX_C
    if (!clip_to_box(s))
        return NONE;
    *d2 = distance2(s->work.z, s->work.predictor);
#if APPROXIMATE
    if (s->inclusion.tolerance > 0)
        use_tolerance(s);
#endif
    return CLIP;
#else
#if CUTS
    if (s->inclusion.tolerance > 0)
        return approximate(s, d2);
#endif
#if NEWTON
    const int solver = step_by_newton(s);
    if (solver != NONE)
        *d2 = distance2(s->work.z, s->work.predictor);
    return solver;
#else
    return NONE;
#endif
#endif
}

/* The step from s->x, its answer in s->work and s->inclusion. Return the solver of the projection, NONE where something was not
   verified. */
static int step_by_catching_up(model_solver *s)
{
    double *x = s->work.z, *y = s->work.predictor, d2 = 0;
#if SELECTION
    const double selected = select_velocity(s);
    if (!(selected <= TOLERANCE)) {
        s->work.residual = selected;
        return NONE;
    }
#else
    velocity(s, s->inclusion.v);
#endif
    for (int i = 0; i < MODEL_NX; i++) {
        y[i] = s->x[i] + s->h*s->inclusion.v[i];
        if (!is_finite(y[i]))
            return NONE;
    }
    s->inclusion.end = s->t + s->h;
#if MOVING_BOX
    bounds(s, &s->inclusion.end, s->inclusion.x_lower, s->inclusion.x_upper);
#endif
    s->inclusion.tolerance = 0;
#if APPROXIMATE
    s->inclusion.tolerance = allowed(s);
    if (!(s->inclusion.tolerance >= 0))
        return NONE;
#endif
    const int solver = project_predictor(s, &d2);
    if (solver == NONE)
        return NONE;
    const double excess = distance2(x, y) - d2;
#if APPROXIMATE
    /* Beside the d^2 of a predictor far away, eps_k may be less than round-off. */
    if (!(excess <= s->inclusion.tolerance + SUM_ERROR*MODEL_NX*EPS*d2)) {
        s->work.residual = INFINITY;
        return NONE;
    }
#endif
    for (int i = 0; i < MODEL_NX; i++)
        s->inclusion.defect[i] = x[i] - y[i];
    s->inclusion.excess = worse_of(excess, 0.0);
    s->inclusion.predictor_distance = sqrt(d2);
#if SELECTION
    s->work.residual = worse_of(s->work.residual, selected);
#endif
#if CONSTRAINED
    constraints(s, &s->inclusion.end, x, s->work.y, s->inclusion.J);
#endif
    return solver;
}
