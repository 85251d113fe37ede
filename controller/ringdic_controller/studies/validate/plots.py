"""Plots of the findings beside the paper's figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from ringdic.arrays import Floats

from ringdic_controller.studies.validate.figures import BETTER, PAPER, Findings

_COLOURS = {PAPER: "#c4581d", BETTER: "#1d6ec4"}
_PARAMETERS = ("fx, px", "fy, px", "skew, px", "cx, px", "cy, px", "k1", "k2", "p1", "p2", "k3")
_GREY = "#666666"


def draw(folder: Path, findings: Mapping[str, Findings]) -> dict[str, Path]:
    """Draw a PNG picture for each experiment of `_PLOTS` that was run; returns the paths by title."""
    drawn: dict[str, Path] = {}
    for name, (title, plot) in _PLOTS.items():
        if name not in findings:
            continue
        picture = Picture(figsize=(11, 4.2), layout="constrained")
        plot(picture, findings[name])
        picture.suptitle(title)
        drawn[title] = folder / f"{name}.png"
        picture.savefig(drawn[title], dpi=110)
    return drawn


def _table_1(picture: Picture, findings: Findings) -> None:
    axes = picture.subplots(2, 5)
    truth = findings.curves["true"]
    for k, (name, each) in enumerate(zip(_PARAMETERS, axes.ravel(), strict=True)):
        for way in _ways(findings.curves):
            each.plot(findings.curves[way][:, k] - truth[:, k], "o", ms=3, color=_COLOURS[way], label=way)
        each.axhline(0, color=_GREY, lw=0.8)
        each.set_title(f"{name}, measured − true", fontsize=8)
        each.tick_params(labelsize=7)
    axes[0, 0].legend(fontsize=7)


def _table_2(picture: Picture, findings: Findings) -> None:
    axes = picture.subplots()
    for k, way in enumerate(_ways(findings.curves["rms"])):
        values = np.array(findings.curves["rms"][way])
        axes.bar(0.8 + np.arange(len(values)) + 0.4 * k, 1000 * values, 0.4, color=_COLOURS[way], label=way)
    _paper(axes, 47.0, "paper: 47 µm", horizontal=True)
    axes.set(xlabel="camera pair", ylabel="RMS of the control points, µm", yscale="log")
    axes.legend()


def _figure_6(picture: Picture, findings: Findings) -> None:
    axes = picture.subplots()
    values = {way: 1000 * np.array(findings.curves["residuals"][way]) for way in _ways(findings.curves["residuals"])}
    _histogram(axes, values)
    _paper(axes, 17.0, "paper: RMS 17 µm")
    axes.set(xlabel="control points after 5 mm, superimposed: distance, µm", ylabel="share")


def _diameter(picture: Picture, findings: Findings) -> None:
    axes = picture.subplots()
    values = {way: 2000 * (findings.curves[way]["radii"] - 57.0) for way in _ways(findings.curves)}
    _histogram(axes, values)
    _paper(axes, -70.0, "paper: −70 ± 270 µm")
    axes.set(xlabel="diameter of each point − 114 mm, µm", ylabel="share")


def _figure_7a(picture: Picture, findings: Findings) -> None:
    axes = picture.subplots()
    _histogram(axes, {way: 1000 * findings.curves[way] for way in _ways(findings.curves)})
    _paper(axes, 60.0, "paper: 60 ± 30 µm")
    axes.set(xlabel="the same point from two pairs: distance, µm", ylabel="share")


def _figure_7b(picture: Picture, findings: Findings) -> None:
    left, right = picture.subplots(1, 2)
    for way in _ways(findings.curves):
        each = findings.curves[way]
        steps = 1 + np.arange(len(each["mean"]))
        for k, (name, style) in enumerate(zip("xyz", ("o-", "s--", "^:"), strict=True)):
            mean, std = 1000 * each["mean"][:, k], 1000 * each["std"][:, k]
            place = steps + 0.08 * (k - 1)
            left.errorbar(place, mean, std, fmt=style, ms=3, lw=1, color=_COLOURS[way], label=f"{way}, {name}")
        right.plot(steps, each["strain"][:, 0], "o-", ms=3, color=_COLOURS[way], label=f"{way}, median")
        right.plot(steps, each["strain"][:, 1], "^--", ms=3, color=_COLOURS[way], label=f"{way}, 95 %")
    _paper(right, 1e-3, "paper: about 1e-3", horizontal=True)
    left.set(xlabel="step of 0.1 mm", ylabel="displacement − true, mean ± STD, µm", title="paper: about 10 µm")
    right.set(xlabel="step of 0.1 mm", ylabel="|E|, true 0", yscale="log")
    left.legend(fontsize=7)
    right.legend(fontsize=7)


def _figure_9(picture: Picture, findings: Findings) -> None:
    ways = _ways(findings.curves)
    axes = picture.subplots(1, len(ways) + 1, width_ratios=[2] * len(ways) + [1.3])
    for way, each in zip(ways, axes[:-1], strict=True):
        curves = findings.curves[way]
        shown = each.scatter(
            np.degrees(curves["theta"]) % 360, curves["z"], c=1000 * curves["error"], s=0.5, vmin=0, vmax=15,
            cmap="viridis", rasterized=True,
        )  # fmt: skip
        each.set(title=f"{way}: error of the last displacement, µm", xlabel="angle, degrees", ylabel="height, mm")
        each.title.set_fontsize(9)
        picture.colorbar(shown, ax=each)
    for way in ways:
        values = 1000 * np.array(findings.curves[way]["displacement"])
        axes[-1].plot(1 + np.arange(len(values)), values, "o-", color=_COLOURS[way], label=way)
    axes[-1].set(xlabel="step", ylabel="displacement error, RMS, µm", ylim=(0, None))
    axes[-1].legend(fontsize=7)


def _spoilt(picture: Picture, findings: Findings) -> None:
    ways = _ways(findings.curves["lost"])
    grid = findings.curves["grid"]
    extent = (0.0, 360.0, float(grid.z.min()), float(grid.z.max()))
    axes = picture.subplots(1, len(ways) + 1)
    state = np.where(findings.curves["blind"], 2, np.where(findings.curves["hit"], 1, 0))
    pictures = {"spoilt in a view (1), too few views left (2)": state}
    pictures |= {f"lost, {way}": findings.curves["lost"][way] for way in ways}
    for each, (title, values) in zip(axes, pictures.items(), strict=True):
        each.imshow(values, origin="lower", extent=extent, aspect="auto", cmap="magma_r", interpolation="nearest")
        each.set(title=title, xlabel="angle, degrees", ylabel="height, mm")
        each.title.set_fontsize(9)


def _ways(curves: Mapping[str, Any]) -> list[str]:
    return [way for way in _COLOURS if way in curves]


def _histogram(axes: Axes, values: Mapping[str, Floats]) -> None:
    finite = {way: each[np.isfinite(each)] for way, each in values.items()}
    low = min(float(np.percentile(each, 0.5)) for each in finite.values())
    high = max(float(np.percentile(each, 99.5)) for each in finite.values())
    for way, each in finite.items():
        weights = np.full(len(each), 1.0 / len(each))
        label = f"{way}: {each.mean():+.1f} ± {each.std():.1f}"
        axes.hist(
            each,
            np.linspace(low, high, 80).tolist(),
            weights=weights,
            histtype="step",
            color=_COLOURS[way],
            label=label,
        )
    axes.legend()


def _paper(axes: Axes, value: float, label: str, horizontal: bool = False) -> None:
    line = axes.axhline if horizontal else axes.axvline
    line(value, color=_GREY, ls=":", label=label)
    axes.legend()


_PLOTS: dict[str, tuple[str, Callable[[Picture, Findings], None]]] = {
    "table_1": ("Table 1: intrinsics of the twelve cameras", _table_1),
    "table_2": ("Table 2: reconstruction of the control points", _table_2),
    "figure_6": ("Fig. 6: the target moved by 5 mm", _figure_6),
    "diameter": ("The cylinder of 114.00 mm", _diameter),
    "figure_7a": ("Fig. 7a: merging", _figure_7a),
    "figure_7b": ("Fig. 7b: steps of 0.1 mm", _figure_7b),
    "figure_9": ("Fig. 9: the deforming limb", _figure_9),
    "spoilt": ("The limb in spoilt images", _spoilt),
}
