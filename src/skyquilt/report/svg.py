"""Small drawings: axes with round ticks, bars, lines, arrows. Colours come from classes of the
style sheet.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from skyquilt.report.numbers import decimals_of, fixed, nice

WIDTH = 520
HEIGHT = 340
LEFT, RIGHT, TOP, BOTTOM = 64, 14, 12, 46


def coordinate(value: float, decimals: int = 1) -> str:
    """A short number for an SVG attribute."""
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def polyline(points: ArrayLike, decimals: int = 1, *, close: bool = False) -> str:
    """Path data through points (k, 2)."""
    pairs = [
        f"{x:.{decimals}f} {y:.{decimals}f}" for x, y in np.asarray(points, np.float64).tolist()
    ]
    return f"M{'L'.join(pairs)}{'Z' if close else ''}" if len(pairs) > 1 else ""


def dots(points: ArrayLike, decimals: int = 1) -> str:
    """Path data of single points; round line caps draw them as discs of constant size on the
    screen.
    """
    return "".join(
        f"M{x:.{decimals}f} {y:.{decimals}f}h0" for x, y in np.asarray(points, np.float64).tolist()
    )


def arrows(
    tails: NDArray[Any],
    tips: NDArray[Any],
    decimals: int = 1,
    head: float = 0.28,
    longest: float = np.inf,
) -> str:
    """Path data of arrows (k, 2) -> (k, 2); arrow heads grow with the arrow up to `longest`."""
    along = tips - tails
    length = np.linalg.norm(along, axis=1, keepdims=True)
    keep = length[:, 0] > 0
    tails, tips, along, length = tails[keep], tips[keep], along[keep], length[keep]
    back = along / length * np.minimum(length * head, longest)
    side = np.stack([-back[:, 1], back[:, 0]], 1) * 0.5
    rows = np.hstack([tails, tips, tips - back + side, tips, tips - back - side]).tolist()
    shape = "M{:.%df} {:.%df}L{:.%df} {:.%df}M{:.%df} {:.%df}L{:.%df} {:.%df}L{:.%df} {:.%df}"
    shape %= (decimals,) * 10
    return "".join(shape.format(*row) for row in rows)


def path(d: str, cls: str) -> Markup:
    """A path with a class of the style sheet; nothing if it has no data."""
    return Markup('<path class="{}" d="{}"/>').format(cls, d) if d else Markup()


def text(x: float, y: float, words: str, cls: str = "", *, turn: int = 0) -> Markup:
    """Text at a position; classes `mid` and `end` align it."""
    turned = (
        Markup(' transform="rotate({} {} {})"').format(turn, coordinate(x), coordinate(y))
        if turn
        else ""
    )
    return Markup('<text x="{}" y="{}" class="{}"{}>{}</text>').format(
        coordinate(x), coordinate(y), cls, turned, words
    )


def line(x1: float, y1: float, x2: float, y2: float, cls: str) -> Markup:
    """A straight line."""
    return Markup('<path class="{}" d="M{} {}L{} {}"/>').format(
        cls, *(coordinate(v) for v in (x1, y1, x2, y2))
    )


def rect(x: float, y: float, width: float, height: float, cls: str, fill: str = "") -> Markup:
    """A rectangle, filled by its class or with its own colour."""
    own = Markup(' style="fill:{}"').format(fill) if fill else ""
    return Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"{}/>').format(
        cls, *(coordinate(v, 2) for v in (x, y, width, height)), own
    )


def drawing(
    content: Iterable[Markup | str],
    title: str,
    width: float = WIDTH,
    height: float = HEIGHT,
    left: float = 0,
) -> Markup:
    """A complete SVG element; `left` px of it are left of x = 0."""
    inner = Markup().join(content)
    return Markup('<svg viewBox="{} 0 {} {}" role="img" aria-label="{}">{}</svg>').format(
        coordinate(-left), coordinate(width), coordinate(height), title, inner
    )


@dataclass(frozen=True, kw_only=True)
class Axes:
    """A box with linear axes."""

    x: tuple[float, float]
    """Range of x, left to right."""
    y: tuple[float, float]
    """Range of y, bottom to top."""
    width: float = WIDTH
    """Width of the whole drawing in px."""
    height: float = HEIGHT
    """Height of the whole drawing in px."""
    left: float = LEFT
    """Space in px for the labels of y."""
    bottom: float = BOTTOM
    """Space in px for the labels of x."""

    def px(self, x: ArrayLike) -> NDArray[np.float64]:
        """Horizontal positions in px of the drawing."""
        span = self.width - self.left - RIGHT
        return self.left + (np.asarray(x, np.float64) - self.x[0]) / (self.x[1] - self.x[0]) * span

    def py(self, y: ArrayLike) -> NDArray[np.float64]:
        """Vertical positions in px of the drawing."""
        floor = self.height - self.bottom
        return floor - (np.asarray(y, np.float64) - self.y[0]) / (self.y[1] - self.y[0]) * (
            floor - TOP
        )

    def points(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Positions (k, 2) in px of the drawing."""
        pairs = np.asarray(xy, np.float64)
        return np.stack([self.px(pairs[:, 0]), self.py(pairs[:, 1])], 1)

    def grid(
        self,
        x_label: str = "",
        y_label: str = "",
        *,
        x_ticks: bool = True,
        unit: str = "",
        y_parts: float = 0,
    ) -> Markup:
        """Grid lines, tick labels and names of both axes."""
        floor, right = self.height - self.bottom, self.width - RIGHT
        parts = []
        for value, label in ticks(*self.y, y_parts or (floor - TOP) / 42):
            y = float(self.py(value))
            parts += [
                line(self.left, y, right, y, "grid"),
                text(self.left - 7, y + 4, label + unit, "tick end"),
            ]
        if x_ticks:
            for value, label in ticks(*self.x, (right - self.left) / 62):
                x = float(self.px(value))
                parts += [
                    line(x, floor, x, floor + 4, "axis"),
                    text(x, floor + 18, label, "tick mid"),
                ]
        parts.append(line(self.left, floor, right, floor, "axis"))
        if x_label:
            parts.append(text((self.left + right) / 2, self.height - 6, x_label, "name mid"))
        if y_label:
            parts.append(text(13, (TOP + floor) / 2, y_label, "name mid", turn=-90))
        return Markup().join(parts)

    def marker(self, x: float, label: str, level: int = 0) -> Markup:
        """A vertical line with a label beside it; `level` moves the label down by lines."""
        at, middle = float(self.px(x)), (self.left + self.width - RIGHT) / 2
        words = text(
            at + (6 if at < middle else -6),
            TOP + 11 + 16 * level,
            label,
            "mark" if at < middle else "mark end",
        )
        return line(at, TOP, at, self.height - self.bottom, "marker") + words


