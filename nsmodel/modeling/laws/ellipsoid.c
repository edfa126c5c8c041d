
/* The ellipsoid {sum d_i w_i^2 <= 1}, w = V'l, with d = k, V = k + m row by row. */
static void ellipsoid_axes(int m, const double *k, const double *u, double *w)
{
    for (int i = 0; i < m; i++) {
        w[i] = 0;
        for (int j = 0; j < m; j++)
            w[i] += k[m + j*m + i]*u[j];
    }
}

static void ellipsoid_back(int m, const double *k, const double *w, double *u)
{
    for (int i = 0; i < m; i++) {
        u[i] = 0;
        for (int j = 0; j < m; j++)
            u[i] += k[m + i*m + j]*w[j];
    }
}

/* |sqrt(d) w/(1 + mu d)|, and the d/(1 + mu d) of its entries, weighed by their squares' shares. */
static double ellipsoid_size(int m, const double *k, const double *w, double mu, double *slope)
{
    double size = 0;
    for (int i = 0; i < m; i++)
        size = hypot(size, sqrt(k[i])*w[i]/(1 + mu*k[i]));
    *slope = 0;
    for (int i = 0; i < m; i++) {
        const double part = size > 0 ? sqrt(k[i])*w[i]/(1 + mu*k[i])/size : 0;
        *slope += k[i]/(1 + mu*k[i])*part*part;
    }
    return size;
}

/* mu >= 0 with w_i/(1 + mu d_i) on the boundary, 0 inside: Newton's method for 1/size = 1, from below. */
static double ellipsoid_multiplier(int m, const double *k, const double *w)
{
    double mu = 0, slope;
    for (int i = 0; i < MULTIPLIER_ITERATIONS; i++) {
        const double size = ellipsoid_size(m, k, w, mu, &slope), step = size > 1 ? (size - 1)/slope : 0;
        if (!(step > 2*EPS*mu))
            break;
        mu += step;
    }
    return mu;
}

static void ellipsoid_onto_boundary(int m, const double *k, double *l)
{
    double w[MODEL_BLOCK], slope;
    ellipsoid_axes(m, k, l, w);
    const double size = ellipsoid_size(m, k, w, 0, &slope);
    for (int i = 0; i < m; i++)
        l[i] /= size;
}

static void ellipsoid_project(int m, const double *k, double *u)
{
    double w[MODEL_BLOCK];
    ellipsoid_axes(m, k, u, w);
    const double mu = ellipsoid_multiplier(m, k, w);
    if (mu == 0)
        return;
    for (int i = 0; i < m; i++)
        w[i] /= 1 + mu*k[i];
    ellipsoid_back(m, k, w, u);
    ellipsoid_onto_boundary(m, k, u);
}

static void ellipsoid_jacobian(int m, const double *k, const double *u, double *J)
{
    double w[MODEL_BLOCK], n[MODEL_BLOCK], size = 0, across = 0;
    ellipsoid_axes(m, k, u, w);
    const double mu = ellipsoid_multiplier(m, k, w);
    for (int i = 0; i < m; i++) {
        n[i] = k[i]*w[i]/(1 + mu*k[i]);
        size = hypot(size, n[i]);
    }
    for (int i = 0; i < m; i++) {
        n[i] = size > 0 ? n[i]/size : 0;
        across += n[i]*n[i]/(1 + mu*k[i]);
    }
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++) {
            double sum = 0;
            for (int r = 0; r < m && mu > 0; r++) {
                const double a = 1/(1 + mu*k[r]);
                sum += k[m + i*m + r]*a*k[m + j*m + r];
                for (int q = 0; q < m; q++)
                    sum -= k[m + i*m + r]*a*n[r]*n[q]/(1 + mu*k[q])*k[m + j*m + q]/across;
            }
            J[i*m + j] = mu > 0 ? sum : i == j;
        }
}

static int ellipsoid_code(int m, const double *k, const double *u)
{
    double w[MODEL_BLOCK], slope;
    ellipsoid_axes(m, k, u, w);
    return ellipsoid_size(m, k, w, 0, &slope) > 1;
}

static void ellipsoid_selected(int m, const double *k, const double *y, double *l)
{
    double w[MODEL_BLOCK], size = 0;
    ellipsoid_axes(m, k, y, w);
    for (int i = 0; i < m; i++)
        size = hypot(size, w[i]/sqrt(k[i]));
    for (int i = 0; i < m; i++)
        w[i] /= -k[i]*size;
    ellipsoid_back(m, k, w, l);
}

static double ellipsoid_radius(int m, const double *k)
{
    double least = k[0];
    for (int i = 1; i < m; i++)
        least = k[i] < least ? k[i] : least;
    return 1/sqrt(least);
}

static int ellipsoid_valid(int m, const double *k)
{
    (void)m;
    (void)k;
    return 1;
}
