/* The interface. */

static int is_ready(const model_pieces *s) { return s->ready == READY; }

/* A solver without parameters and start. */
static int clear(model_pieces *s, double rtol)
{
#if STIFF
    memset(s, 0, offsetof(model_pieces, inverses)); /* most of it lies behind */
#else
    memset(s, 0, sizeof *s);
#endif
    if (!is_sound())
        return MODEL_BAD_ARITHMETIC;
    if (!(rtol >= LEAST_RTOL && rtol < 1))
        return MODEL_BAD_STEP;
    s->ready = READY;
    s->estimated = 1;
    s->budget = WORK_OF_PIECE;
    s->most = MOST_PIECES;
    prepare_pieces(s, rtol);
    return MODEL_OK;
}

static int begin_at(model_pieces *s, double t, const double *x);

/* Begin at the start of the model; where the parameters do not let it, others may go on from there. */
static int begin_at_start(model_pieces *s)
{
    double x[N];
    const int status = take_parameters(s);
    start(s, x);
    if (status == MODEL_OK && all_finite(N, x))
        return begin_at(s, 0, x);
    memcpy(s->at.x, x, sizeof x);
    s->t = s->at.t = 0;
    s->live = 0;
    return s->status = status == MODEL_OK ? MODEL_NOT_FINITE : status;
}

int model_pieces_init(model_pieces *s, double rtol)
{
    const int status = clear(s, rtol);
    if (status != MODEL_OK)
        return status;
#if PARAMETERS
    memcpy(s->p, default_p, sizeof s->p);
#endif
    return begin_at_start(s);
}

/* Begin at a state; where that fails it stands there all the same, for others to go on from. */
static int begin_at(model_pieces *s, double t, const double *x)
{
    s->live = 0;
    s->t = t;
    return s->status = begin(s, t, x);
}

/* What a setter that refuses gives back. */
typedef struct {
    model_place at;
    double t;
    int live, status;
} model_standing;

static model_standing standing_of(const model_pieces *s)
{
    const model_standing was = {s->at, s->t, s->live, s->status};
    return was;
}

/* As it stood; series and matrices are computed anew. */
static int give_back(model_pieces *s, const model_standing *was, int status)
{
    s->at = was->at;
    s->at.known = 0;
    s->t = was->t;
    s->live = was->live;
    s->status = was->status;
    s->count = s->current = s->next = 0;
    return status;
}

int model_pieces_set_state(model_pieces *s, double t, const double *x)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!is_finite(t) || !all_finite(N, x))
        return MODEL_NOT_FINITE;
    const model_standing was = standing_of(s);
    const int status = begin_at(s, t, x);
    return status == MODEL_OK ? status : give_back(s, &was, status);
}

#if PARAMETERS
/* Put count numbers in place of those from the first on, and begin anew where it stands; none where that is not possible. */
static int put_numbers(model_pieces *s, int first, int count, const double *values)
{
    double x[N], old[MODEL_PIECES_NP];
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (!all_finite(count, values))
        return MODEL_NOT_FINITE;
    const model_standing was = standing_of(s);
    model_pieces_get_state(s, x);
    if (!all_finite(N, x))
        return MODEL_NOT_FINITE;
    memcpy(old, s->p, sizeof old);
    memcpy(s->p + first, values, (size_t)count*sizeof *values);
    s->count = s->current = s->next = 0;
    int status = take_parameters(s);
    if (status == MODEL_OK)
        status = begin_at(s, s->t, x);
    if (status == MODEL_OK)
        return status;
    memcpy(s->p, old, sizeof old);
    take_parameters(s);
    return give_back(s, &was, status);
}
#endif

#if OWN_PARAMETERS
int model_pieces_set_parameters(model_pieces *s, const double *p) { return put_numbers(s, 0, @NOWN@, p); }

int model_pieces_reset(model_pieces *s)
{
    return is_ready(s) ? begin_at_start(s) : MODEL_NOT_INITIALISED;
}
#endif

#if INPUTS
int model_pieces_set_inputs(model_pieces *s, const double *u)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (s->status == MODEL_OK && !memcmp(s->p + @NOWN@, u, MODEL_PIECES_NU*sizeof *u))
        return MODEL_OK;
    const double events = s->at.events;
    memcpy(s->sizes, s->at.size_x, sizeof s->at.size_x);
    memcpy(s->sizes + L, s->at.size_l, M*sizeof *s->sizes);
    memcpy(s->sizes + Y, s->at.size_y, M*sizeof *s->sizes);
    const int status = put_numbers(s, @NOWN@, MODEL_PIECES_NU, u);
    memset(s->sizes, 0, sizeof s->sizes);
    s->at.events = events;
    return status;
}

