"""Pictures of sweeps: what they show is what statistics say, and no failed cell is left out of them."""

import dataclasses

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from nsmodel import plot
from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.sweep import Variable, statistics


def masses(failed=True):
    """41 x 3 x 20 cells over 7 times; of (mu1 = 1.5, k = 10) 4 of 20 failed, of (0.6, 20) one was interrupted."""
    mu, k, t = np.linspace(0, 2, 41), np.array([5.0, 10.0, 20.0]), np.linspace(0, 12, 7)
    noise = 0.1 * np.random.default_rng(0).normal(size=(41, 3, 20, 7))
    status = np.zeros((41, 3, 20), dtype=np.int8)
    if failed:
        status[30, 1, :4], status[12, 2, 3] = 1, 2
    return Variable.of(
        "x1", np.exp(-mu)[:, None, None, None] * np.cos(t) * np.sqrt(k)[None, :, None, None] + noise, ("mu1", "k", "seed", "t"),
        {"mu1": mu, "k": k, "t": t}, status=status, unit="m", units={"t": "s", "k": "N/m"}, label="position of mass 1",
    )  # fmt: skip


def samples(count=500):
    a, k = np.random.default_rng(1).uniform(0.5, 1.5, (2, count))
    return Variable.of(
        "rest", a * k, "sample", {"a": a, "k": k}, along={"a": "sample", "k": "sample"}, units={"a": "N", "k": "N/m"},
        unit="m", status=a > 1.45,
    )  # fmt: skip


def legend(ax):
    return [text.get_text().strip() for text in ax.get_legend().get_texts()] if ax.get_legend() else []


def title(ax):
    return ax.get_title(loc="left")


def words_on(ax):
    return [text.get_text() for text in ax.texts]


def drawn(ax):
    """The pixels of the figure; layout and fonts must not fail or warn."""
    canvas = FigureCanvasAgg(ax.get_figure())
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


# ---------------------------------------------------------------- lines


def test_lines_are_means_with_their_error():
    ax = plot.sweep_line(masses(), "mu1", hue="k", over="seed")
    of = statistics(masses().at(t=12), over="seed")
    for j, line in enumerate(ax.lines[:3]):
        np.testing.assert_array_equal(line.get_ydata(), of.mean[:, j])
        corners = ax.collections[j].get_paths()[0].vertices[:, 1]
        assert corners.min() == pytest.approx((of.mean - of.error)[:, j].min())
        assert corners.max() == pytest.approx((of.mean + of.error)[:, j].max())
    assert title(ax) == "position of mass 1 at t = 12 s: mean ± standard error over 20 seeds"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("mu1", "position of mass 1 [m]")
    gone = "5 of 2460 cells without a result: 4 failed, 1 interrupted"
    assert legend(ax) == ["k = 5 N/m", "k = 10 N/m", "k = 20 N/m", gone]
    np.testing.assert_allclose(ax.lines[-1].get_xdata(), [0.6, 1.5])  # where they failed


def test_bars_of_few_points_and_the_interval_of_the_median():
    found = masses().at(mu1=0.5)
    ax = plot.sweep_line(found, "k", show="median")
    part = statistics(found.at(t=12), over="seed").quantile(0.5)
    bars = ax.containers[0].lines[2][0].get_segments()
    np.testing.assert_allclose([bar[:, 1] for bar in bars], np.stack([part.low, part.high], axis=1))
    assert legend(ax) == ["median over 20 seeds, 95 % interval"]
    assert ax.get_xlabel() == "k [N/m]"
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["5", "10", "20"]


def test_the_spread_is_between_quantiles():
    found = masses().take("k", 0).take("mu1", 3)
    more = Variable.of("x", np.repeat(found.values, 3, axis=1), ("seed", "t"))
    ax = plot.sweep_line(more, show="spread")
    of = statistics(more, over="seed")
    corners = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (corners.min(), corners.max()) == (of.quantiles[0].value.min(), of.quantiles[2].value.max())
    assert legend(ax) == ["median over 20 seeds, 5 % to 95 % quantile"]


def test_an_interval_that_is_open_is_said():
    ax = plot.sweep_line(Variable.of("x", np.arange(12.0).reshape(3, 4), ("k", "seed")), "k", show="median")
    assert legend(ax) == ["median over 4 seeds, 95 % interval, open where cells are too few"]
    assert np.isfinite(drawn(ax)).all()


