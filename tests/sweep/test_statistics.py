"""Statistics of sweeps: they cover what closed forms know as often as theory says, and no failed cell is lost."""

import pickle

import numpy as np
import pytest
import scipy.stats
from scipy.stats import binom, norm

import nsmodel
from nsmodel.errors import UsageError
from nsmodel.sweep import Variable, difference, share, statistics
from nsmodel.sweep.statistics import quantile_interval_ranks, wilson_interval

# ---------------------------------------------------------------- quantities whose moments are known in closed form


def crossing(u):
    """x(2) of x' in 2 - Sgn(x), x(0) = x0 ~ U(-1.5, -0.5)."""
    return (u - 1.5) / 3 + 2


def rest(u):
    """Where x'' + Sgn(x') + x = 0 from x0 ~ U(3, 6), v = 0 comes to rest."""
    x0 = 3 + 3 * u
    n = np.ceil((x0 - 1) / 2)
    return (-1) ** n * (x0 - 2 * n)


def swings(u):
    return np.ceil((2 + 3 * u) / 2)


def period(u):
    """Of T' = -a (T - 5) + 12 u with a band of 19.5 to 20.5, a ~ U(0.4, 0.6)."""
    a = 0.4 + 0.2 * u
    top = 5 + 12 / a
    return np.log((top - 19.5) / (top - 20.5)) / a + np.log((20.5 - 5) / (19.5 - 5)) / a


def play(u):
    """q(1) of the sweeping process q >= sin t from q0 ~ U(0, 1): an atom at sin 1."""
    return np.maximum(u, np.sin(1.0))


MOMENTS = {
    crossing: (5 / 3, 1 / 108),
    rest: (1 / 6, 11 / 36),
    swings: (7 / 3, 2 / 9),
    period: (0.36658783, 0.00101959),
    play: (0.85403671, (1 - np.sin(1) ** 3) / 3 + np.sin(1) ** 3 - 0.85403671**2),
}


def standardised(f, power):
    """E((f - mean)^power) / std^power, by quadrature over u, as no sample enters."""
    mean, variance = MOMENTS[f]
    u = (np.arange(200_000) + 0.5) / 200_000
    return np.mean((f(u) - mean) ** power) / variance ** (power / 2)


def ensembles(f, repetitions, cells, seed):
    """Many sweeps of so many cells each."""
    u = np.random.default_rng(seed).random((repetitions, cells))
    return Variable.of(f.__name__, f(u), ("repetition", "sample"))


def assert_rate(holds, rate):
    """The rate in independent trials is this one: all but 1e-5 of such counts are within the interval."""
    low, high = binom.interval(1 - 1e-5, len(holds), rate)
    assert low <= holds.sum() <= high, f"{holds.mean():.4f}, expected {rate:.4f}"


def assert_rate_at_least(holds, rate):
    assert holds.sum() >= binom.ppf(1e-5, len(holds), rate), f"{holds.mean():.4f}, expected {rate:.4f} or more"


@pytest.mark.parametrize("f", MOMENTS, ids=lambda f: f.__name__)
def test_the_closed_forms_have_these_moments(f):
    u = (np.arange(1_000_000) + 0.5) / 1_000_000
    assert (f(u).mean(), f(u).var()) == pytest.approx(MOMENTS[f], rel=2e-5)


# ---------------------------------------------------------------- coverage


@pytest.mark.parametrize(("f", "cells"), [(crossing, 10), (crossing, 100), (rest, 50), (period, 30), (play, 300)])
def test_the_interval_of_the_mean_covers_as_often_as_its_expansion_says(f, cells):
    """Of what is not normal, to order 1/n: Hall, The Bootstrap and Edgeworth Expansion, 1992."""
    mean, _ = MOMENTS[f]
    of = statistics(ensembles(f, 20_000, cells, seed=cells), over="sample", quantiles=())
    z, skew, kurtosis = norm.ppf(0.975), standardised(f, 3), standardised(f, 4) - 3
    more = 2 * norm.pdf(z) * z * (kurtosis * (z**2 - 3) / 12 - skew**2 * (z**4 + 2 * z**2 - 3) / 18) / cells
    assert_rate((of.low <= mean) & (mean <= of.high), 0.95 + more)


