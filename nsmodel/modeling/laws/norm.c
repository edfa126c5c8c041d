
static double norm(int n, const double *x)
{
    double size = 0;
    for (int i = 0; i < n; i++)
        size = hypot(size, x[i]); /* squares may overflow */
    return size;
}
