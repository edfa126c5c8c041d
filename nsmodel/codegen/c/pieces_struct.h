/* How the multipliers of the rows that are held follow from y and y'. */
typedef struct {
    int n, direct, through, feeds, null; /* rows; which of the matrices are there; how many rows nothing can hold */
    int active[MODEL_PIECES_M + 1];
#if MATRICES
    signed char held[MODEL_PIECES_M]; /* 1: y = 0 */
    double plus[MODEL_PIECES_M*MODEL_PIECES_M], rates[MODEL_PIECES_M*MODEL_PIECES_M]; /* by y, and by y' */
    double rest[MODEL_PIECES_M*MODEL_PIECES_M]; /* the left null space of both */
#endif
} model_solve;

#if SLOPES
typedef struct {
    double B[MODEL_PIECES_N*MODEL_PIECES_M], D[MODEL_PIECES_M*MODEL_PIECES_M], C[MODEL_PIECES_M*MODEL_PIECES_N];
} model_slopes;

#endif
#if GUESSED
/* What affine problems of the law are solved in. */
typedef struct {
    long spent, budget;
@BOX_MEMBERS@} model_box;

#endif
/* Where a piece starts, and all that the next pieces depend on. */
typedef struct {
    double t, late, tau; /* time, and what rounding leaves of it; unit of time */
    double x[MODEL_PIECES_N], l[MODEL_PIECES_M + 1]; /* state, multipliers at order 0 */
    double size_x[MODEL_PIECES_N], size_y[MODEL_PIECES_M + 1], size_l[MODEL_PIECES_M + 1]; /* the largest so far */
    double choice[MODEL_PIECES_CHOICES + 1]; /* of branches; NaN: none yet */
    double size_switches[MODEL_PIECES_CHOICES + 1]; /* of their arguments, the largest so far */
    double begun, event_width, impulse[MODEL_PIECES_M + 1]; /* 1: an event begins the next piece, known to this, after such a jump */
    double events, touches, redundant, tiny, still; /* counts; tiny, still: pieces in a row; still: that hardly moved time */
    double undecided[MODEL_PIECES_UNDECIDED]; /* events and dips that are not known to rtol; of the first its time, width, switch; whether it is an event */
    int known; /* orders of the series that stand for the place */
    double stiff[MODEL_PIECES_STIFF]; /* length of the next piece by collocation, trials that failed, series until the next; pieces */
    double unique[MODEL_PIECES_VERDICTS]; /* modes shown to be the only one, by all valid ones, not decided */
    signed char codes[MODEL_PIECES_M + 1], open[MODEL_PIECES_M + MODEL_PIECES_CHOICES + 1];
} model_place;

typedef struct {
    model_place at, before; /* before: where the last piece began */
    double times[MODEL_PIECES_TIMES]; /* of events 1, 2, 4, 8, ... */
    double t; /* the time reached */
    double rtol, atol[MODEL_PIECES_N], share; /* of what is allowed at its end, at POINT of a piece */
    int order; /* of the series */
    int estimated; /* whether the defect of each piece is estimated */
#if STIFF
    int residuals; /* whether x' - f - g of pieces by collocation is itself within what is allowed */
#else
    int leaves; /* whether pieces by collocation are left to the caller */
#endif
    int status, live; /* live: there is a piece */
    unsigned long ready;
    long work, budget; /* series computed, polynomials halved: of a piece, at most */
    long pieces, most; /* of one call, at most */
#if PARAMETERS
    double p[MODEL_PIECES_NP];
#endif
#if JUDGED
    int unique; /* whether these parameters let x be the only one in all modes */
#endif
#if INPUTS
    double sizes[MODEL_PIECES_ROWS]; /* of x, l, y before other inputs were set */
#endif
#if HELD
    const double *known_at, *data; /* known times, and the held states after each */
    long knowns;
#endif
@SET@    model_solve kept[MODEL_PIECES_KEPT]; /* of modes */
    int current, count, next;
    double c[MODEL_PIECES_ORDERS + 1][MODEL_PIECES_COLUMNS]; /* coefficients of x, l, y and what they are made of */
    double f[MODEL_PIECES_N], now[1];
    double turns[MODEL_PIECES_M + MODEL_PIECES_CHOICES + 1]; /* codes that wrong conditions ask for */
    double germs[MODEL_PIECES_GERM][MODEL_PIECES_N]; /* of x */
    double value[MODEL_PIECES_ROWS], slope[MODEL_PIECES_N], bound[MODEL_PIECES_N], pushed[MODEL_PIECES_N];
    int rounded; /* whether balls grow by the rounding of each operation */
    double margins[MODEL_PIECES_M + MODEL_PIECES_CHOICES + 1]; /* what rows of h and of branches may differ from polynomials by */
    double margins_now[MODEL_PIECES_M + MODEL_PIECES_CHOICES + 1]; /* on the disc that was evaluated last */
    double later[MODEL_PIECES_N]; /* what states that begin at 0 come to */
#if SLOPES
    model_slopes slopes, solved; /* here; those of the matrices that are kept */
#endif
#if MATRICES
    double work_a[MODEL_PIECES_M*MODEL_PIECES_M], work_b[MODEL_PIECES_M*MODEL_PIECES_M];
    double work_u[MODEL_PIECES_M*MODEL_PIECES_M], work_v[MODEL_PIECES_M*MODEL_PIECES_M];
#endif
#if GENERAL
    double row[MODEL_PIECES_M*MODEL_PIECES_N];
#endif
#if STIFF
    double first[MODEL_PIECES_SIDES], last[MODEL_PIECES_N]; /* of a piece by collocation: where it begins; x at its end */
    double jacobian[MODEL_PIECES_UNKNOWN*MODEL_PIECES_UNKNOWN]; /* of f + g and y of held rows, by x and l of these */
    int unknown; /* its rows */
    double lengths[MODEL_PIECES_OCTAVES + 1]; /* for which inverses are there */
#endif
#if TANGENTS
    double sides[MODEL_PIECES_CHOICES + 1]; /* of switches on the last piece */
#endif
    double piece[MODEL_PIECES_RECORD]; /* the last one; see the enum in @NAME@_pieces.c */
    double per_unit; /* 1 by its unit of time: exact, and a row is read without a division */
#if STIFF
    /* Set before they are read: nothing clears them. */
    double inverses[MODEL_PIECES_OCTAVES + 1][2*MODEL_PIECES_STAGES*MODEL_PIECES_UNKNOWN*MODEL_PIECES_UNKNOWN];
    double nodal[MODEL_PIECES_STAGES*MODEL_PIECES_SIDES], between[MODEL_PIECES_STAGES*MODEL_PIECES_SIDES];
    double work_stages[MODEL_PIECES_STAGES*MODEL_PIECES_SIDES];
    double missed[MODEL_PIECES_STAGES*MODEL_PIECES_UNKNOWN], moved[MODEL_PIECES_STAGES*MODEL_PIECES_UNKNOWN];
#endif
#if GUESSED
    model_box boxes;
#endif
    double discs[MODEL_PIECES_DISCS*(MODEL_PIECES_ORDERS + 2)]; /* the graphs on a disc: set before they are read */
} model_pieces;