def test_what_is_no_draw_has_no_error():
    ax = plot.sweep_line(masses(failed=False).take("k", 0))
    assert legend(ax) == ["mean over 41 values of mu1, 20 seeds (mu1 evenly laid out: no error)"]
    assert not ax.collections
    assert not ax.containers
    net = dataclasses.replace(Variable.of("x", np.random.default_rng(0).random((20, 8)), ("mu", "sample")), low_discrepancy=True)
    assert legend(plot.sweep_line(net, "mu")) == ["mean over 8 samples (a net: no error)"]
    nets = Variable.of("x", np.random.default_rng(0).random((20, 8, 4)), ("mu", "sample", "replicate"), low_discrepancy=True)
    ax = plot.sweep_line(nets, "mu")
    of = statistics(nets, ("sample", "replicate"), replicates="replicate")
    assert ax.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx((of.mean + of.error).max())


def test_failures_over_time_are_counted():
    ax = plot.sweep_line(masses().take("mu1", 30), "t", hue="k")
    assert legend(ax)[-1] == "4 of 60 cells failed"
    assert "x" not in {line.get_marker() for line in ax.lines}  # they failed at no time of those drawn


def test_many_lines_have_a_colour_bar():
    ax = plot.sweep_line(masses(failed=False).take("k", 0), "t", hue="mu1")
    bar = ax.figure.axes[1]
    assert (bar.get_ylabel(), legend(ax)) == ("mu1", [])
    assert [tick.get_text() for tick in bar.get_yticklabels()][::3][:2] == ["0", "1"]
    many = Variable.of("x", np.random.default_rng(0).random((500, 30)), ("sample", "t"))
    assert title(plot.sweep_line(many, "t", hue="sample")) == "x (60 of 500 shown, evenly spread)"


def test_words_and_decades_along_the_axes():
    names = ["an implicit scheme with a long name", "theta", "moreau"]
    ax = plot.sweep_line(Variable.of("x", np.ones((3, 2)), ("scheme", "seed"), {"scheme": names}))
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["an impli…long name", "theta", "moreau"]
    steps = np.geomspace(1e-6, 1e-2, 9)
    ax = plot.sweep_line(Variable.of("error", steps**2, "step", {"step": steps}, units={"step": "s"}))
    assert (ax.get_xscale(), ax.get_yscale(), ax.get_xlabel()) == ("log", "log", "step [s]")
    shuffled = Variable.of("x", np.array([3.0, 1.0, 2.0]), "mu", {"mu": [3.0, 1.0, 2.0]})
    np.testing.assert_array_equal(plot.sweep_line(shuffled).lines[0].get_xydata(), [[1, 1], [2, 2], [3, 3]])


def test_a_long_line_keeps_its_extrema():
    values = np.sin(np.linspace(0, 50, 1_000_001))
    values[777_777] = 9
    line = plot.sweep_line(Variable.of("x", values, "t")).lines[0]
    assert len(line.get_ydata()) <= style.MAX_POINTS
    assert line.get_ydata().max() == 9


def test_samples_are_dots_over_their_parameters():
    ax = plot.sweep_line(samples(), "a")
    found = samples()
    np.testing.assert_array_equal(ax.lines[0].get_xdata(), found.coords["a"][found.status == 0])
    assert (ax.get_xlabel(), ax.get_ylabel(), title(ax)) == ("a [N]", "rest [m]", "rest, a dot a cell")
    assert legend(ax) == [f"{(found.status != 0).sum()} of 500 cells failed"]
    assert "20000 of" in title(plot.sweep_line(samples(100_000), "a"))


# ---------------------------------------------------------------- maps


def test_a_map_has_each_value_at_its_place():
    a, b = np.array([0.0, 1.0, 3.0]), np.array([2.0, 1.0])
    values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    ax = plot.sweep_map(Variable.of("x", values, ("a", "b"), {"a": a, "b": b}), "a", "b")
    mesh = ax.collections[0]
    np.testing.assert_array_equal(mesh.get_array(), [[2, 4, 6], [1, 3, 5]])  # b = 1 is below b = 2
    corners = mesh.get_coordinates()
    np.testing.assert_array_equal(corners[0, :, 0], [-0.5, 0.5, 2, 4])
    np.testing.assert_array_equal(corners[:, 0, 1], [0.5, 1.5, 2.5])
    turned = plot.sweep_map(Variable.of("x", values, ("a", "b"), {"a": a, "b": b}), "b", "a").collections[0]
    np.testing.assert_array_equal(turned.get_array(), [[2, 1], [4, 3], [6, 5]])


