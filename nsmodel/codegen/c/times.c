/* Times between these are one with t. */
static double earlier(double t) { return t - NEAR*fabs(t); }

static double later(double t) { return t + NEAR*fabs(t); }

/* Whether t is one with offset + k period, k >= 0. */
static int is_multiple(double t, double period, double offset)
{
    const double k = max_of(floor((t - offset)/period + 0.5), 0);
    return fabs(offset + k*period - t) <= NEAR*t;
}

/* The first offset + k period after t, k >= 0: a product, no sum of periods. */
static double multiple_after(double t, double period, double offset)
{
    const double k = max_of(floor((t - offset)/period), 0), at = offset + k*period;
    return at > t ? at : offset + (k + 1)*period;
}