@pytest.mark.parametrize("f", MOMENTS, ids=lambda f: f.__name__)
def test_squared_errors_are_the_variance_of_the_mean(f):
    """Which ddof 1 makes true of the expectation for any number of cells, here 4."""
    mean, variance = MOMENTS[f]
    of = statistics(ensembles(f, 40_000, 4, seed=3), over="sample", quantiles=())
    for squares in (of.error**2, (of.mean - mean) ** 2):
        assert abs(squares.mean() - variance / 4) < 5 * squares.std() / 200


@pytest.mark.parametrize(("f", "q", "at"), [
    (crossing, 0.3, 1.6), (crossing, 0.5, 5 / 3), (crossing, 0.05, 1.5 + 0.05 / 3),
    (rest, 2 / 3, 0.5), (rest, 1 / 6, -0.5), (play, 0.9, 0.9), (period, 0.5, None),
])  # fmt: skip
@pytest.mark.parametrize("cells", [12, 100])
def test_intervals_of_quantiles_cover_as_often_as_they_say(f, q, at, cells):
    """Of a continuous distribution: the level reached is the binomial one, exactly; 12 cells have one end, or none, at some q."""
    at = float(f(np.array(0.5))) if at is None else at  # period is monotone in a
    part = statistics(ensembles(f, 20_000, cells, seed=7), over="sample", quantiles=[q]).quantiles[0]
    assert np.ptp(part.reached) == 0
    assert part.reached[0] >= 0.95 - 1e-12
    assert_rate((part.low <= at) & (at <= part.high), part.reached[0])
    assert (part.low <= part.value).all()
    assert (part.value <= part.high).all()


@pytest.mark.parametrize(("f", "q", "at"), [
    (play, 0.5, np.sin(1)), (play, 0.05, np.sin(1)), (play, np.sin(1), np.sin(1)),
    (swings, 0.5, 2), (swings, 2 / 3, 2), (swings, 0.9, 3),
])  # fmt: skip
@pytest.mark.parametrize("cells", [12, 100])
def test_intervals_of_quantiles_at_atoms_cover_at_least_as_often(f, q, at, cells):
    part = statistics(ensembles(f, 20_000, cells, seed=8), over="sample", quantiles=[q]).quantiles[0]
    assert_rate_at_least((part.low <= at) & (at <= part.high), part.reached[0])


def test_an_atom_is_a_point():
    """Of 100 cells at least 71 are at sin 1 but once in 10^4 times: median and interval are this value, bit for bit."""
    part = statistics(ensembles(play, 100, 100, seed=9), over="sample", quantiles=[0.5]).quantiles[0]
    for found in (part.value, part.low, part.high):
        assert (found == np.sin(1.0)).all()


@pytest.mark.parametrize(("f", "p", "condition"), [
    (crossing, 0.3, lambda x: x < 1.6), (rest, 1 / 3, lambda x: x > 0.5), (play, np.sin(1), lambda x: x <= np.sin(1.0)),
    (swings, 2 / 3, lambda x: x < 2.5), (crossing, 0.02, lambda x: x <= 1.5 + 0.02 / 3),
])  # fmt: skip
@pytest.mark.parametrize("cells", [10, 137])
def test_wilson_covers_as_often_as_the_binomial_law_says(f, p, condition, cells):
    found = share(condition(ensembles(f, 20_000, cells, seed=11)), over="sample")
    k = np.arange(cells + 1)
    ends = [scipy.stats.binomtest(int(j), cells).proportion_ci(0.95, method="wilson") for j in k]
    covered = np.array([end.low <= p <= end.high for end in ends])
    assert_rate((found.low <= p) & (p <= found.high), binom.pmf(k, cells, p)[covered].sum())