void model_pieces_get_inputs(const model_pieces *s, double *u) { memcpy(u, s->p + @NOWN@, MODEL_PIECES_NU*sizeof *u); }
#endif

void model_pieces_set_most(model_pieces *s, long pieces) { s->most = pieces; }

int model_advance(model_pieces *s, double t_end)
{
    if (!is_ready(s))
        return MODEL_NOT_INITIALISED;
    if (s->live && s->t <= t_end && t_end <= s->at.t) {
        s->pieces = 0;
        s->t = t_end;
        return s->status = MODEL_OK;
    }
    if (!is_finite(t_end))
        return MODEL_NOT_FINITE;
    if (t_end < s->t)
        return MODEL_BAD_STEP;
    if (!s->live && s->status != MODEL_OK)
        return s->status;
    for (s->pieces = 0; s->at.t < t_end; s->pieces++) {
        s->status = s->pieces < s->most ? advance_piece(s) : MODEL_NOT_SOLVED;
        if (s->status != MODEL_OK) {
            if (s->live)
                s->t = s->at.t;
            return s->status;
        }
        s->live = 1;
    }
    s->t = t_end;
    return s->status = MODEL_OK;
}

double model_pieces_get_time(const model_pieces *s) { return s->t; }

/* count columns of the piece from the first one, at the time reached. */
static void read_piece(const model_pieces *s, int first, int count, double *out)
{
    const double at = (s->t - s->piece[AT_T])*s->per_unit;
    values_at(s->piece + AT_C + first, ROWS, s->order, at, count, out);
}

void model_pieces_get_state(const model_pieces *s, double *x)
{
    if (!s->live || s->t == s->at.t)
        memcpy(x, s->at.x, sizeof s->at.x);
    else
        read_piece(s, 0, N, x);
}

/* The states at the times that the piece at hand has, but its end; how many. */
static long rows_here(model_pieces *s, long count, const double *times, double *x)
{
    const double begin = s->piece[AT_T], per_unit = s->per_unit, end = s->at.t;
    const double *c = s->piece + AT_C;
    double t = s->t;
    long n = 0, r = 0;
    if (!s->live)
        return 0;
    while (n < count && t <= times[n] && times[n] < end)
        t = times[n++];
    for (; r + 4 <= n; r += 4) {
        const double at[] = {
            (times[r] - begin)*per_unit, (times[r + 1] - begin)*per_unit, (times[r + 2] - begin)*per_unit, (times[r + 3] - begin)*per_unit
        };
        for (int i = 0; i < N; i++)
            values_at_four(c + i, ROWS, s->order, at, N, x + r*N + i);
    }
    for (; r < n; r++)
        values_at(c, ROWS, s->order, (times[r] - begin)*per_unit, N, x + r*N);
    s->t = t;
    return n;
}

/*
 * Integrate through count times, none before the last: x[count*MODEL_PIECES_N], the states there, each as get_state has it. Where a
 * piece fails those before it are there.
 */
int model_advance_through(model_pieces *s, long count, const double *times, double *x)
{
    int status = is_ready(s) ? MODEL_OK : MODEL_NOT_INITIALISED;
    for (long k = 0; k < count && status == MODEL_OK;) {
        k += rows_here(s, count - k, times + k, x + k*N);
        if (k < count && (status = model_advance(s, times[k])) == MODEL_OK)
            model_pieces_get_state(s, x + k++*N);
    }
    return status;
}

#if LAW
void model_pieces_get_multipliers(const model_pieces *s, double *l)
{
    if (s->live)
        read_piece(s, L, M, l);
    else
        memcpy(l, s->at.l, M*sizeof *l);
}

void model_pieces_get_outputs(const model_pieces *s, double *y)
{
    if (s->live)
        read_piece(s, Y, M, y);
    else
        memcpy(y, s->c[0] + Y, M*sizeof *y);
}

void model_pieces_get_index_set(const model_pieces *s, signed char *index)
{
    for (int i = 0; i < M; i++)
        index[i] = s->live ? (signed char)s->piece[AT_CODES + i] : s->at.codes[i];
}
#endif

long model_pieces_get_events(const model_pieces *s) { return (long)s->at.events; }
