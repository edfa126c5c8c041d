/* When a mode is stiff: event_driven/radau.py. */

enum { NEXT_LENGTH, FAILED, WAIT, COLLOCATED }; /* of at.stiff */

/* The length of a first piece by collocation; 0 where none is tried. */
static double trial(const model_pieces *s, double length)
{
    if (s->at.stiff[WAIT] > 0 || length >= 1 || memchr(s->at.open, 1, M + CHOICES))
        return 0;
#if LAW
    if (HOW.null > 0)
        return 0;
#endif
    for (int i = 0; i < N; i++) {
        double moved = 0, power = 1;
        for (int k = 1; k <= LOW_ORDERS; k++)
            moved += fabs(s->c[k][i])*(power *= STIFF_START*length);
        if (moved > s->at.size_x[i])
            return 0;
    }
    return unit_of(STIFF_START*s->at.tau*length);
}

/* Let series go on, for a while where a piece has failed. */
static void let_series(model_pieces *s, int failed)
{
    double *of = s->at.stiff;
    of[NEXT_LENGTH] = 0;
    of[WAIT] = max_of(of[WAIT] - 1, 0);
    if (failed) {
        of[FAILED] = min_of(of[FAILED] + 1, MOST_WAIT);
        of[WAIT] = ldexp(1, (int)of[FAILED]);
    }
}

/* Forget what was known: another mode. */
static void restart(model_pieces *s) { s->at.stiff[NEXT_LENGTH] = s->at.stiff[FAILED] = s->at.stiff[WAIT] = 0; }

#if STIFF
/* By how many octaves a piece may be longer: its error has the order of its stages + 1. */
static int octaves_of(const model_pieces *s, double error)
{
    if (!is_finite(error))
        return -1;
    return (int)floor(log2(SAFE/max_of(error, NOTHING))/(stages_of(s->order) + 1));
}

/* Where the condition that was 0 before is now, just beyond the end; 0 where it is no more. */
static int beyond_end(const model_pieces *s, double length, condition *hit, double *end)
{
    double c[MOST_ORDERS + 1];
    own_condition(s, hit, s->order, hit);
    coefficients(s, hit, c);
    const double v = value_of(hit->orders + 1, c, length), rate = slope_of(hit->orders + 1, c, length);
    *end = length;
    if (v <= TIE*size_of(s, hit))
        return 1;
    *end -= v/rate;
    return rate < 0 && v <= MOVED*length*-rate;
}

/* The piece that is fitted to h up to its first event, made anew so that it ends near it; its length, and x there into s->last. */
static double ended(model_pieces *s, double h, double most, condition *hit, int *found, double *error)
{
    double length = write_fit(s, h), end = length;
    *found = first_event(s, &end, hit, 0, -1);
    if (!*found && end < length) { /* beyond that a root may hide */
        values_at(s->c[0], COLUMNS, s->order, end, N, s->last);
        return end;
    }
    for (int pass = 0; pass < ENDINGS && *found; pass++) {
        double estimate;
        const double shorter = min_of(s->at.tau*end, most), missed = end > 0 ? fit(s, shorter, &estimate) : NAN;
        condition again;
        if (!(missed <= 1))
            break;
        *error = missed;
        end = length = write_fit(s, shorter);
        if (first_event(s, &end, &again, 0, -1))
            *hit = again;
        else
            *found = beyond_end(s, length, hit, &end);
        if (*found && fabs(end - length) <= ENDED*length && s->at.tau*end <= most)
            break;
        if (end > length && s->at.tau*length >= most)
            *found = 0;
    }
    if (!*found || end == length || end > (1 + ENDED)*length)
        return length;
    values_at(s->c[0], COLUMNS, s->order, end, N, s->last);
    return end;
}

/* The piece by collocation, where that is worth while; else 0, and the series of this length are as they were. */
static int collocate(model_pieces *s, double *length, double most, condition *hit, int *found, double *error)
{
    double *of = s->at.stiff;
    const int first = of[NEXT_LENGTH] == 0;
    const double least = s->at.tau**length*(first ? STIFF_START : STIFF_STAY);
    double h = min_of(first ? trial(s, *length) : of[NEXT_LENGTH], most);
    if (h == 0 || h < least) {
        let_series(s, !first);
        return 0;
    }
    stand(s);
    int longest = OCTAVES_MORE;
    double estimate;
    while (!((*error = fit(s, h, &estimate)) <= 1)) {
        if (estimate <= 1)
            longest = 0; /* what bounds a longer one is too large, whatever its estimate says */
        const int octaves = *error == *error ? octaves_of(s, *error) : -1;
        h = ldexp(h, octaves < -1 ? octaves : -1);
        if (h < least || s->at.t + h == s->at.t) {
            let_series(s, 1);
            return 0;
        }
    }
    const int octaves = first ? longest : octaves_of(s, estimate);
    of[NEXT_LENGTH] = ldexp(h, octaves < longest ? octaves : longest);
    of[FAILED] = first ? of[FAILED] : 0;
    of[WAIT] = 0;
    of[COLLOCATED] += 1;
    *length = ended(s, h, most, hit, found, error);
    *error *= INNER_SHARE;
    return 1;
}
#endif
