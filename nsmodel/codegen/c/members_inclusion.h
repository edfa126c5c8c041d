    struct {
        double v[MODEL_NX]; /* the velocity chosen */
        double defect[MODEL_NX]; /* next state - predictor */
        double end; /* t + h: the set of a step is that of its end */
#if MOVING_BOX
        double x_lower[MODEL_NX], x_upper[MODEL_NX];
#endif
        double predictor_distance, excess, tolerance; /* d <= d_C(predictor), |defect|^2 - d^2, eps_k */
#if CONSTRAINED
        double c[MODEL_M], J[MODEL_M*MODEL_NX];
#endif
#if SELECTION
        double selection[MODEL_SELECTION]; /* l of the operator's discontinuous part */
        double v_0[MODEL_NX], A[MODEL_NX*MODEL_SELECTION], u[MODEL_SELECTION]; /* v = v_0 + A l, -u in N_K(l) */
        signed char tied[MODEL_SELECTION];
#endif
#if CUTS
        double foot[MODEL_NX], point[MODEL_NX]; /* of the projection on the cuts; on the way from there into C */
        int constraint[MODEL_CUTS]; /* the row of c that a cut comes from */
#endif
#if GRAM
        double G[MODEL_ROWS*MODEL_NX], offset[MODEL_ROWS]; /* W = G G', b = G w + offset */
        double W[MODEL_ROWS*MODEL_ROWS], b[MODEL_ROWS], lower[MODEL_ROWS], upper[MODEL_ROWS], l[MODEL_ROWS];
        signed char code[MODEL_ROWS];
#endif
    } inclusion;
