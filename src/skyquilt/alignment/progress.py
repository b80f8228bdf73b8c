"""How far an adjustment is, from the names of its parts."""

from dataclasses import dataclass

STEPS = {
    "start": "where photos lie",
    "tracks": "tie points",
    "rough": "rough adjustment",
    "sharp": "tie points refined",
    "fine": "adjustment",
    "turned": "files turned upside down",
    "weighed": "observations weighed",
    "plain": "observations weighed",
    "positions": "positions weighed",
    "outcome": "deviations",
}
"""Parts of `Bundle._block` in their order, by the first word of their names, and what they are
called.
"""


@dataclass(kw_only=True)
class AdjustmentSteps:
    """Counts the steps of adjustments, of which there may be several, one after the other."""

    adjustments: int = 1
    """How many have begun."""
    done: int = 0
    """Steps of the last one that are over."""

    def __call__(self, part: str) -> tuple[int, int, str]:
        """Done, total, and what is done now; `part`: the name of a part that begins."""
        words = part.rsplit("]", 1)[-1].split()
        order = list(STEPS)
        if words and words[0] in STEPS:
            at = order.index(words[0])
            self.adjustments += at < self.done and order[at] in ("start", "tracks")
            self.done = at
        what = STEPS[order[self.done]]
        if words and words[-1].isdecimal():
            what += f", {int(words[-1]) + 1}" if self.done != order.index("sharp") else ""
        if self.adjustments > 1:
            what += f", adjustment {self.adjustments}"
        before = (self.adjustments - 1) * len(STEPS)
        return before + self.done, self.adjustments * len(STEPS), what