def test_cells_without_a_result_are_hatched_and_named():
    status = np.zeros((5, 6), dtype=int)
    status[3:, 4:], status[0, 0], status[1, 1], status[4, 0] = 1, -1, 2, 3
    ax = plot.sweep_map(Variable.of("x", np.ones((5, 6)), ("a", "b"), status=status), "a", "b")
    assert legend(ax) == ["failed (4)", "interrupted (1)", "no model (1)", "not run (1)"]
    hatched = {one.get_hatch(): len(one.get_paths()) for one in ax.collections[1:]}
    assert hatched == {"////": 4, "\\\\\\\\": 1, "xxxx": 1, "....": 1}
    assert ax.collections[0].get_array().mask.sum() == 7
    corner = ax.collections[-1].get_paths()[0].vertices
    assert (corner.min(), corner.max()) == (-0.5, 0.5)  # not run: a = b = 0


def test_a_map_is_the_mean_over_what_is_not_drawn():
    ax = plot.sweep_map(masses())
    assert title(ax) == "position of mass 1 at t = 12 s, mean over 20 seeds"
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.figure.axes[1].get_ylabel()) == ("mu1", "k [N/m]", "position of mass 1 [m]")
    np.testing.assert_array_equal(ax.collections[0].get_array(), statistics(masses().at(t=12), over="seed").mean.T)
    assert legend(ax) == ["some of its cells without a result"]
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [[1.5, 10], [0.6, 20]])
    over_time = plot.sweep_map(masses().take("k", 0), "t", "mu1")
    np.testing.assert_array_equal(over_time.collections[0].get_array(), statistics(masses().take("k", 0), over="seed").mean)


def test_maps_over_decades_have_logarithms():
    a, b = np.geomspace(1, 1e4, 5), np.linspace(1, 2, 3)
    ax = plot.sweep_map(Variable.of("peak", a[:, None] * b, ("a", "b"), {"a": a, "b": b}))
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "linear")
    assert isinstance(ax.collections[0].norm, LogNorm)
    np.testing.assert_allclose(ax.collections[0].get_coordinates()[0, :2, 0], [10**-0.5, 10**0.5])


def test_two_parameters_of_samples_are_dots():
    ax = plot.sweep_map(samples(), "a", "k")
    found = samples()
    assert len(ax.collections[0].get_offsets()) == (found.status == 0).sum()
    assert len(ax.lines[0].get_xdata()) == (found.status != 0).sum()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("a [N]", "k [N/m]")
    assert "cells failed" in legend(ax)[0]


# ---------------------------------------------------------------- histograms


def test_an_atom_is_a_spike_beside_bars():
    u = np.random.default_rng(0).random(10_000)
    ax = plot.sweep_histogram(Variable.of("q", np.maximum(u, np.sin(1)), "sample", unit="m", status=u > 0.99))
    done = u <= 0.99
    share = (u[done] <= np.sin(1)).mean()
    assert legend(ax)[0] == f"{100 * share:.3g} % at 0.84147 m (cut)"
    assert sum(bar.get_height() for bar in ax.patches) == pytest.approx(1 - share)
    assert ax.get_ylim()[1] < 0.1  # the bars are to be seen beside 84 %
    assert legend(ax)[-1] == f"{(~done).sum()} of 10000 cells failed"
    assert (ax.get_xlabel(), title(ax)) == ("q [m]", f"q: {done.sum()} cells")


def test_counts_are_spikes_alone_and_a_continuous_quantity_has_none():
    ax = plot.sweep_histogram(Variable.of("swings", np.repeat([2.0, 3.0], [200, 100]), "sample"))
    assert legend(ax) == ["66.7 % at 2", "33.3 % at 3", "median 2", "mean 2.333"]
    assert not ax.patches
    ax = plot.sweep_histogram(Variable.of("x", np.random.default_rng(0).random(300), "sample"))
    assert legend(ax)[0].startswith("median")
    assert sum(bar.get_height() for bar in ax.patches) == pytest.approx(1)
    many = plot.sweep_histogram(Variable.of("n", np.repeat(np.arange(6.0), 10), "sample"))
    assert legend(many)[3] == "3 more such values"


