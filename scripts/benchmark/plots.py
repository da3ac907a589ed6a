#!/usr/bin/env python3
"""Draws the plots of docs/benchmarks.md as SVG files, from the CSV files in the same folder.

    python3 scripts/benchmark/plots.py docs/benchmarks

One small plot per model: PSNR against processor time (error_against_time.svg), against the part of the Gaussians that
stays (equal_count.svg), and by stage (ablation.svg). Needs only the standard library.
"""

import html
import math
import sys
from pathlib import Path

import measuring
from measuring import read_results

WIDTH, HEIGHT, COLUMNS = 300, 220, 3
LEFT, RIGHT, TOP, BOTTOM = 40, 10, 26, 34
# Colors that people with color blindness tell apart, in the order of the curves.
COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#999999", "#f0e442"]
STYLE = (
    "text{font:11px sans-serif;fill:#222}.title{font-weight:bold}.axis{stroke:#888;fill:none}.grid{stroke:#ddd}"
    ".curve{fill:none;stroke-width:1.8}"
)


def ticks(low, high, wanted=4):
    """Returns about `wanted` round numbers from `low` to `high`, for the labels of an axis."""
    step = 10 ** math.floor(math.log10((high - low) / wanted))
    step *= next(factor for factor in (1, 2, 5, 10) if (high - low) / (step * factor) <= wanted + 1)
    first = math.ceil(low / step)
    return [round(k * step, 6) for k in range(first, math.floor(high / step) + 1)]


def log_ticks(low, high):
    """Returns 1, 2 and 5 times the powers of ten from `low` to `high`."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [factor * 10.0**power for power in powers for factor in (1, 2, 5) if low <= factor * 10.0**power <= high]


def number(value):
    return f"{value:g}"


class Panel:
    """One plot: curves of points (x, y), x on a logarithmic scale."""

    def __init__(self, title, curves, x_label, x_text=number, x_ticks=None):
        self.title, self.curves, self.x_label, self.x_text, self.x_ticks = title, curves, x_label, x_text, x_ticks

    def svg(self, colors):
        points = [point for points in self.curves.values() for point in points]
        xs, ys = [x for x, _ in points], [y for _, y in points]
        low, high = math.log(min(xs)) - 0.1, math.log(max(xs)) + 0.1
        bottom, top = min(ys) - 1, max(ys) + 1
        right, base = WIDTH - RIGHT, HEIGHT - BOTTOM

        def across(x):
            return LEFT + (math.log(x) - low) / (high - low) * (right - LEFT)

        def up(y):
            return base - (y - bottom) / (top - bottom) * (base - TOP)

        out = [f'<text class="title" x="{LEFT}" y="16">{html.escape(self.title)}</text>']
        for y in ticks(bottom, top):
            out.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{up(y):.1f}" y2="{up(y):.1f}"/>')
            out.append(f'<text x="{LEFT - 5}" y="{up(y) + 4:.1f}" text-anchor="end">{number(y)}</text>')
        for x in self.x_ticks or log_ticks(math.exp(low), math.exp(high)):
            out.append(f'<text x="{across(x):.1f}" y="{base + 14}" text-anchor="middle">{self.x_text(x)}</text>')
        out.append(f'<path class="axis" d="M{LEFT} {TOP}V{base}H{right}"/>')
        out.append(f'<text x="{right}" y="{base + 28}" text-anchor="end">{html.escape(self.x_label)}</text>')
        out.append(f'<text x="{right}" y="16" text-anchor="end">PSNR, dB</text>')
        for name, points in self.curves.items():
            color = colors[name]
            if len(points) > 1:
                path = " ".join(f"{across(x):.1f},{up(y):.1f}" for x, y in sorted(points))
                out.append(f'<polyline class="curve" stroke="{color}" points="{path}"/>')
            out += [f'<circle cx="{across(x):.1f}" cy="{up(y):.1f}" r="3" fill="{color}"/>' for x, y in points]
        return "".join(out)


def write(name, panels, heading):
    """Writes the panels side by side, with one legend below."""
    names = list(dict.fromkeys(curve for panel in panels for curve in panel.curves))
    colors = dict(zip(names, COLORS))
    lines = math.ceil(len(panels) / COLUMNS)
    legend = math.ceil(len(names) / COLUMNS)
    width, height = COLUMNS * WIDTH, lines * HEIGHT + 18 * legend + 12
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" aria-label="{html.escape(heading)}">']
    out.append(f'<style>{STYLE}</style><rect width="100%" height="100%" fill="#fff"/>')
    for k, panel in enumerate(panels):
        out.append(f'<g transform="translate({k % COLUMNS * WIDTH} {k // COLUMNS * HEIGHT})">{panel.svg(colors)}</g>')
    for k, curve in enumerate(names):
        x, y = 40 + k % COLUMNS * WIDTH, lines * HEIGHT + 14 + 18 * (k // COLUMNS)
        out.append(f'<circle cx="{x}" cy="{y - 4}" r="4" fill="{colors[curve]}"/>')
        out.append(f'<text x="{x + 10}" y="{y}">{html.escape(curve)}</text>')
    out.append("</svg>\n")
    (measuring.RESULTS / f"{name}.svg").write_text("\n".join(out))


def curves_by_model(rows, curve, x, keep=lambda row: True):
    """Returns, for each model, the points (x, PSNR) of each curve."""
    found = {}
    for row in filter(keep, rows):
        found.setdefault(row["model"], {}).setdefault(curve(row), []).append((x(row), float(row["psnr_db"])))
    return found


def percent(row):
    return float(row["kept"].rstrip("%"))


def error_against_time():
    labels = {"effort": "--effort fast, default, best", "steps": "default with 150 to 3000 steps"}
    rows = read_results("error_against_time")
    found = curves_by_model(rows, lambda row: labels.get(row["curve"], row["setting"]), lambda row: float(row["processor_s"]))
    panels = [Panel(model, curves, "processor seconds") for model, curves in found.items()]
    write("error_against_time", panels, "PSNR on test views against processor seconds of whole runs, one plot per model")


def equal_count():
    shown = ["default", "no-refine", "visible", "paper", "opacity", "scale", "random"]
    found = curves_by_model(read_results("equal_count"), lambda row: row["method"], percent, lambda row: row["method"] in shown)
    panels = [
        Panel(model, curves, "Gaussians kept", lambda x: f"{x:g}%", sorted({x for x, _ in curves["default"]}))
        for model, curves in found.items()
    ]
    write("equal_count", panels, "PSNR on test views against the part of the Gaussians that stays, one plot per model")


def ablation():
    found = curves_by_model(read_results("ablation"), lambda row: row["setting"], percent, shown_in_ablation)
    panels = [
        Panel(model, curves, "Gaussians kept", lambda x: f"{x:g}%", sorted({x for x, _ in curves["default"]}))
        for model, curves in found.items()
    ]
    write("ablation", panels, "PSNR on test views with one stage after the other, one plot per model")


def shown_in_ablation(row):
    """Returns whether a row is a stage whose curve can be told apart from the others."""
    like_default = ["exact field", "every SH degree", "as archive"]
    like_default += ["rounds of 48 views", "no views outside the rig", "without validation"]
    return row["kind"] == "stage" and row["setting"] not in [f"default, {name}" for name in like_default]


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    measuring.RESULTS = Path(sys.argv[1])
    for name, draw in {"error_against_time": error_against_time, "equal_count": equal_count, "ablation": ablation}.items():
        if (measuring.RESULTS / f"{name}.csv").exists():
            draw()


if __name__ == "__main__":
    main()
