/*
 * What double precision cannot see: rows may err by their running error bounds, and by what the unknowns err by.
 */

/* A sign for entry i of probe p that looks random and is the same everywhere: a bit of a hash. */
static double probe_sign(int i, int p)
{
    unsigned long x = ((unsigned long)(i*PROBES + p) + 1)*SPREAD & 0xFFFFFFFFUL;
    x = (x ^ x >> 15)*MIXED & 0xFFFFFFFFUL;
    x = (x ^ x >> 13)*STIRRED & 0xFFFFFFFFUL;
    return x >> 16 & 1 ? 1.0 : -1.0;
}

/* The work of the probes that tell what the unknowns err by, and how ill-conditioned their system is. */
static int spend_on_probes(model_solver *s)
{
    int left = 1;
    for (int i = 0; i < 2*PROBES; i++)
        left = spend(s);
    return left;
}
