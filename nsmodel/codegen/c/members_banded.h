    struct {
        double constant[MODEL_SIZE], guess[MODEL_SIZE], u[MODEL_SIZE], best[MODEL_SIZE], F[MODEL_SIZE], size[MODEL_SIZE];
        double change[MODEL_SIZE], felt[MODEL_SIZE], passed[MODEL_SIZE];
#if FOLLOW_ROWS
        signed char exact[MODEL_N];
#endif
        double v[MODEL_SIZE + MODEL_UPPER]; /* in the order of the band; zeros behind */
        double inverse[MODEL_SIZE]; /* 1 / pivots */
        int pivot[MODEL_SIZE];
        int factored; /* the index set and shift whose factors there are */
        double shift;
        double band[MODEL_SIZE * MODEL_BAND];
#if LAW
        signed char held[MODEL_M];
        signed char code[MODEL_M];
#endif
    } banded;