def test_differences_on_common_draws_have_the_error_of_the_difference():
    """x(2) beside x(0.1) = x0 + 0.3 from the same x0: variance 4/9 of 1/12, where independent draws would have 10/108."""
    u = np.random.default_rng(5).random((20_000, 25))
    late, early = (Variable.of(name, x, ("repetition", "seed")) for name, x in (("late", crossing(u)), ("early", u - 1.2)))
    of = difference(late, early, over="seed", quantiles=())
    mean = 5 / 3 + 0.7
    assert_rate((of.low <= mean) & (mean <= of.high), 0.95 - 2 * norm.pdf(1.96) * 1.96 * 1.2 * 0.84 / 12 / 25)
    assert np.mean(of.error**2) * 25 == pytest.approx(1 / 27, rel=0.01)
    alone = [statistics(one, over="seed", quantiles=()).error for one in (late, early)]
    assert np.mean(alone[0] ** 2 + alone[1] ** 2) * 25 == pytest.approx(10 / 108, rel=0.01)


def shifted_nets(repetitions, replicates, cells, seed):
    """Nets of equidistant points, each shifted at random: the mean of u over one is uniform, of width 1 / cells."""
    rng = np.random.default_rng(seed)
    u = (np.arange(cells) / cells + rng.random((repetitions, replicates, 1))) % 1
    dims = ("repetition", "replicate", "sample")
    return Variable.of("crossing", crossing(u), dims, low_discrepancy=True)


def test_nets_have_the_error_over_their_replicates():
    of = statistics(shifted_nets(20_000, 8, 16, seed=2), over=("replicate", "sample"), replicates="replicate")
    assert np.mean(of.error**2) == pytest.approx(1 / (9 * 12 * 16**2 * 8), rel=0.01)
    assert_rate((of.low <= 5 / 3) & (5 / 3 <= of.high), 0.95 - 2 * norm.pdf(1.96) * 1.96 * 1.2 * 0.84 / 12 / 8)
    assert (of.count[0], of.std[0]) == (128, pytest.approx(np.sqrt(1 / 108), rel=0.05))
    assert of.replicates == "replicate"
    median = of.quantile(0.5)
    assert_rate_at_least((median.low <= 5 / 3) & (5 / 3 <= median.high), 0.93)


def test_shares_of_nets_have_the_error_over_their_replicates():
    """How many of 16 shifted points are below 0.3 is 4 or 5, with 0.8 of 5: each share has variance 0.16 / 256."""
    found = share(shifted_nets(20_000, 8, 16, seed=4) < 1.6, over=("replicate", "sample"), replicates="replicate")
    half = (found.high - found.low) / 2 / scipy.stats.t.ppf(0.975, 7)
    assert np.mean(half**2) == pytest.approx(0.16 / 256 / 8, rel=0.02)
    assert np.mean(found.value) == pytest.approx(0.3, abs=1e-3)


# ---------------------------------------------------------------- beside SciPy


