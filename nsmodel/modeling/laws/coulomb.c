
/* Coulomb friction: the cone {|l_T| <= mu l_N}, and ŷ = (y_N + mu |y_T|, y_T). */
static int coulomb_contains(double mu, double head, double size)
{
    return mu > 0 && head >= 0 && size <= mu*head; /* without friction the cone is a half line */
}

/* (u_N + mu |u_T|)/(1 + mu^2), for any mu. */
static double coulomb_nearest_normal(double mu, double head, double size)
{
    return mu <= 1 ? (head + mu*size)/(1 + mu*mu) : (head/mu + size)/(1/mu + mu);
}

static void coulomb_project(int m, const double *k, double *u)
{
    const double mu = k[0], head = u[0], size = norm(m - 1, u + 1);
    if (coulomb_contains(mu, head, size))
        return;
    u[0] = mu*size <= -head ? 0 : coulomb_nearest_normal(mu, head, size);
    for (int i = 1; i < m; i++)
        u[i] *= size > 0 ? mu*u[0]/size : 0;
}

static void coulomb_jacobian(int m, const double *k, const double *u, double *J)
{
    const double mu = k[0], head = u[0], size = norm(m - 1, u + 1);
    const int inside = coulomb_contains(mu, head, size), opens = mu*size <= -head;
    const double along = coulomb_nearest_normal(mu, head, size), unit = hypot(1, mu);
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++) {
            const double same = i == j, e_i = i ? (size > 0 ? u[i]/size : 0) : 1, e_j = j ? (size > 0 ? u[j]/size : 0) : 1;
            J[i*m + j] = inside ? same : opens ? 0 : (i ? mu*e_i : 1)/unit*((j ? mu*e_j : 1)/unit);
            if (!inside && !opens && i && j && size > 0)
                J[i*m + j] += mu*along/size*(same - e_i*e_j);
        }
}

static int coulomb_code(int m, const double *k, const double *u)
{
    const double mu = k[0], size = norm(m - 1, u + 1);
    if (coulomb_contains(mu, u[0], size))
        return 0;
    return mu*size <= -u[0] ? -1 : 1;
}

static void coulomb_onto_boundary(int m, const double *k, double *l)
{
    const double size = norm(m - 1, l + 1);
    for (int i = 1; i < m; i++)
        l[i] *= size > 0 ? k[0]*l[0]/size : 0;
}

static void coulomb_selected(int m, const double *k, const double *y, double *l)
{
    (void)k;
    (void)y;
    for (int i = 0; i < m; i++)
        l[i] = 0;
}

static double coulomb_radius(int m, const double *k)
{
    (void)m;
    (void)k;
    return INFINITY;
}

static int coulomb_valid(int m, const double *k)
{
    (void)m;
    return k[0] >= 0 && k[0] < INFINITY;
}

static void coulomb_shift(int m, const double *k, double *y)
{
    y[0] += k[0]*norm(m - 1, y + 1);
}

static void coulomb_shift_jacobian(int m, const double *k, const double *y, double *J)
{
    const double size = norm(m - 1, y + 1);
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++)
            J[i*m + j] = i == j ? 1 : i == 0 && size > 0 ? k[0]*(y[j]/size) : 0;
}

static int coulomb_boundary_ray(int m, const double *k, const double *l, const double *y, double *ray)
{
    const double size = norm(m - 1, y + 1), own = norm(m - 1, l + 1);
    ray[0] = 1;
    for (int i = 1; i < m; i++)
        ray[i] = k[0]*(size > 0 ? -y[i]/size : own > 0 ? l[i]/own : 0);
    return 1;
}

/* A slip in the plane: P_T = -mu P_N e with e = +-1 the sign of y_T: the one whose y_T has that sign, else the one that pushes. */
static void slip_in_plane(const double *W, const double *b, double mu, double *l)
{
    l[0] = l[1] = 0;
    for (int k = 0; k < 2; k++) {
        const double e = (b[1] >= 0) == (k == 0) ? 1 : -1, across = W[0] - e*mu*W[1];
        const double head = -b[0]/across, side = -mu*e*head;
        if (across <= 0)
            continue;
        if (e*(W[2]*head + W[3]*side + b[1]) >= 0 || l[0] == 0) {
            const int fits = e*(W[2]*head + W[3]*side + b[1]) >= 0;
            l[0] = head;
            l[1] = side;
            if (fits)
                return;
        }
    }
}

