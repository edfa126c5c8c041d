// SUNDIALS CVODE on the same modes: it stops at a root of their conditions, and goes on in the mode chosen by the same germs.
#include <cvode/cvode.h>
#include <nvector/nvector_serial.h>
#include <sunlinsol/sunlinsol_dense.h>
#include <sunmatrix/sunmatrix_dense.h>
#include <sunnonlinsol/sunnonlinsol_fixedpoint.h>

struct Cvode : Modes {
    void *memory;
    N_Vector vector;
    SUNContext context;
    double values[NX];
    long events, steps;

    Cvode(bool stiff)
    {
        SUNContext_Create(NULL, &context);
        vector = N_VMake_Serial(NX, values, context);
        memory = CVodeCreate(stiff ? CV_BDF : CV_ADAMS, context);
        CVodeInit(memory, rate_of, 0, vector);
        CVodeSetUserData(memory, this);
        CVodeSetMaxNumSteps(memory, 100000);
        CVodeSetErrFile(memory, NULL);
        if (stiff) {
            SUNMatrix matrix = SUNDenseMatrix(NX, NX, context);
            CVodeSStolerances(memory, 1e-4, 1e-4);
            CVodeSetLinearSolver(memory, SUNLinSol_Dense(vector, matrix, context), matrix);
        } else
            CVodeSetNonlinearSolver(memory, SUNNonlinSol_FixedPoint(vector, 0, context));
        int directions[2*M];
        for (int i = 0; i < 2*M; i++)
            directions[i] = -1;
        CVodeRootInit(memory, 2*M, conditions_of);
        CVodeSetRootDirection(memory, directions);
        CVodeSetNoInactiveRootWarn(memory);
    }

    int run(double t_end, const double *x0, double rtol, int rows, double *out, double *times, int room, double h_max)
    {
        double largest = 0, time = 0;
        p = 6;
        events = steps = 0;
        if (!begin(x0, t_end))
            return 2;
        for (int i = 0; i < NX; i++) {
            values[i] = out[i] = x0[i];
            largest = larger(largest, fabs(x0[i]));
        }
        CVodeReInit(memory, 0, vector);
        CVodeSStolerances(memory, rtol, rtol*largest);
        CVodeSetMaxStep(memory, h_max);
        CVodeSetStopTime(memory, t_end);
        for (int row = 1; row < rows;) {
            const double next = row < rows - 1 ? row*t_end/(rows - 1) : t_end;
            const int flag = CVode(memory, next, vector, &time, CV_NORMAL);
            if (flag < 0)
                return 100 - flag;
            if (flag == CV_ROOT_RETURN) {
                if (events >= room) /* it switches to and fro */
                    return 5;
                times[events++] = time;
                if (!turn(time))
                    return 4;
                count_steps();
                CVodeReInit(memory, time, vector);
                CVodeSetStopTime(memory, t_end);
                continue;
            }
            for (int i = 0; i < NX; i++)
                out[row*NX + i] = values[i];
            row++;
        }
        count_steps();
        return 0;
    }

private:
    static int rate_of(double time, N_Vector at, N_Vector out, void *self)
    {
        ((Cvode *)self)->rate(time, N_VGetArrayPointer(at), N_VGetArrayPointer(out));
        return 0;
    }

    static int conditions_of(double time, N_Vector at, double *out, void *self)
    {
        Cvode *s = (Cvode *)self;
        double c[PM + 2];
        s->t = time;
        memcpy(s->state, N_VGetArrayPointer(at), sizeof s->state);
        s->expand(1);
        for (int i = 0; i < M; i++)
            for (int side = 0; side < 2; side++)
                out[2*i + side] = s->condition(i, side, 1, c) < 0 ? 1.0 : c[0];
        return 0;
    }

    void count_steps()
    {
        long n;
        CVodeGetNumSteps(memory, &n);
        steps += n;
    }

    bool turn(double time)
    {
        int roots[2*M];
        double c[PM + 2];
        CVodeGetRootInfo(memory, roots);
        t = time;
        memcpy(state, values, sizeof state);
        expand(1);
        for (int i = 0; i < M; i++) {
            open[i] = roots[2*i] || roots[2*i + 1];
            int end = roots[2*i + 1] != 0;
            for (int side = 0; side < 2; side++)
                if (condition(i, side, 1, c) >= 0 && fabs(c[0]) < 1e-11) {
                    if (!open[i])
                        end = side;
                    open[i] = true;
                }
            if (!open[i])
                continue;
            before[i] = code[i];
            code[i] = code[i] != 0 ? 0 : end ? 1 : -1;
        }
        project();
        t = time;
        if (!select())
            return false;
        memcpy(values, state, sizeof state);
        for (int i = 0; i < M; i++)
            open[i] = false;
        return true;
    }
};
