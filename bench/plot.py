"""A picture of the ratios: every figure that has an alternative, beside its bar."""

from __future__ import annotations

from pathlib import Path

from bench.report import Row, ratio_text

OURS, BAR, MISSED = "#2f7d6d", "#555555", "#b3412e"


def plot(rows: list[Row], path: Path) -> None:
    """Draw ours in parts of the alternative's, on a logarithmic axis, as SVG.

    :param rows: only those with a bar for the ratio are drawn
    """
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "bench", "svg.fonttype": "none", "font.size": 9})
    from matplotlib import pyplot

    drawn = [row for row in rows if row.ratio and row.ratio_bar is not None][::-1]
    figure, axes = pyplot.subplots(figsize=(9, 0.36 * len(drawn) + 1.2), layout="constrained")
    for at, row in enumerate(drawn):
        ratio, bar = row.ratio, row.ratio_bar
        assert ratio is not None and bar is not None
        axes.plot([ratio, 1], [at, at], color=OURS if row.met else MISSED, linewidth=7, solid_capstyle="butt")
        axes.plot([bar, bar], [at - 0.38, at + 0.38], color=BAR, linewidth=2)
        axes.annotate(
            ratio_text(ratio),
            (min(ratio, 1, bar), at),
            xytext=(-5, 0),
            textcoords="offset points",
            ha="right",
            va="center",
        )
    axes.axvline(1, color="#999999", linewidth=0.8)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}" if value >= 1 else f"1/{1 / value:g}")
    axes.set_ylim(-0.8, len(drawn) - 0.2)
    axes.set_xlim(min([row.ratio or 1 for row in drawn], default=0.1) / 4, 6)
    axes.set_yticks(range(len(drawn)), [f"{row.what}\nagainst {row.against}" for row in drawn], fontsize=7)
    axes.set_xlabel("ours in parts of the alternative's (less is better); upright lines are the bars")
    axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})
    pyplot.close(figure)
