"""The zoo's page: what is believed, whether intervals contain the truth, what was predicted and what the table got."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from studies import pages
from studies.pages import wrap_paragraph, write_table

SURE_95 = 1.96
WRONG_DEVIATIONS, WRONG_SHARE = 4.0, 0.03  # beyond both a validated parameter is wrong and confident
NAMES = ("R", "L", "K", "Jt", "ft", "Cd")
HARM_UM = 1.0
MOST_PROMISED = 1.5
SHOWN_SHARE = 9.99
Figures = Sequence[Mapping[str, Any]]


def page(run: pages.Run, figures: Figures) -> str:
    """Return the study's page."""
    axes = [axis for machine in figures for axis in machine["axes"].values()]
    sent = [m["correction"] for m in figures if not m["correction"]["refused"]]
    moves, accepted = sum(a["moves"] for a in axes), sum(a["believed"] for a in axes)
    kept = sum(_compare_predicted_gain(c) <= MOST_PROMISED for c in sent)
    harmed = [c["worse_um"] for c in sent if c["worse_um"] > HARM_UM]
    wrong = [name for m in figures if (name := _list_wrong_parameters(m))]
    lines = pages.write_head("A zoo of machines by an independent hand", "zoo", run)
    lines += wrap_paragraph(
        f"""{len(figures)} machines of two axes: {accepted} of {moves} recorded moves and
        {sum(a["pool"] for a in axes)} of {len(axes)} pools are validated. {len(wrong)} machines are wrong and confident
        (a validated parameter off by more than {WRONG_DEVIATIONS:g} standard deviations and
        {100 * WRONG_SHARE:g} %). {len(sent)} corrections are not refused: the predicted gain is at most
        {MOST_PROMISED} times the gain at the table in {kept} of them, and a position gets worse by more than
        {HARM_UM:g} um in {len(harmed)}, by {max(harmed, default=0.0):.1f} um at most."""
    )
    lines += ["## Each machine", ""]
    names = [
        "machine",
        "moves",
        "pools",
        "wrong and confident",
        "contour RMS, um",
        "predicted gain",
        "gain",
        "worst, um",
    ]
    lines += [
        *write_table(
            [*names, "why refused"], [_format_row(kind, list(each)) for kind, each in _group_by_kind(figures)]
        ),
        "",
    ]
    lines += wrap_paragraph(
        """Gains and worst positions are of each machine of the kind in turn; in brackets: refused, cut all the same
        with the median of the refused windows."""
    )
    lines += ["## 95 % intervals that contain the truth", ""]
    rows = [
        [name, _describe_coverage(_describe_pools(axes), name), _describe_coverage(_describe_windows(axes), name)]
        for name in NAMES
    ]
    lines += [*write_table(["", "validated pools", "validated moves"], rows), ""]
    lines += ["## Other methods on the same recordings", "", *_build_peer_table(axes)]
    return "\n".join(lines)


def _group_by_kind(figures: Figures) -> Iterable[tuple[str, Iterable[Mapping[str, Any]]]]:
    return groupby(figures, key=lambda machine: str(machine["kind"]))


def _compare_predicted_gain(correction: Mapping[str, Any]) -> float:
    """Return the predicted gain over that at the table."""
    return float(correction["gain"] / _format_gain(correction))


def _format_gain(correction: Mapping[str, Any]) -> float:
    return float(correction["got"][0] / correction["got"][1])


def _list_wrong_parameters(machine: Mapping[str, Any]) -> list[str]:
    """Return the parameters of validated pools that are off beyond their intervals, and by more than matters."""
    return [
        f"{name} of {axis} {100 * error[0]:+.0f} %, {abs(error[1]):.0f} deviations"
        for axis, found in machine["axes"].items()
        if found["pool"]
        for name, error in found["errors"].items()
        if error is not None and abs(error[0]) > WRONG_SHARE and abs(error[1]) > WRONG_DEVIATIONS
    ]


def _format_row(kind: str, machines: Figures) -> list[str]:
    axes = [axis for machine in machines for axis in machine["axes"].values()]
    cuts = [(m["correction"], m["with_refused"]) for m in machines]
    reasons = [reason for m in machines for reason in m["correction"]["refused"] if reason != "NoModel"]
    reasons += [reason for axis in axes if not axis["pool"] for reason in axis["reasons"][:2] or axis["pool_reasons"]]
    return [
        kind,
        f"{sum(a['believed'] for a in axes)}/{sum(a['moves'] for a in axes)}",
        f"{sum(a['pool'] for a in axes)}/{len(axes)}",
        "; ".join(text for m in machines for text in _list_wrong_parameters(m)) or "-",
        ", ".join(_format_cell(c, r, lambda one: f"{one['got'][0]:.1f} -> {one['got'][1]:.1f}") for c, r in cuts),
        ", ".join(_format_cell(c, r, lambda one: f"{one['gain']:.1f}") for c, r in cuts),
        ", ".join(_format_cell(c, r, lambda one: f"{_format_gain(one):.1f}") for c, r in cuts),
        ", ".join(_format_cell(c, r, lambda one: f"{one['worse_um']:.1f}") for c, r in cuts),
        ", ".join(dict.fromkeys(reasons)) or "-",
    ]


def _format_cell(correction: Mapping[str, Any], refused: Mapping[str, Any] | None, show: Any) -> str:
    if not correction["refused"]:
        return str(show(correction))
    return f"({show(refused)})" if refused is not None and refused.get("got") else "-"


def _describe_pools(axes: Figures) -> list[Mapping[str, Any]]:
    return [axis["errors"] for axis in axes if axis["pool"]]


def _describe_windows(axes: Figures) -> list[Mapping[str, Any]]:
    return [errors for axis in axes for errors in axis["window_errors"]]


def _describe_coverage(found: Sequence[Mapping[str, Any]], name: str) -> str:
    values = [abs(errors[name][1]) for errors in found if errors[name] is not None]
    return f"{100 * np.mean(np.array(values) < SURE_95):.0f} % of {len(values)}" if values else "-"


def _build_peer_table(axes: Figures) -> list[str]:
    """Return the table of median and largest errors of every method that was installed."""
    methods = list(axes[0]["peers"])
    given = [
        {name: error[0] for name, error in errors.items() if error is not None} for errors in _describe_pools(axes)
    ]
    tables: dict[str, list[Mapping[str, Any]]] = {"fdhil, validated pools": list(given)}
    tables |= {method: [axis["peers"][method] for axis in axes] for method in methods}
    rows = [
        [method, str(len(each)), *(_format_errors(each, name) for name in NAMES)] for method, each in tables.items()
    ]
    text = wrap_paragraph(
        f"""Median and ninth decile of the error's size in %. The other methods take every recording and refuse none;
        installed were {pages.join_words(methods)}."""
    )
    return [*text, *write_table(["method", "axes", *NAMES], rows)]


def _format_errors(each: Sequence[Mapping[str, Any]], name: str) -> str:
    values = np.array([abs(one[name]) for one in each if one.get(name) is not None])
    if not values.size:
        return "-"
    shown = np.quantile(values, (0.5, 0.9))
    return " / ".join(f">{100 * SHOWN_SHARE:.0f}" if v > SHOWN_SHARE else f"{100 * v:.1f}" for v in shown)