def test_rounding_does_not_split_an_atom():
    values = np.r_[1 + 1e-15 * np.arange(50), np.linspace(2, 3, 50)]
    assert legend(plot.sweep_histogram(Variable.of("x", values, "seed")))[0].startswith("50 % at 1")


def test_a_histogram_over_decades_has_bars_of_one_width_on_the_axis():
    ax = plot.sweep_histogram(Variable.of("error", 10.0 ** np.linspace(-8, 0, 200), "sample"))
    assert ax.get_xscale() == "log"
    ratios = [(bar.get_x() + bar.get_width()) / bar.get_x() for bar in ax.patches]
    assert np.allclose(ratios, ratios[0])


# ---------------------------------------------------------------- overview, edges, words


def test_the_overview_chooses():
    assert plot.sweep_overview(masses()).collections[0].get_array().shape == (3, 41)  # two parameters: a map
    assert legend(plot.sweep_overview(masses().take("mu1", 0))) == ["k = 5 N/m", "k = 10 N/m", "k = 20 N/m"]
    assert plot.sweep_overview(masses().take("k", 0)).get_xlabel() == "mu1"
    assert legend(plot.sweep_overview(masses().take("k", 0).take("mu1", 0))) == ["median over 20 seeds, 5 % to 95 % quantile"]
    assert plot.sweep_overview(samples()).get_ylabel() == "share of the cells done"


@pytest.mark.parametrize("draw", [plot.sweep_line, plot.sweep_map, plot.sweep_histogram, plot.sweep_overview])
@pytest.mark.parametrize("shape", [(3, 4), (1, 1), (1, 4)])
@pytest.mark.parametrize("kind", ["failed", "one value", "nan", "inf", "large", "zero", "one left"])
def test_every_picture_of_little_is_drawn(draw, shape, kind):
    """In a panel of its own and in a small one that is given; nothing warns."""
    values = {"one value": 2.5, "nan": np.nan, "inf": np.inf, "large": 1e300, "zero": 0.0}.get(kind, 1.0)
    status = np.full(shape, kind in ("failed", "one left"), dtype=int)
    status[0, 0] = kind == "failed"
    found = Variable.of("_a$b", np.full(shape, values), ("p", "q"), status=status, unit="%")
    small = style.blank(3, 2.5).add_subplot()
    assert draw(found, ax=small) is small
    drawn(small)
    ax = draw(found)
    drawn(ax)
    if kind == "failed":
        assert words_on(ax) == ["no cell has a result"]
        assert any("failed" in words for words in legend(ax))
    if kind in ("nan", "inf"):
        assert words_on(ax) == ["no value is finite"]


def test_a_given_ax_is_drawn_on_and_returned():
    for draw in (plot.sweep_line, plot.sweep_map, plot.sweep_histogram, plot.sweep_overview):
        ax = Figure().add_subplot()
        assert draw(masses(), ax=ax) is ax


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda v: plot.sweep_line(v, "nu"), "x='nu': x1 has mu1, k, seed, t"),
        (lambda v: plot.sweep_line(v, "mu1", hue="mu1"), "hue='mu1' beside x='mu1': expected k or seed or t"),
        (
            lambda v: plot.sweep_line(v, "mu1", hue="k", over=()),
            r"over=\(\): beside k and mu1 there are seed; expected all of them",
        ),
        (lambda v: plot.sweep_line(v, "mu1", show="mode"), "show='mode'; expected one of mean, median, spread"),
        (lambda v: plot.sweep_line(v.take("mu1", 0).take("k", 0).take("seed", 0).take("t", 0)), "x1 has no dim to draw it over"),
        (lambda v: plot.sweep_map(v, "mu1", "nu"), "y='nu': x1 has"),
        (lambda v: plot.sweep_map(v, "mu1", "mu1"), "both lie along"),
        (lambda v: plot.sweep_map(v.take("mu1", 0).take("k", 0)), "x1 has the dims seed; a map takes two, sweep_line one"),
    ],
)
def test_wrong_calls_are_refused_by_name(call, message):
    with pytest.raises(PlotError, match=message):
        call(masses())