def test_wilson_is_that_of_scipy():
    for n in (1, 2, 7, 40, 1000):
        for k in {0, 1, n // 3, n - 1, n}:
            for level in (0.5, 0.95, 0.999):
                expected = scipy.stats.binomtest(k, n).proportion_ci(level, method="wilson")
                assert wilson_interval(k, n, level) == pytest.approx((expected.low, expected.high), abs=1e-14)
    assert wilson_interval(0, 0, 0.95) == (0, 1)


def test_ranks_are_those_of_scipy_and_reach_what_the_binomial_law_says():
    rng = np.random.default_rng(0)
    for n in (1, 2, 5, 20, 59, 60, 500):
        x = np.sort(rng.random(n))
        for q in (0.01, 0.05, 0.5, 2 / 3, 0.99):
            for level in (0.8, 0.95):
                r, s, reached = quantile_interval_ranks(n, q, level)
                with np.errstate(all="ignore"):
                    ends = scipy.stats.quantile_test(x, q=0.4, p=q).confidence_interval(level)
                expected = [-np.inf if np.isnan(ends.low) else ends.low, np.inf if np.isnan(ends.high) else ends.high]
                assert [np.r_[-np.inf, x, np.inf][k] for k in (r, s)] == expected, (n, q, level)
                assert reached == pytest.approx(binom.pmf(np.arange(r, s), n, q).sum(), abs=1e-12)
                assert reached >= level


@pytest.mark.parametrize("seed", range(20))
def test_numbers_are_those_of_numpy(seed):
    rng = np.random.default_rng(seed)
    x = rng.choice([rng.normal(size=(5, 4, 7, 3)), rng.integers(0, 3, (5, 4, 7, 3))])
    done = rng.random((5, 4, 7)) < 0.7
    variable = Variable.of("x", x, ("a", "b", "seed", "t"), status=~done)
    of = statistics(variable, over=("seed", "a"), quantiles=(0.05, 0.5, 0.77))
    assert of.dims == ("b", "t")
    assert of.mean.shape == (4, 3)
    for b in range(4):
        for k in range(3):
            some = x[:, b, :, k][done[:, b]]
            assert (of.count[b, k], of.failed[b, k]) == (len(some), 35 - len(some))
            found = [of.mean, of.std, of.error, of.least, of.largest, *(part.value for part in of.quantiles)]
            expected = [some.mean(), some.std(ddof=1), scipy.stats.sem(some), some.min(), some.max()]
            expected += [np.quantile(some, q, method="averaged_inverted_cdf") for q in (0.05, 0.5, 0.77)]
            assert [one[b, k] for one in found] == pytest.approx(expected, rel=1e-13, abs=1e-15)
            ends = scipy.stats.t.interval(0.95, len(some) - 1, some.mean(), scipy.stats.sem(some))
            assert (of.low[b, k], of.high[b, k]) == pytest.approx(ends, rel=1e-12)


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1e155, 1e300])
def test_squares_of_large_and_small_values_do_not_leave_the_range(scale):
    x = np.array([1.0, 2.0, 4.0, 4.5])
    of = statistics(Variable.of("x", scale * x, "seed"))
    assert np.array([of.mean, of.std, of.error]) / scale == pytest.approx(
        [x.mean(), x.std(ddof=1), scipy.stats.sem(x)], rel=1e-14
    )
    same = statistics(Variable.of("x", np.full(7, 0.1 * scale), "seed"))
    assert (same.mean, same.std, same.error) == (0.1 * scale, 0, 0)


# ---------------------------------------------------------------- failed cells, NaN, few cells


def partly_failed():
    """Of 2 x 10 cells, over 3 times: 2 failed and 1 interrupted where mu = 1; where they failed there is NaN."""
    values = np.random.default_rng(1).normal(size=(2, 10, 3))
    status = np.zeros((2, 10), dtype=int)
    status[1, [2, 5]], status[1, 9] = 1, 2
    values[1, [2, 5, 9], 1:] = np.nan
    coords = {"mu": [0.0, 1.0], "t": [0.0, 0.5, 1.0]}
    return Variable.of("x", values, ("mu", "seed", "t"), coords, status=status, unit="m", units={"t": "s"})


def test_failed_cells_are_counted_and_said():
    variable = partly_failed()
    of = nsmodel.statistics(variable, over="seed")
    assert of.count.tolist() == [[10] * 3, [7] * 3]
    assert of.failed.tolist() == [[0] * 3, [3] * 3]
    others = [0, 1, 3, 4, 6, 7, 8]  # also at t = 0, where all of them had a value: the same cells at all times
    np.testing.assert_allclose(of.mean[1], variable.values[1, others].mean(axis=0))
    assert of.failed_share.value[1] == pytest.approx([0.3] * 3)
    expected = scipy.stats.binomtest(3, 10).proportion_ci(method="wilson")
    assert (of.failed_share.low[1, 0], of.failed_share.high[1, 0]) == pytest.approx((expected.low, expected.high))
    assert "3 of 20 cells without a result (2 failed, 1 interrupted): a share of 0.15" in of.text
    assert "a mean is of the other cells alone" in str(of)
    assert "without a result" not in statistics(variable.at(mu=0), over="seed").text