/* P(a) = -(W + diag(0, a, a))^-1 b; whether it is outside the cone. */
static int drag(const double *W, const double *b, double mu, double a, double *l)
{
    double s[4], c[2];
    for (int i = 0; i < 2; i++) {
        for (int j = 0; j < 2; j++)
            s[2*i + j] = W[3*(i + 1) + j + 1] - W[3*(i + 1)]*W[j + 1]/W[0] + (i == j ? a : 0);
        c[i] = b[i + 1] - W[3*(i + 1)]*(b[0]/W[0]);
    }
    const double det = s[0]*s[3] - s[1]*s[2];
    l[1] = det == 0 ? INFINITY : (s[1]*c[1] - s[3]*c[0])/det;
    l[2] = det == 0 ? INFINITY : (s[2]*c[0] - s[0]*c[1])/det;
    l[0] = -(b[0] + W[1]*l[1] + W[2]*l[2])/W[0];
    return !(hypot(l[1], l[2]) <= mu*l[0]);
}

/* A slip in space: |P_T(a)| = mu P_N(a), a > 0, by bisection: y_T = -a P_T there. */
static void slip_in_space(const double *W, const double *b, double mu, double *l)
{
    double size = 0;
    for (int i = 0; i < 9; i++)
        size = max_of(size, fabs(W[i]));
    double low = 0, high = MIN_DRAG*size;
    int decades = 0;
    for (; decades < DRAG_DECADES && drag(W, b, mu, high, l); decades++) {
        low = high;
        high *= 10;
    }
    if (decades == DRAG_DECADES) {
        l[0] = mu == 0 ? -b[0]/W[0] : 0;
        l[1] = l[2] = 0;
        return;
    }
    for (int i = 0; i < DRAG_BISECTIONS; i++) {
        const double middle = (low + high)/2;
        if (!(low < middle && middle < high))
            break;
        if (drag(W, b, mu, middle, l))
            low = middle;
        else
            high = middle;
    }
    drag(W, b, mu, high, l);
}

/* l = -W^-1 b by elimination with pivots. Return 0, or 1 where W seems singular. */
static int stick(int m, const double *W, const double *b, double *l)
{
    double A[9];
    for (int i = 0; i < m; i++) {
        l[i] = -b[i];
        for (int j = 0; j < m; j++)
            A[3*i + j] = W[m*i + j];
    }
    for (int k = 0; k < m; k++) {
        int best = k;
        for (int i = k + 1; i < m; i++)
            if (fabs(A[3*i + k]) > fabs(A[3*best + k]))
                best = i;
        if (!(fabs(A[3*best + k]) > 0))
            return 1;
        for (int j = 0; j < m; j++) {
            const double swapped = A[3*k + j];
            A[3*k + j] = A[3*best + j];
            A[3*best + j] = swapped;
        }
        const double right = l[k];
        l[k] = l[best];
        l[best] = right;
        for (int i = k + 1; i < m; i++) {
            const double factor = A[3*i + k]/A[3*k + k];
            for (int j = k; j < m; j++)
                A[3*i + j] -= factor*A[3*k + j];
            l[i] -= factor*l[k];
        }
    }
    double terms = 0, most = 0;
    for (int i = m; i-- > 0;) {
        for (int j = i + 1; j < m; j++)
            l[i] -= A[3*i + j]*l[j];
        l[i] /= A[3*i + i];
    }
    for (int i = 0; i < m; i++) {
        double sum = 0;
        for (int j = 0; j < m; j++)
            sum += fabs(W[m*i + j]*l[j]);
        terms = max_of(terms, sum);
        most = max_of(most, fabs(b[i]));
    }
    return !(terms <= MAX_CANCELLATION*most);
}

/* Open, stick or slip, tried in this order. */
static int coulomb_block_solution(int m, const double *k, const double *W, const double *b, double *l)
{
    const double mu = k[0];
    double matrix[9] = {0}, right[3] = {0}, found[3] = {0}; /* a contact has 2 or 3 rows, which the compiler does not know */
    for (int i = 0; i < m && i < 3; i++) {
        l[i] = 0;
        right[i] = b[i];
        for (int j = 0; j < m && j < 3; j++)
            matrix[m*i + j] = W[m*i + j];
    }
    if (b[0] >= 0)
        return 1;
    if (stick(m, matrix, right, found) || !(found[0] >= 0 && norm(m - 1, found + 1) <= mu*found[0])) {
        found[0] = found[1] = found[2] = 0;
        if (W[0] > 0 && m == 2)
            slip_in_plane(matrix, right, mu, found);
        else if (W[0] > 0)
            slip_in_space(matrix, right, mu, found);
    }
    for (int i = 0; i < m && i < 3; i++)
        l[i] = found[i];
    return 1;
}
