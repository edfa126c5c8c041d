#include "recurrences.hpp"

#include MODEL
#include "bernstein.hpp"
#include "modes.hpp"
#include "taylor.hpp"
#ifdef WITH_CVODE
#include "cvode.hpp"
#endif
#ifdef STAGES
#include "radau.hpp"
#endif

// Each runs ``repeat`` times and gives what went wrong, 0: nothing; found: events and steps.
extern "C" int taylor(double t_end, const double *x0, double tol, int order, int rows, double *out, double *times, int room,
                      int repeat, long *found)
{
    static Taylor s;
    int status = 0;
    for (int i = 0; i < repeat; i++)
        status = s.run(t_end, x0, tol, order, rows, out, times, room);
    found[0] = s.events;
    found[1] = s.steps;
    return status;
}

#ifdef WITH_CVODE
extern "C" int cvode(double t_end, const double *x0, double rtol, int stiff, double h_max, int rows, double *out, double *times,
                     int room, int repeat, long *found)
{
    static Cvode adams(false), bdf(true);
    Cvode &s = stiff ? bdf : adams;
    int status = 0;
    for (int i = 0; i < repeat; i++)
        status = s.run(t_end, x0, rtol, rows, out, times, room, h_max);
    found[0] = s.events;
    found[1] = s.steps;
    return status;
}
#endif

#ifdef STAGES
extern "C" int radau(double t_end, const double *x0, double tol, int rows, double *out, double *times, int room, int repeat,
                     long *found)
{
    static Radau s;
    int status = 0;
    for (int i = 0; i < repeat; i++)
        status = s.run(t_end, x0, tol, rows, out, times, room);
    found[0] = s.events;
    found[1] = s.steps;
    return status;
}
#endif