def test_a_share_says_what_failed_cells_leave_open():
    found = share(partly_failed().at(t=1) > 0, over="seed")
    holds = found.holds[1]
    assert (found.count[1], found.failed[1]) == (7, 3)
    assert found.value[1] == holds / 7
    assert (found.bounds[0][1], found.bounds[1][1]) == (holds / 10, (holds + 3) / 10)
    ends = [scipy.stats.binomtest(int(k), 10).proportion_ci(method="wilson") for k in (holds, holds + 3)]
    assert (found.widest[0][1], found.widest[1][1]) == pytest.approx((ends[0].low, ends[1].high))
    assert "3 of 20 cells without a result (2 failed, 1 interrupted)" in str(found)


def test_a_difference_counts_the_failures_of_either():
    a = Variable.of("a", np.arange(5.0), "seed", status=[0, 1, 0, 0, -1])
    b = Variable.of("b", np.ones(5), "seed", status=[0, 0, 3, 0, 2])
    of = difference(a, b)
    assert (of.count, of.failed, of.mean) == (2, 3, 0.5)
    assert of.causes == {"failed": 1, "no model": 1, "not run": 1}


def test_nan_of_a_cell_that_is_done_is_nan_and_no_failure():
    values = np.array([[np.nan, 1.0], [2.0, 3.0], [4.0, 5.0]])
    of = statistics(Variable.of("multiplier", values, ("seed", "t")))
    assert of.failed.tolist() == [0, 0]
    assert np.isnan(of.mean).tolist() == [True, False]
    assert of.mean[1] == 3
    for part in of.quantiles:
        assert np.isnan([part.value[0], part.low[0], part.high[0], part.reached[0]]).all()
    assert "1 row is NaN: a cell that is done has NaN there" in of.text
    found = share(Variable.of("multiplier", values, ("seed", "t")) > 2, over="seed")
    assert np.isnan([found.value[0], found.low[0], found.high[0]]).all()
    assert found.value[1] == pytest.approx(2 / 3)


def test_all_failed_and_one_left():
    values = np.array([[1.0, 2.0], [3.0, 4.0]])
    of = statistics(Variable.of("x", values, ("mu", "seed"), status=[[1, 1], [0, 1]]), over="seed")
    assert of.count.tolist() == [0, 1]
    assert np.isnan(of.mean[0])
    assert (of.mean[1], of.least[1], of.largest[1]) == (3, 3, 3)
    assert np.isnan(of.error).all()
    assert "One cell has no standard error." in of.text
    assert np.isneginf(of.quantiles[0].low).all()
    assert of.failed_share.value.tolist() == [1, 0.5]
    assert np.isnan(share(Variable.of("x", values > 2, ("mu", "seed"), status=[[1, 1], [0, 1]]), over="seed").value[0])


def test_too_few_cells_for_an_end_are_said():
    of = statistics(Variable.of("x", np.arange(20.0), "seed"), quantiles=[0.05])
    assert (of.quantiles[0].low, of.quantiles[0].high) == (-np.inf, 3)
    assert of.quantiles[0].reached == pytest.approx(binom.cdf(3, 20, 0.05))
    assert "Of 20 cells or less quantile 0.05 has no lower end: they are too few." in of.text
    assert "Intervals of quantiles 0.05 reach 98.41 %" in of.text


def test_infinite_values_are_values():
    of = statistics(Variable.of("x", np.r_[np.arange(9.0), np.inf], "seed"), quantiles=[0.5])
    assert (of.mean, of.largest, of.quantiles[0].value) == (np.inf, np.inf, 4.5)


# ---------------------------------------------------------------- words, inputs


def test_text_of_many_rows_is_thinned_and_says_so():
    text = statistics(Variable.of("x", np.ones((500, 4)), ("mu", "seed")), over="seed").text
    assert "24 of 500 rows, evenly spread" in text
    assert len(text.splitlines()) <= 32


