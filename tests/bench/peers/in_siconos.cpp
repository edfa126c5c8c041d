// Microseconds of a step of Siconos driven from C++, its solver started from the multipliers of the step before where it can be.
//
//     g++ -O2 -std=c++17 -w $(find /usr/include/siconos -type d -printf '-I%p ') in_siconos.cpp -lsiconos_kernel -lsiconos_numerics
//     a.out SCENE SOLVER    SCENE as in in_siconos.py; SOLVER: lemke, or pgs (relays), pivot (complementarity)
//
// CPU time of computeOneStep and nextStep, one warm-up, the least of three runs; set-up is not timed.
#include <SiconosKernel.hpp>
#include <SolverOptions.h>
#include <lcp_cst.h>
#include <relay_cst.h>

#include <cmath>
#include <cstdio>
#include <ctime>
#include <functional>
#include <string>

using Matrix = std::shared_ptr<SimpleMatrix>;

struct Forced : FirstOrderLinearDS {  // x' = A x + b(t): the entries from `first` on are forced.
    Forced(SP::SiconosVector x0, Matrix A, unsigned first, std::function<double(double, int)> forcing)
        : FirstOrderLinearDS(x0, A), first(first), forcing(forcing) {
        setbPtr(std::make_shared<SiconosVector>(x0->size()));
        _b->zero();
    }
    void computeb(double t) override {
        for (unsigned k = first; k < _b->size(); ++k) _b->setValue(k, forcing(t, k - first));
    }
    unsigned first;
    std::function<double(double, int)> forcing;
};

struct Scene {
    SP::DynamicalSystem system;
    SP::Relation relation;
    SP::NonSmoothLaw law;
    SP::OneStepNSProblem problem;
    double h, theta;
    int steps;
};

Matrix zeros(int rows, int columns) {
    auto matrix = std::make_shared<SimpleMatrix>(rows, columns);
    matrix->zero();
    return matrix;
}

Scene chain(int n, int solver) {
    auto x0 = std::make_shared<SiconosVector>(2 * n);
    Matrix A = zeros(2 * n, 2 * n), B = zeros(2 * n, n), C = zeros(n, 2 * n);
    x0->zero();
    for (int i = 0; i < n; ++i) {
        x0->setValue(i, std::sin(2 * M_PI * (i + 1) / (n + 1)));
        A->setValue(i, n + i, 1);
        A->setValue(n + i, i, -200);
        if (i > 0) A->setValue(n + i, i - 1, 100);
        if (i + 1 < n) A->setValue(n + i, i + 1, 100);
        B->setValue(n + i, i, 1);
        C->setValue(i, n + i, 1);
    }
    SP::DynamicalSystem system(new Forced(x0, A, n, [](double t, int i) { return 3 * std::sin(2 * t + 0.3 * i); }));
    SP::Relation relation(new FirstOrderLinearTIR(C, B));
    SP::NonSmoothLaw law(new RelayNSL(n, -1, 1));
    return {system, relation, law, std::make_shared<Relay>(solver), 1e-2, 0.5, n <= 10 ? 1000 : 200};
}

Scene bridge(int solver) {
    const double L = 1e-2, capacity = 1e-6, R = 1e3;
    auto x0 = std::make_shared<SiconosVector>(2);
    Matrix A = zeros(2, 2), B = zeros(2, 4), C = zeros(4, 2), D = zeros(4, 4);
    x0->setValue(0, 10);
    x0->setValue(1, 0);
    A->setValue(0, 1, -1 / capacity), A->setValue(1, 0, 1 / L);
    B->setValue(0, 2, -1 / capacity), B->setValue(0, 3, 1 / capacity);
    C->setValue(2, 0, -1), C->setValue(3, 0, 1);
    for (int row : {0, 1}) D->setValue(row, 0, 1 / R), D->setValue(row, 1, 1 / R), D->setValue(row, 2 + row, -1), D->setValue(2 + row, row, 1);
    auto relation = std::make_shared<FirstOrderLinearTIR>(C, B);
    relation->setDPtr(D);
    SP::DynamicalSystem system(new FirstOrderLinearTIDS(x0, A));
    SP::NonSmoothLaw law(new ComplementarityConditionNSL(4));
    return {system, relation, law, std::make_shared<LCP>(solver), 1e-6, 0.5, 5000};
}

Scene relay(bool slides, int solver) {
    auto x0 = std::make_shared<SiconosVector>(2);
    Matrix A = zeros(2, 2), B = zeros(2, 1), C = zeros(1, 2);
    x0->setValue(0, slides ? 1.0 : 5.3);
    x0->setValue(1, 0);
    A->setValue(0, 1, 1), A->setValue(1, 0, slides ? 0 : -1);
    B->setValue(1, 0, slides ? 2 : 1);
    C->setValue(0, 0, slides ? 1 : 0), C->setValue(0, 1, 1);
    SP::DynamicalSystem system(new FirstOrderLinearTIDS(x0, A));
    if (slides) system.reset(new Forced(x0, A, 1, [](double t, int) { return std::sin(t); }));
    SP::Relation relation(new FirstOrderLinearTIR(C, B));
    SP::NonSmoothLaw law(new RelayNSL(1, -1, 1));
    return {system, relation, law, std::make_shared<Relay>(solver), slides ? 1e-2 : 1e-3, 1.0, slides ? 500 : 12000};
}

Scene scene(const std::string& name, bool lemke) {
    if (name == "diode_bridge") return bridge(lemke ? SICONOS_LCP_LEMKE : SICONOS_LCP_PIVOT);
    const int solver = lemke ? SICONOS_RELAY_LEMKE : SICONOS_RELAY_PGS;
    if (name.rfind("friction_chain_", 0) == 0) return chain(std::stoi(name.substr(15)), solver);
    return relay(name == "sliding_relay", solver);
}

int main(int, char** given) {
    double best = INFINITY;
    for (int repeat = 0; repeat < 4; ++repeat) {
        Scene s = scene(given[1], std::string(given[2]) == "lemke");
        s.problem->numericsSolverOptions()->dparam[SICONOS_DPARAM_TOL] = 1e-10;
        auto interaction = std::make_shared<Interaction>(s.law, s.relation);
        auto dynamics = std::make_shared<NonSmoothDynamicalSystem>(0, 10 * s.steps * s.h);
        dynamics->insertDynamicalSystem(s.system);
        dynamics->link(interaction, s.system);
        auto grid = std::make_shared<TimeDiscretisation>(0, s.h);
        auto scheme = std::make_shared<EulerMoreauOSI>(s.theta);
        auto stepping = std::make_shared<TimeStepping>(dynamics, grid, scheme, s.problem);
        stepping->setResetAllLambda(false);
        const std::clock_t start = std::clock();
        for (int k = 0; k < s.steps; ++k) stepping->computeOneStep(), stepping->nextStep();
        const double each = 1e6 * double(std::clock() - start) / CLOCKS_PER_SEC / s.steps;
        if (repeat) best = std::fmin(best, each);
    }
    std::printf("%s %s %.2f\n", given[1], given[2], best);
}
