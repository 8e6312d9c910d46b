"""The page and the plot of :mod:`studies.comparison`: every statement carries the figures it rests on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.pages import Run, format_share, join_words, wrap_paragraph, write_head, write_table

if TYPE_CHECKING:
    from studies.estimators import Array

Names = tuple[Sequence[str], Sequence[str], Sequence[str]]
RAW, USUAL = 0, 1  # places of no low-pass and of the usual one among the filters
USABLE = 5.0  # per cent of Jt
SMALL = {"R": 0.1, "L": 0.1, "K": 0.1, "Jt": 1.0}  # per cent
PAPER_OPERATORS = ("zero_forcing_1", "zero_forcing_3_tap", "central", "backward")
SHORT = {
    "zero_forcing_1": "LS, zero forcing #1",
    "zero_forcing_3_tap": "LS, zero forcing 3 taps",
    "central": "LS, central",
    "backward": "LS, backward",
    "savitzky_golay_7": "LS, Savitzky-Golay 7",
    "savitzky_golay_15": "LS, Savitzky-Golay 15",
    "partial_moments": "partial moments",
    "instrumental_variables": "instrumental variables",
    "maximum_likelihood": "maximum likelihood",
}


@dataclass(frozen=True)
class Figures:
    """What came out for one noise and period: per cent of the truth, by method for each low-pass.

    ``rms`` and ``bias`` (filters, methods, 6); ``rejected`` (filters, methods, 6) is the share of single rapids on
    which the Durbin-Wu-Hausman test against maximum likelihood rejects at 5 %; ``check_both_directions`` (2, 6) are RMS
    error and bias of zero forcing #1 with the voltage left raw; ``bound`` (6,).
    """

    noise: float
    period_s: float
    rms: Array
    bias: Array
    rejected: Array
    one_sided: Array
    bound: Array


def compute_overall_error(f: Figures) -> Array:
    """Return the geometric mean over the six parameters of RMS error over the bound (filters, methods)."""
    mean: Array = np.exp(np.log(f.rms / f.bound).mean(axis=-1))
    return mean


def write_text(run: Run, found: Sequence[Figures], names: Names, runs: int) -> str:
    """Return the page."""
    lines = write_head("The paper's comparison, reproduced", "comparison", run)
    lines += wrap_paragraph(
        f"""One 0.4 m rapid of the bench, {runs} runs per case, the same noisy rows for every method. The noise is
        white, in per cent of 60 V, 50 A and 150 rad/s on every sample; the low-pass is zero-phase and the same on
        every signal; for the partial moments it sets the horizon (one period of its corner, at least 8 samples).
        Maximum likelihood uses no low-pass. The bound is that of Cramer and Rao for the same rows. The product uses
        {names[1][USUAL]} where nothing else is set."""
    )
    lines += [*_find_best_operator(found, names), *_describe_moments(found, names), *_compare_same_filter(found, names)]
    lines += [*_describe_hausman_test(found, names), "![RMS error over the bound, and bias](comparison.svg)", ""]
    lines += ["## All figures", "", "RMS error (bias), both in % of the true value.", ""]
    for f in found:
        lines += _build_table(f, names)
    return "\n".join(lines)


def _find_best_operator(found: Sequence[Figures], names: Names) -> list[str]:
    methods, filters, parameters = names
    four = [methods.index(name) for name in PAPER_OPERATORS]
    ratios = np.array([[compute_overall_error(f)[k, four] for f in found] for k in range(len(filters))])
    first = ratios.argmin(axis=-1)
    rows = [
        [name, *_rank_operator(f), *(f"{r:.2f}" for r in ratios[k, c]), SHORT[PAPER_OPERATORS[first[k, c]]]]
        for k, name in enumerate(filters)
        for c, f in enumerate(found)
    ]
    by_filter = [_describe_best_operator(name, first[k], found) for k, name in enumerate(filters)]
    ordered = np.sort(ratios[USUAL], axis=-1)
    shifts = _find_largest_bias(found, USUAL, four, parameters.index("R"))
    raw = _find_largest_bias(found, RAW, four, parameters.index("Jt"))
    usable = sum(float(worst) < USABLE for worst in raw)
    lines = ["## Is zero forcing #1 the best of four operators?", ""]
    lines += wrap_paragraph(
        f"""The paper does not name the other three; here they are zero forcing with 3 taps, central and backward. Zero
        forcing #1 is the best {"; ".join(by_filter)}."""
    )
    lines += wrap_paragraph(
        f"""With {filters[USUAL]} the second best is {np.median(ordered[:, 1] / ordered[:, 0]):.2f} times as far off as
        the best (median). There the largest bias of R is {join_words(shifts)} %, in the order of the table: zero
        forcing #1
        and central are accurate to second order, zero forcing with 3 taps and backward to first order. Without a
        low-pass the largest bias of Jt is {join_words(raw)} %: {usable or "none"} of the four can do without one (stay
        below {USABLE:g} %)."""
    )
    columns = ["low-pass", "period ms", "noise %", *(SHORT[n] for n in PAPER_OPERATORS), "best"]
    return [
        *lines,
        "RMS error over the bound, geometric mean over the six parameters:",
        "",
        *write_table(columns, rows),
        "",
    ]


