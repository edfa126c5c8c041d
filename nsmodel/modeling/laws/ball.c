
/* The ball {|l| <= k[0]}. */
static void ball_project(int m, const double *k, double *u)
{
    const double size = norm(m, u), part = size <= k[0] ? 1 : k[0]/size;
    for (int i = 0; i < m; i++)
        u[i] *= part;
}

static void ball_jacobian(int m, const double *k, const double *u, double *J)
{
    const double size = norm(m, u), part = size <= k[0] ? 1 : k[0]/size;
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++)
            J[i*m + j] = part < 1 ? part*((i == j) - u[i]/size*(u[j]/size)) : i == j;
}

static int ball_code(int m, const double *k, const double *u)
{
    return norm(m, u) > k[0];
}

static void ball_onto_boundary(int m, const double *k, double *l)
{
    for (int i = 0; i < m; i++)
        l[i] *= 2;
    ball_project(m, k, l);
}

static void ball_selected(int m, const double *k, const double *y, double *l)
{
    const double size = norm(m, y);
    for (int i = 0; i < m; i++)
        l[i] = -k[0]*y[i]/size;
}

static double ball_radius(int m, const double *k)
{
    (void)m;
    return k[0];
}

static int ball_valid(int m, const double *k)
{
    (void)m;
    return k[0] >= 0 && is_finite(k[0]);
}
