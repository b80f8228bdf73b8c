"""Reads figures that may be absent, and formats them for readers."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

MINUS, THIN, DASH = "\u2212", "\u202f", "\u2013"


def number(value: Any) -> float | None:
    """A finite float, or None for everything else (absent, NaN, text, true/false)."""
    if value is None or isinstance(value, (bool, str)):
        return None
    try:
        result = float(value)
    except (TypeError, ValueError):
        return None
    return result if math.isfinite(result) else None


def axes(value: Any) -> tuple[float | None, float | None, float | None]:
    """Figures for x, y and z from a mapping or a sequence."""
    if isinstance(value, Mapping):
        return number(value.get("x")), number(value.get("y")), number(value.get("z"))
    if isinstance(value, Sequence) and not isinstance(value, str):
        x, y, z = [number(v) for v in (*value, None, None, None)][:3]
        return x, y, z
    return None, None, None


def mapping(value: Any) -> Mapping[str, Any]:
    """The value if it is a mapping, else an empty one."""
    return value if isinstance(value, Mapping) else {}


def items(value: Any) -> tuple[Any, ...]:
    """The value's items if it is a list, a string as the only item, else nothing."""
    if isinstance(value, str):
        return (value,)
    return tuple(value) if isinstance(value, Sequence) else ()


def fixed(value: Any, decimals: int = 2, *, sign: bool = False) -> str:
    """`1 234.50` with a true minus sign and thin spaces between thousands; a dash where there is no
    figure.
    """
    figure = number(value)
    if figure is None:
        return DASH
    text = f"{abs(figure):,.{decimals}f}".replace(",", THIN)
    zero = not any(c in text for c in "123456789")
    if zero:
        return text
    return (MINUS if figure < 0 else "+" if sign else "") + text


def significant(value: Any, digits: int = 3, *, sign: bool = False) -> str:
    """A figure with `digits` significant digits, never in powers of ten between 1e-6 and 1e9."""
    figure = number(value)
    if figure is None:
        return DASH
    if figure == 0:
        return "0"
    exponent = math.floor(math.log10(abs(figure)))
    if not -6 <= exponent < 9:
        return f"{figure:.{digits - 1}e}".replace("-", MINUS)
    return fixed(figure, max(0, digits - 1 - exponent), sign=sign)


def plain(value: Any) -> str:
    """Any value of the metrics or settings as text."""
    if value is None:
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {plain(part)}" for key, part in value.items())
    if isinstance(value, Sequence):
        return ", ".join(plain(part) for part in value)
    figure = number(value)
    if figure is None:
        return str(value)
    return fixed(figure, 0) if figure == int(figure) else significant(figure, 4)


def seconds(value: Any) -> str:
    """`0.42 s`, `12.3 s`, `4 min 05 s`, `2 h 03 min`."""
    figure = number(value)
    if figure is None:
        return DASH
    if figure < 99.95:
        return f"{figure:.2f} s" if figure < 9.995 else f"{figure:.1f} s"
    minutes, rest = divmod(round(figure), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def count(n: float, noun: str, plural: str = "") -> str:
    """`1 photo`, `18 photos`."""
    return f"{fixed(n, 0)} {noun if n == 1 else plural or noun + 's'}"


def nice(span: float, parts: float) -> float:
    """A round step (1, 2, 5 times a power of ten) that divides the span into about `parts`
    parts.
    """
    raw = span / max(parts, 1e-9)
    if not math.isfinite(raw) or raw <= 0:
        return 1.0
    base = 10.0 ** math.floor(math.log10(raw))
    return next((f * base for f in (1.0, 2.0, 5.0) if raw <= f * base * 1.0001), 10.0 * base)


def decimals_of(step: float) -> int:
    """Number of decimals needed to distinguish multiples of a round step."""
    return max(0, -math.floor(math.log10(step) + 1e-9)) if step > 0 else 0
