/*
 * What double precision cannot see: rows may err by their running error bounds, and by what the unknowns err by.
 */

#define REFINEMENTS 5
#define FRAGILE 1e3 /* condition of what elimination leaves up to which its answer is as good as the whole system's */
#define FRAGILE_REFINEMENTS 2
#define PROBES 8
#define WORTH 1e8 /* condition up to which the rounding of the unknowns excuses a row */

/* A sign for entry i of probe p that looks random and is the same everywhere: a bit of a hash. */
static double probe_sign(int i, int p)
{
    unsigned long x = ((unsigned long)(i*PROBES + p) + 1)*2654435769UL & 0xFFFFFFFFUL;
    x = (x ^ x >> 15)*2246822519UL & 0xFFFFFFFFUL;
    x = (x ^ x >> 13)*3266489917UL & 0xFFFFFFFFUL;
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