def _describe_best_operator(name: str, first: Array, found: Sequence[Figures]) -> str:
    """Tell in how many cases the first operator is the best with one low-pass, and which is where it is not."""
    won = int((first == 0).sum())
    where = [
        f"{period} ms and {noise} %"
        for k, (period, noise) in zip(first, map(_rank_operator, found), strict=True)
        if not k
    ]
    others = Counter(SHORT[PAPER_OPERATORS[k]].removeprefix("LS, ") for k in first if k)
    reported = [f"at {join_words(where)}"] if 0 < won < len(found) else []
    reported += (
        [f"otherwise {join_words([f'{other} in {count}' for other, count in others.most_common()])}"] if others else []
    )
    place = f" ({'; '.join(reported)})" if reported else ""
    return f"{describe_filter(name)} {format_share(won, len(found))} cases{place}"


def describe_filter(name: str) -> str:
    """Return the words for one of the low-passes."""
    return "without a low-pass" if name == "none" else f"with {name}"


def _rank_operator(f: Figures) -> tuple[str, str]:
    return f"{1e3 * f.period_s:g}", f"{100 * f.noise:g}"


def _find_largest_bias(found: Sequence[Figures], k: int, methods: Sequence[int], parameter: int) -> list[str]:
    """Return the largest bias over the cases of each method with low-pass ``k``."""
    return [f"{max(abs(f.bias[k, m, parameter]) for f in found):.2g}" for m in methods]


def _describe_moments(found: Sequence[Figures], names: Names) -> list[str]:
    methods, filters, parameters = names
    ls, pm = methods.index("zero_forcing_1"), methods.index("partial_moments")
    places = range(len(filters))
    won = np.array([[f.rms[k, ls] < f.rms[k, pm] for f in found] for k in places]).sum(axis=1)
    together = np.array(
        [[compute_overall_error(f)[k, ls] < compute_overall_error(f)[k, pm] for f in found] for k in places]
    ).sum(axis=1)
    rows = [[name, *(f"{w} of {len(found)}" for w in (*won[k], together[k]))] for k, name in enumerate(filters)]
    better = [p for p, count in zip(parameters, won[USUAL], strict=True) if 2 * count > len(found)]
    worst = _find_largest_bias(found, USUAL, (ls, pm), parameters.index("Jt"))
    lines = ["## Does least squares beat the reinitialised partial moments?", ""]
    lines += wrap_paragraph(
        f"""With {filters[USUAL]} it does {
            format_share(int(together[USUAL]), len(found))
        } cases over all six parameters; in most
        cases for {join_words(better, "no parameter")}, not for {
            join_words([p for p in parameters if p not in better])
        }. There
        the largest bias of Jt is {worst[0]} % by least squares and {worst[1]} % by the moments. Without a low-pass it
        does {format_share(int(together[RAW]), len(found))} cases: the moments bring one of their own, their horizon."""
    )
    columns = ["low-pass", *parameters, "all six together"]
    return [*lines, "Cases in which zero forcing #1 has the smaller RMS error:", "", *write_table(columns, rows), ""]


