
/* The second-order cone {|(l_2, ..., l_m)| <= l_1}. */
static void cone_project(int m, const double *k, double *u)
{
    const double head = u[0], size = norm(m - 1, u + 1);
    (void)k;
    if (size <= head)
        return;
    u[0] = size <= -head ? 0 : (head + size)/2;
    for (int i = 1; i < m; i++)
        u[i] *= size <= -head ? 0 : u[0]/size;
}

static void cone_jacobian(int m, const double *k, const double *u, double *J)
{
    const double size = norm(m - 1, u + 1);
    (void)k;
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++) {
            const double same = i == j;
            if (size <= u[0])
                J[i*m + j] = same;
            else if (size <= -u[0])
                J[i*m + j] = 0;
            else if (i == 0 || j == 0)
                J[i*m + j] = i == j ? 0.5 : u[i + j]/size/2;
            else
                J[i*m + j] = ((1 + u[0]/size)*same - u[0]/size*(u[i]/size*(u[j]/size)))/2;
        }
}

static int cone_code(int m, const double *k, const double *u)
{
    const double size = norm(m - 1, u + 1);
    (void)k;
    return size <= u[0] ? 0 : size <= -u[0] ? -1 : 1;
}

static void cone_onto_boundary(int m, const double *k, double *l)
{
    (void)k;
    l[0] = norm(m - 1, l + 1);
}

static void cone_selected(int m, const double *k, const double *y, double *l)
{
    (void)k;
    (void)y;
    for (int i = 0; i < m; i++)
        l[i] = 0;
}

static double cone_radius(int m, const double *k)
{
    (void)m;
    (void)k;
    return INFINITY;
}

static int cone_valid(int m, const double *k)
{
    (void)m;
    (void)k;
    return 1;
}
