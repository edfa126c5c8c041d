// Steps a generated library from C++: two masses on a rough floor. Tells when they stick and slip; their spring softens at 5 s.
//
//     nsmodel codegen cases/mechanics/two_masses.py --out two_masses-c
//     make -C two_masses-c lib
//     g++ -std=c++17 -I two_masses-c docs/examples/host.cpp -L two_masses-c -ltwo_masses -Wl,-rpath,two_masses-c -o host
//     ./host
#include "two_masses.h"

#include <array>
#include <cstdio>
#include <exception>
#include <memory>
#include <new>
#include <stdexcept>

namespace {

// A solver that frees itself, and whose errors are exceptions.
class TwoMasses {
public:
    TwoMasses() : solver(two_masses_create())
    {
        if (!solver)
            throw std::bad_alloc();
    }

    void step() { check(two_masses_step(solver.get())); }

    void set_parameters(const std::array<double, TWO_MASSES_NP> &p) { check(two_masses_set_parameters(solver.get(), p.data())); }

    double time() const { return two_masses_get_time(solver.get()); }

    std::array<double, TWO_MASSES_NX> state() const
    {
        std::array<double, TWO_MASSES_NX> x;
        two_masses_get_state(solver.get(), x.data());
        return x;
    }

    // Mass i sticks where the velocity, which is output i of the law, is 0.
    bool sticks(int i) const { return solver->index[i] == 0; }

private:
    struct Free {
        void operator()(two_masses_solver *s) const { two_masses_free(s); }
    };

    // A failed step has left the state as it was: a host that does not want to stop may go on from there in its own way.
    static void check(int status)
    {
        if (status != TWO_MASSES_OK)
            throw std::runtime_error(two_masses_status_text(status));
    }

    std::unique_ptr<two_masses_solver, Free> solver;
};

} // namespace

int main()
try {
    TwoMasses masses;
    bool stuck[2] = {false, false};
    for (int k = 0; k < 10000; k++) {
        if (k == 5000)
            masses.set_parameters({1, 1, 1, 1, 5}); // m1, m2, mu1, mu2, k, as two_masses.h lists them
        masses.step();
        for (int i = 0; i < 2; i++)
            if (masses.sticks(i) != stuck[i]) {
                stuck[i] = !stuck[i];
                std::printf("t = %.3f s: mass %d %s\n", masses.time(), i + 1, stuck[i] ? "sticks" : "slips");
            }
    }
    const auto x = masses.state();
    std::printf("t = %.3f s: x1 = %.17g m, x2 = %.17g m\n", masses.time(), x[0], x[2]);
} catch (const std::exception &error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