def _compare_same_filter(found: Sequence[Figures], names: Names) -> list[str]:
    methods, filters, parameters = names
    ls, one_sided = methods.index("zero_forcing_1"), f"{filters[USUAL]}, not on the voltage"
    at_1_ms = [f for f in found if f.period_s == 1e-3]
    rows = []
    for f in at_1_ms:
        noise = f"{100 * f.noise:g}"
        rows += [[noise, name, *_format_cells(f.bias[k, ls], f.rms[k, ls])] for k, name in enumerate(filters)]
        rows.append([noise, one_sided, *_format_cells(f.one_sided[1], f.one_sided[0])])
    biases = {name: np.abs([f.bias[k, ls] for f in at_1_ms]) for k, name in enumerate(filters)}
    biases[one_sided] = np.abs([f.one_sided[1] for f in at_1_ms])
    biases = {f"{describe_filter(name)[0].upper()}{describe_filter(name)[1:]}": bias for name, bias in biases.items()}
    words = [f"{name}: {_describe_unbiased(bias, parameters)}" for name, bias in biases.items()]
    growth = [f"{abs(f.bias[USUAL, ls, parameters.index('Jt')]):.2g}" for f in at_1_ms]
    lines = ["## Does the same low-pass on every signal keep the identification unbiased?", ""]
    lines += wrap_paragraph(
        f"""Call it unbiased where R, L and K are less than {SMALL["R"]:g} % off and Jt less than {SMALL["Jt"]:g} %, at
        every noise. {". ".join(words)}. No filter makes least squares consistent: with {filters[USUAL]} on every signal
        Jt is {join_words(growth)} % off as the noise grows."""
    )
    columns = ["noise %", "low-pass", *parameters]
    reported = "Bias of zero forcing #1 at a period of 1 ms, % of the true value (RMS error):"
    return [*lines, reported, "", *write_table(columns, rows), ""]


def _describe_unbiased(bias: Array, parameters: Sequence[str]) -> str:
    """Tell by the largest of ``bias`` (noises, 6) which parameters are biased."""
    most = dict(zip(parameters, bias.max(axis=0), strict=True))
    return join_words([f"{p} is up to {most[p]:.2g} % off" for p in SMALL if most[p] >= SMALL[p]], "unbiased")


def _format_cells(bias: Array, rms: Array) -> list[str]:
    return [f"{b:+.2f} ({r:.2f})" for b, r in zip(bias, rms, strict=True)]


def _describe_hausman_test(found: Sequence[Figures], names: Names) -> list[str]:
    methods, filters, parameters = names
    shown = ("zero_forcing_1", "central", "savitzky_golay_15", "partial_moments", "instrumental_variables")
    pair = [parameters.index("L"), parameters.index("Jt")]
    rows = []
    for k, name in enumerate(filters):
        for f in found:
            cells = [" / ".join(f"{100 * f.rejected[k, methods.index(n), j]:.0f}" for j in pair) for n in shown]
            rows.append([name, *_rank_operator(f), *cells])
    lines = ["## Durbin-Wu-Hausman test against maximum likelihood", ""]
    lines += wrap_paragraph(
        f"""Maximum likelihood is consistent, so an estimate that differs from it by more than chance is biased. The
        test at 5 % tells 5 % of the rapids for a method without bias. {
            _describe_rejections("zero_forcing_1", found, names)
        }.
        {_describe_rejections("instrumental_variables", found, names)}: its instruments follow the NC's demand and know
        nothing of
        the sensors. {_describe_instrument_cost(found, names)}"""
    )
    columns = ["low-pass", "period ms", "noise %", *(SHORT[n] for n in shown)]
    return [*lines, "Rejections, % of the rapids, for L / Jt:", "", *write_table(columns, rows), ""]


def _describe_rejections(method: str, found: Sequence[Figures], names: Names) -> str:
    """Tell how often the test rejects a method, by low-pass, and where most."""
    methods, filters, parameters = names
    m, pair = methods.index(method), [parameters.index("L"), parameters.index("Jt")]
    shares = 100 * np.array([[f.rejected[k, m, pair] for f in found] for k in range(len(filters))])
    means = [" / ".join(f"{x:.0f}" for x in share.mean(axis=0)) for share in shares]
    by_filter = [f"{mean} {describe_filter(name)}" for mean, name in zip(means, filters, strict=True)]
    k, case, j = np.unravel_index(shares.argmax(), shares.shape)
    period, noise = _rank_operator(found[case])
    most = f"{shares.max():.0f} % ({('L', 'Jt')[j]} {describe_filter(filters[k])} at {period} ms and {noise} %)"
    name = SHORT[method].replace("LS,", "least squares with")
    return f"It tells {name}, for L / Jt in % of the rapids, {', '.join(by_filter)}; at most {most}"


