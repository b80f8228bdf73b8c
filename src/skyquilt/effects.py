"""Options without effect are refused: who gives one believes in what it does.

A rule names settings, and says of all settings together why these do nothing. Rules of a mosaic
are here, those of single commands in `cli/idle.py`.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from skyquilt import registry
from skyquilt.errors import UsageError

Values = Mapping[str, Any]
BY_PIXELS = ("ncc", "phase", "ecc", "mi")
"""Estimators that register pixels; the others estimate from matches of features."""
FLIGHTLINE_FEATURES = 4000
"""Least number of features for which the thresholds of method `flightline` are defined."""
OPTION_OF = {
    "detector": "detector",
    "matcher": "matcher",
    "estimator": "estimator",
    "transform": "transform",
    "distortion": "distortion",
    "height_m": "height",
    "surface": "surface",
    "dtm": "dtm",
    "contours_m": "contours",
    "repair": "trust-metadata",
    "seed": "seed",
    "relief_m": "relief",
    "levelled": "levelled",
    "image_search": "image-search",
    "optimiser": "optimiser",
    "lines": "lines",
    "heading_deg": "heading",
    "vertical_datum": "vertical-datum",
    "feather_px": "feather",
}
"""Setting -> option (without `--`) where it is not the same word."""
OF_METHODS = tuple(name for name in OPTION_OF if name != "feather_px")
"""Settings that some methods of alignment do not take; the rows of `registry` say which."""


@dataclass(frozen=True, kw_only=True)
class Rule:
    """When some settings have no effect."""

    settings: tuple[str, ...]
    """Their names."""
    idle: Callable[[Values], str]
    """Why they do nothing beside these other settings; empty where they do."""


def refuse_idle(rules: Iterable[Rule], values: Values, asked: Collection[str]) -> None:
    """Refuses the first of the settings that were `asked` for and have no effect.

    Raises:
        UsageError: the sentence says why.
    """
    for rule in rules:
        for name in rule.settings:
            if name in asked and (why := rule.idle(values)):
                raise UsageError(f"--{option_of(name)} would have no effect: {why}")


def option_of(setting: str) -> str:
    """The option of a setting, without `--`."""
    return OPTION_OF.get(setting, setting.replace("_", "-"))


def refuse_untaken(values: Values, asked: Collection[str]) -> None:
    """Refuses settings that the method of alignment does not take.

    Raises:
        UsageError: the sentence says which methods do, or which words this one takes.
    """
    method = values["method"]
    takes = registry.row("alignment", method).takes
    for setting in OF_METHODS:
        option, value = OPTION_OF[setting], values[setting]
        if setting not in asked:
            continue
        if option not in takes:
            others = [n for n in registry.names("alignment") if taken(n, setting)]
            raise UsageError(
                f"--{option} is for --method {' or '.join(others)}; the method here is {method}"
            )
        if takes[option] and value not in takes[option]:
            raise UsageError(
                f"--method {method} takes --{option} {', '.join(takes[option])}, not {value}"
            )


def taken(method: str, setting: str) -> bool:
    """Whether a method of alignment takes a setting."""
    takes = registry.row("alignment", method).takes
    return setting not in OF_METHODS or OPTION_OF[setting] in takes


def blend_of(values: Values) -> str:
    """How photos are blended."""
    automatic = "average" if values["method"] == "flightline" else "feather"
    return automatic if values["blend"] == "auto" else str(values["blend"])


def _blends(values: Values) -> str:
    blend = blend_of(values)
    return "" if blend == "feather" else f"--blend {blend} has no seams of a width"


def _lossless(values: Values) -> str:
    compress = values["compress"]
    return "" if compress in ("auto", "jpeg") else f"--compress {compress} is lossless"


def _pixels(values: Values) -> str:
    by = values["estimator"]
    return f"--estimator {by} compares pixels" if by in BY_PIXELS else ""


def _trusted(values: Values) -> str:
    method = values["method"]
    if values["repair"] or method not in ("position", "pose", "hybrid"):
        return ""
    return f"with --trust-metadata, method {method} compares no photos"


def _unlevelled(values: Values) -> str:
    return "" if values["levelled"] else "with --no-levelled no dominant plane is looked for"


def _sure(values: Values) -> str:
    if values["method"] == "hybrid" and values["optimiser"] != "anneal":
        return f"--optimiser {values['optimiser']} leaves nothing to chance; anneal does"
    return _pixels(values)


def _few(values: Values) -> str:
    few = values["method"] == "flightline" and values["features"] < FLIGHTLINE_FEATURES
    return f"method flightline takes at least {FLIGHTLINE_FEATURES}" if few else ""


def _high(values: Values) -> str:
    if values["method"] == "bundle" and values["matcher"] != "guided":
        return "method bundle finds heights; only --matcher guided asks for one"
    return ""


def _shared_out(values: Values) -> str:
    return "" if values["scheduler"] is None else "--scheduler says who works"


MOSAIC = (
    Rule(settings=("feather_px",), idle=_blends),
    Rule(settings=("quality",), idle=_lossless),
    Rule(settings=("detector", "matcher", "features"), idle=_trusted),
    Rule(settings=("estimator",), idle=_trusted),
    Rule(settings=("detector", "matcher", "features", "levelled", "relief_m"), idle=_pixels),
    Rule(settings=("relief_m",), idle=_unlevelled),
    Rule(settings=("seed",), idle=_sure),
    Rule(settings=("features",), idle=_few),
    Rule(settings=("height_m",), idle=_high),
    Rule(settings=("jobs",), idle=_shared_out),
)
"""Rules of a mosaic's settings."""