def ticks(low: float, high: float, parts: float) -> list[tuple[float, str]]:
    """Round values between two bounds with their labels."""
    low, high = min(low, high), max(low, high)
    step = nice(high - low, max(2.0, parts))
    first, last = int(np.ceil(low / step - 1e-6)), int(np.floor(high / step + 1e-6))
    return [
        (k * step, fixed(k * step, decimals_of(step)))
        for k in range(first, min(last, first + 40) + 1)
    ]


def bars(
    edges: Sequence[float] | NDArray[Any],
    counts: ArrayLike,
    *,
    title: str,
    x_label: str,
    y_label: str,
    marks: Sequence[tuple[float, str]] = (),
    unit: str = "",
) -> Markup:
    """A histogram: counts (n,) between edges (n + 1,)."""
    counts = np.asarray(counts, np.float64)
    axes = Axes(
        x=(float(edges[0]), float(edges[-1])), y=(0.0, float(counts.max(initial=0)) * 1.12 or 1.0)
    )
    x, y, floor = axes.px(edges), axes.py(counts), axes.height - axes.bottom
    boxes = [
        rect(x[k] + 0.5, y[k], max(x[k + 1] - x[k] - 1, 0.5), floor - y[k], "bar")
        for k in np.flatnonzero(counts)
    ]
    lines = [
        axes.marker(value, label, k) for k, (value, label) in enumerate(marks) if value <= edges[-1]
    ]
    return drawing([axes.grid(x_label, y_label, unit=unit), *boxes, *lines], title)


def columns(
    labels: Sequence[str],
    shares: ArrayLike,
    colours: Sequence[str],
    *,
    title: str,
    x_label: str,
    y_label: str,
) -> Markup:
    """One column per label, with its share in percent above it."""
    shares = np.asarray(shares, np.float64)
    axes = Axes(
        x=(0.0, float(len(labels))), y=(0.0, max(float(shares.max(initial=0)) * 1.18, 1e-9))
    )
    parts = [axes.grid(x_label, y_label, x_ticks=False, unit="\u202f%")]
    floor, step = axes.height - axes.bottom, float(axes.px(1) - axes.px(0))
    for k, (label, share, colour) in enumerate(zip(labels, shares.tolist(), colours, strict=True)):
        y, x = float(axes.py(share)), float(axes.px(k))
        parts.append(rect(x + step * 0.08, y, step * 0.84, floor - y, "column", colour))
        parts.append(text(x + step / 2, floor + 18, label, "tick mid"))
        if share > 0:
            parts.append(
                text(x + step / 2, y - 5, f"{share:.0f}" if share >= 1 else "<1", "value mid")
            )
    return drawing(parts, title)


def colour_bar(stops: Sequence[str], low: str, high: str, name: str) -> Markup:
    """A horizontal colour scale with labels at its ends and its name."""
    n = len(stops)
    boxes = "".join(
        f'<rect x="{k * 240 / n:.1f}" width="{240 / n + 0.5:.1f}" height="12" fill="{c}"/>'
        for k, c in enumerate(stops)
    )
    words = (
        text(0, 28, low, "tick") + text(240, 28, high, "tick end") + text(120, 28, name, "name mid")
    )
    return (
        Markup('<svg class="scale" viewBox="0 0 240 34" role="img" aria-label="{}">').format(
            f"{name}: {low} to {high}"
        )
        + Markup(boxes)
        + words
        + Markup("</svg>")
    )