def test_values_that_are_laid_out_are_no_draws():
    even = Variable.of("x", np.arange(5.0), "mu", {"mu": np.linspace(0, 2, 5)})
    assert "mu is evenly laid out" in statistics(even).text
    assert statistics(Variable.of("x", np.arange(5.0), "k", {"k": [1, 10, 100, 1000, 10_000]})).even == ("k",)
    for coords in ({"seed": range(5)}, {"seed": [0, 2, 4, 6, 8]}):
        assert statistics(Variable.of("x", np.arange(5.0), "seed", coords)).even == ()
    assert statistics(Variable.of("x", np.arange(5.0), "mu", {"mu": np.random.default_rng(0).random(5)})).even == ()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda v: statistics(v, over="nu"), "over='nu': x has the dims mu, seed, t"),
        (lambda v: statistics(v, over="t"), "over='t': t is an axis within each cell, .* over= takes mu, seed; .* run.mean"),
        (lambda v: statistics(v, over=3), "over=3: expected a dim, several, or None for all of mu, seed"),
        (lambda v: statistics(v.at(mu=0).take("t", 0), quantiles="0.5"), "'0' is not between 0 and 1"),
        (lambda v: v.at(t="late"), "t is never 'late'; its values are 0.0, 0.5, 1.0"),
        (lambda v: v & 1, "x and 1; expected another variable of the same cells"),
        (lambda v: statistics(Variable.of("x", np.zeros((2, 0)), ("mu", "seed")), over="seed"), "x has no cells along seed"),
        (lambda v: statistics(v, over=()), r"over=\(\): expected dims of cells, each once: mu, seed"),
        (lambda v: statistics(v, over=("seed", "seed")), "each once"),
        (lambda v: statistics(v, quantiles=(0.5, 1)), "1 is not between 0 and 1"),
        (lambda v: statistics(v, level=95), "level = 95; expected a number between 0 and 1"),
        (lambda v: statistics(v, over="mu", replicates="seed"), r"replicates='seed' is not among over=\('mu',\)"),
        (lambda v: statistics(v.values), "expected a variable of a sweep or an xarray.DataArray, not ndarray"),
        (lambda v: statistics(v).quantile(0.3), "quantile 0.3 was not asked for; there are 0.05, 0.5, 0.95"),
        (lambda v: share(v), "expected a condition, such as x > 0.5"),
        (lambda v: difference(v, v.at(mu=0)), "expected the same"),
        (lambda v: difference(v, v.map(lambda x: x, unit="mm")), "x is in m, x is in mm; expected the same unit"),
        (lambda v: v.at(nu=1), "x has no dim 'nu'; its dims are mu, seed, t"),
        (lambda v: v > np.zeros(3), "x > an array of shape"),
        (lambda v: v.map(np.sum), "the function returns shape"),
    ],
)
def test_wrong_calls_are_refused_by_name(call, message):
    with pytest.raises(UsageError, match=message):
        call(partly_failed())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dims": ("mu",)}, "expected a name for each axis"),
        ({"dims": ("mu", "mu")}, "expected a name for each axis"),
        ({"dims": ("mu", "seed"), "status": np.zeros(3)}, r"status of shape \(3,\); expected \(3, 4\)"),
        ({"dims": ("mu", "seed"), "status": np.full((3, 4), 7)}, "status 7; expected one of 0, 1, 2, 3, -1"),
        ({"dims": ("mu", "seed"), "coords": {"mu": [1, 2]}}, r"mu of shape \(2,\); expected \(3,\)"),
        ({"dims": ("mu", "seed"), "coords": {"k": [1, 2, 3]}}, "k is not a dim"),
        ({"dims": ("mu", "seed"), "cell_dims": ("seed", "mu")}, "in that order"),
        ({"dims": ("mu", "seed"), "values": np.full((3, 4), "a")}, "expected real numbers"),
    ],
)
def test_what_does_not_belong_together_is_no_variable(arguments, message):
    with pytest.raises(UsageError, match=message):
        Variable.of("x", **{"values": np.zeros((3, 4)), **arguments})


def test_common_seeds_must_be_common():
    a, b = (Variable.of(name, np.ones(3), "seed", {"seed": seeds}) for name, seeds in (("a", [0, 1, 2]), ("b", [0, 2, 1])))
    with pytest.raises(UsageError, match=r"seed\[1\] is 1 of a and 2 of b; expected the same values in the same order"):
        difference(a, b)


