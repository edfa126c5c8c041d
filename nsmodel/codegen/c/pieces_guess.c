#if GUESSED
/* Modes that germs' Laplace transforms suggest: event_driven/modes.py. */

static int pivot(model_pieces *s);

/* What they are made of: the germs of y where no row is held, and the matrices at the place. */
typedef struct {
    double y[ORDERS + 1][M], l[M];
    double f_x[N*N], g_l[N*M], h_x[M*N], h_l[M*M];
} transforms;

/* The germs of the mode in which no row is held, of which the codes are put back; 0 where it has none. */
static SELDOM int transforms_of(model_pieces *s, transforms *of)
{
    signed char codes[M];
    memcpy(codes, s->at.codes, sizeof codes);
    for (int i = 0; i < M; i++)
        if (!codes[i])
            s->at.codes[i] = 1;
    const int any = expand(s, ORDERS);
    memcpy(s->at.codes, codes, sizeof codes);
    for (int k = 0; k <= ORDERS; k++)
        memcpy(of->y[k], s->c[k] + Y, sizeof of->y[k]);
    memcpy(of->l, s->c[0] + L, sizeof of->l);
    s->now[0] = s->at.t;
    slopes_on_sides(s, s->now, s->c[0], s->c[0] + L, of->f_x, of->g_l, of->h_x, of->h_l);
#if HELD
    for (int i = 0; i < M; i++) /* states that no l moves */
        for (int j = N - MODEL_PIECES_HELD; j < N; j++)
            of->h_x[i*N + j] = 0;
#endif
    return any;
}

/* The index set at 1/s = h, a share of the unit of time: y^ = q^ + M(s) l^, M = h_l + h_x (s - (f + g)_x)^-1 g_l. 0: there is none. */
static SELDOM int index_set_at(model_pieces *s, const transforms *of, double share, signed char *codes)
{
    const double h = share*s->at.tau;
    double resolvent[N*N], moved[N*M], W[M*M], q[M], l[M], factor = 1;
    for (int i = 0; i < N*N; i++)
        resolvent[i] = (i % (N + 1) == 0) - h*of->f_x[i];
    if (!inverse_of(N, resolvent))
        return 0;
    memset(moved, 0, sizeof moved);
    for (int i = 0; i < N; i++)
        for (int k = 0; k < N; k++)
            for (int j = 0; j < M; j++)
                moved[i*M + j] += resolvent[i*N + k]*of->g_l[k*M + j];
    memset(q, 0, sizeof q);
    for (int k = 0; k <= ORDERS; k++) {
        for (int i = 0; i < M; i++)
            q[i] += factor*of->y[k][i];
        factor *= (k + 1)*share;
    }
    for (int i = 0; i < M; i++)
        for (int j = 0; j < M; j++) {
            double sum = 0;
            for (int k = 0; k < N; k++)
                sum += of->h_x[i*N + k]*moved[k*M + j];
            W[i*M + j] = of->h_l[i*M + j] + h*sum;
            q[i] -= W[i*M + j]*of->l[j];
        }
    memcpy(l, of->l, sizeof l);
    memcpy(codes, s->at.codes, sizeof l/sizeof *l);
    s->boxes.spent = 0;
    s->boxes.budget = s->budget - s->work;
    affine_solve(&s->boxes, M, W, q, lower, upper, l, codes, GUESS_RESIDUAL);
    s->work += s->boxes.spent;
    return s->boxes.affine.residual < INFINITY;
}

/* Pivoting from these index sets, with the rows open that they turn; begun: the place before. 0 where none leads to a mode. */
static SELDOM int pivot_from_guesses(model_pieces *s, const model_place *begun)
{
    transforms of;
    signed char codes[M];
    if (!transforms_of(s, &of))
        return 0;
    for (int k = 0; k < (int)(sizeof laplace_shares/sizeof *laplace_shares); k++) {
        if (!index_set_at(s, &of, laplace_shares[k], codes))
            continue;
        s->at = *begun;
        for (int i = 0; i < M; i++)
            if (codes[i] != s->at.codes[i]) {
                s->at.open[i] = 1;
                s->at.codes[i] = codes[i];
            }
        if (pivot(s))
            return 1;
    }
    return 0;
}

#endif