def _describe_instrument_cost(found: Sequence[Figures], names: Names) -> str:
    """Describe the loss of precision in ft and Cd by the instruments, compared with the likelihood."""
    methods, filters, parameters = names
    iv, ml = methods.index("instrumental_variables"), methods.index("maximum_likelihood")
    pair = [parameters.index("ft"), parameters.index("Cd")]
    times = [np.median([f.rms[k, iv, pair] / f.rms[k, ml, pair] for f in found]) for k in range(len(filters))]
    reported = join_words([f"{t:.1f} times {describe_filter(name)}" for t, name in zip(times, filters, strict=True)])
    return f"In ft and Cd their RMS error is, beside the likelihood's, {reported} (median)."


def _build_table(f: Figures, names: Names) -> list[str]:
    methods, filters, parameters = names
    rows = []
    for k, name in enumerate(filters):
        for j, parameter in enumerate(parameters):
            cells = [f"{f.rms[k, m, j]:.3g} ({f.bias[k, m, j]:+.2g})" for m in range(len(methods))]
            rows.append([name, parameter, *cells, f"{f.bound[j]:.3f}"])
    columns = ["low-pass", "", *(SHORT[n] for n in methods), "bound"]
    return [f"### {1e3 * f.period_s:g} ms, {100 * f.noise:g} % noise", "", *write_table(columns, rows), ""]


def draw_figure(found: Sequence[Figures], names: Names) -> Any:
    """Return the plot: above, by parameter at 1 ms and 0.5 %; below, over noise and period, and the bias of Jt."""
    from matplotlib.figure import Figure

    methods, filters, parameters = names
    drawing = Figure(figsize=(13, 7.5), layout="constrained")
    panels = drawing.subplots(2, 3)
    (middle,) = [f for f in found if f.period_s == 1e-3 and f.noise == 0.005]
    for k, name in enumerate(filters):
        ratios = middle.rms[k] / middle.bound
        _draw_lines(panels[0, k], range(len(parameters)), ratios.__getitem__, methods)
        panels[0, k].set_xticks(range(len(parameters)), parameters)
        panels[0, k].set_title(f"low-pass: {name} (1 ms, 0.5 % noise)")
        panels[0, k].set_ylim(0.7, 2000)
    by_noise = [f for f in found if f.period_s == 1e-3]
    by_period = [f for f in found if f.noise == 0.005]
    noises = [100 * f.noise for f in by_noise]
    _draw_lines(panels[1, 0], noises, lambda m: [compute_overall_error(f)[1, m] for f in by_noise], methods)
    _draw_lines(
        panels[1, 1],
        [1e3 * f.period_s for f in by_period],
        lambda m: [compute_overall_error(f)[1, m] for f in by_period],
        methods,
    )
    inertia = parameters.index("Jt")
    _draw_lines(panels[1, 2], noises, lambda m: [abs(f.bias[0, m, inertia]) for f in by_noise], methods)
    titles = (("over the noise (40 Hz, 1 ms)", "noise, %"), ("over the sampling period (40 Hz, 0.5 %)", "period, ms"),
              ("|bias| of Jt without a low-pass (1 ms)", "noise, %"))  # fmt: skip
    for panel, (title, label) in zip(panels[1], titles, strict=True):
        panel.set_title(title)
        panel.set_xlabel(label)
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
    panels[1, 0].set_xticks(noises)
    panels[1, 2].set_xticks(noises)
    panels[1, 1].set_xticks([1e3 * f.period_s for f in by_period])
    for panel in panels[1, :2]:
        panel.set_ylabel("RMS error / bound, mean of six")
        panel.set_ylim(0.9, 20)
    for panel in (*panels[0], *panels[1, :2]):
        panel.axhline(1.0, color="black", linewidth=0.8)
    panels[0, 0].set_ylabel("RMS error / bound")
    panels[1, 2].set_ylabel("% of the true value")
    drawing.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return drawing


def _draw_lines(panel: Any, at: Sequence[float], values: Callable[[int], Any], methods: Sequence[str]) -> None:
    """Draw one line per method; those that the product offers are bold."""
    bold = {"zero_forcing_1", "partial_moments", "instrumental_variables", "maximum_likelihood"}
    for m, name in enumerate(methods):
        reported = (
            {"linewidth": 2.2, "marker": "o"} if name in bold else {"linewidth": 1.0, "marker": ".", "linestyle": "--"}
        )
        panel.plot(at, values(m), label=SHORT[name], color=f"C{m}", **reported)
    panel.set_yscale("log")
    panel.grid(True, which="major", alpha=0.3)