def test_a_net_has_no_error_of_its_own():
    net = shifted_nets(2, 8, 16, seed=1)
    for ask in (statistics, lambda v, **more: share(v < 1.6, **more)):
        with pytest.raises(UsageError, match=r"no standard error; .* replicates='replicate'; .* level=None"):
            ask(net, over="sample")
        with pytest.raises(UsageError, match="no standard error"):
            ask(net)
    one = Variable.of("x", np.ones((1, 4)), ("replicate", "sample"), low_discrepancy=True)
    with pytest.raises(UsageError, match="replicate has 1 value; a standard error takes 2 replicates or more"):
        statistics(one, replicates="replicate")
    of = statistics(net, over="sample", level=None)
    assert np.isnan(of.error).all()
    assert np.isnan([of.low, of.high, of.quantiles[1].low, of.failed_share.low]).all()
    assert of.mean == pytest.approx(5 / 3, abs=0.02)
    assert "No errors and no intervals were asked for." in of.text
    seeds = Variable.of("x", np.random.default_rng(0).random((4, 3)), ("sample", "seed"), low_discrepancy=True)
    assert np.isfinite(statistics(seeds, over="seed").error).all()


def test_a_table_is_of_what_may_be_shown():
    found = Variable.of("x" + chr(27), np.ones((2, 3)), ("a\n", "seed"), {"a\n": ["p" + chr(0x202E), "q"]})
    text = statistics(found, over="seed").text
    assert not any(sign in text for sign in (chr(27), chr(0x202E), "a\n"))
    assert [line.split()[0] for line in text.splitlines()[1:4]] == ["a", "p", "q"]


def test_variables_and_results_are_pickled():
    found = pickle.loads(pickle.dumps(partly_failed()))
    assert pickle.loads(pickle.dumps(statistics(found, over="seed"))).text == statistics(partly_failed(), over="seed").text
    assert pickle.loads(pickle.dumps(share(found > 0))).causes == {"failed": 2, "interrupted": 1}


def test_conditions_join():
    x = Variable.of("x", np.array([-1.0, 0.0, 1.0, np.nan]), "seed")
    np.testing.assert_array_equal(((x >= 0) & (x < 1)).values, [0, 1, 0, np.nan])
    np.testing.assert_array_equal(((x < 0) | ~(x <= 0)).values, [1, 0, 1, np.nan])
    assert ((x >= 0) & (x < 1)).title == "x >= 0 and x < 1"


def test_a_variable_is_taken_at_coordinates_and_cannot_be_written():
    variable = partly_failed()
    late = variable.at(t=0.9, mu=1)
    assert (late.dims, late.cell_dims, late.status.sum()) == (("seed",), ("seed",), 4)
    np.testing.assert_array_equal(late.values, variable.values[1, :, 2])
    with pytest.raises(ValueError, match="read-only"):
        variable.values[0] = 1
    named = Variable.of("x", np.arange(2.0), "scheme", {"scheme": ["moreau", "theta"]})
    assert named.at(scheme="theta").values == 1
    with pytest.raises(UsageError, match="scheme is never 'euler'; its values are moreau, theta"):
        named.at(scheme="euler")


def test_an_array_of_xarray_is_a_variable():
    xarray = pytest.importorskip("xarray")
    variable = partly_failed()
    coords = {"mu": [0.0, 1.0], "t": ("t", [0.0, 0.5, 1.0], {"units": "s"}), "status": (("seed", "mu"), variable.status.T)}
    array = xarray.DataArray(variable.values, dims=variable.dims, coords=coords, name="x", attrs={"units": "m"})
    found, expected = statistics(array, over="seed"), statistics(variable, over="seed")
    np.testing.assert_array_equal(found.mean, expected.mean)
    assert found.text == expected.text
    without = array.drop_vars("status")
    assert np.isnan(statistics(without, over="seed").mean[1, 1:]).all()
    samples = xarray.DataArray(np.ones(3), dims="sample", coords={"k": ("sample", [1.0, 2.0, 4.0])})
    assert share(samples).value == 1
