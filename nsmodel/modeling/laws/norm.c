
static double norm(int n, const double *x)
{
    double size = 0;
    for (int i = 0; i < n; i++)
        size = hypot(size, x[i]); /* squares may overflow */
    return size;
}

static void unit_matrix(int m, double *J)
{
    for (int i = 0; i < m*m; i++)
        J[i] = i % (m + 1) == 0;
}
