"""The workflow of lens calibration: from frames of a chess-board to a calibrated camera.

read -> boards -> calibrate -> judge -> report
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from skyquilt.calibration import figures as calibrate_judging
from skyquilt.calibration import files as calibrate_files
from skyquilt.calibration.assemble import WEIGHTS
from skyquilt.calibration.board_views import SERIES, Seen, look, one_camera
from skyquilt.calibration.calibrate import Calibrate, strangers
from skyquilt.calibration.deviations import widened
from skyquilt.calibration.few_views import FewViews, cannot_know
from skyquilt.calibration.find_board import FindBoard
from skyquilt.engine.clock import Clock, Steps
from skyquilt.engine.folder import claimed
from skyquilt.engine.store import Store
from skyquilt.engine.workers import Threads
from skyquilt.errors import RefusedError, UsageError
from skyquilt.model.board import Board, RejectedView
from skyquilt.model.calibration import Calibration
from skyquilt.model.event import Event, Note, Result
from skyquilt.outside import same_folder
from skyquilt.photos.survey import read_survey
from skyquilt.typed import as_path, typed

FEWEST_VIEWS = 3
STATED = 0.05
"""Standard deviation of a focal length stated by the user, as a share of it."""
_UNKNOWN = 0.1
"""If the deviation of the focal length is larger than this share of it, the focal length is not
determined.
"""


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings:
    """Settings of a calibration."""

    columns: int
    """Squares in a row of the board."""
    rows: int
    """Squares in a column."""
    square_m: float
    """Side of a square in m."""
    series: str = "auto"
    """One of `SERIES`."""
    weights: str = "contrast"
    """One of `assemble.WEIGHTS`: how the frames of one pose are weighted."""
    few_views: bool = False
    """Make do with one or two views, as the thesis: see `few_views.FewViews`."""
    focal_px: float | None = None
    """Prior of the focal length in px for few views; None = what the frames tell or let guess."""
    jobs: int = 0
    """Threads; 0 = all processors."""

    def __post_init__(self) -> None:
        typed(self)
        if self.series not in SERIES:
            raise UsageError(f"--series {self.series!r} is not one of {', '.join(SERIES)}")
        if self.weights not in WEIGHTS:
            raise UsageError(f"--weights {self.weights!r} is not one of {', '.join(WEIGHTS)}")
        if not (min(self.columns, self.rows) >= 3 and max(self.columns, self.rows) <= 100):
            raise UsageError(
                f"--board {self.columns}x{self.rows}: 3 to 100 squares a side are expected"
            )
        if self.focal_px is not None and not self.few_views:
            raise UsageError("--focal has no effect without --few-views")
        if self.focal_px is not None and not 10 <= self.focal_px <= 1e6:
            raise UsageError(f"--focal {self.focal_px:g} lies outside 10 to 1e+06 px")
        if not 1e-4 <= self.square_m <= 100:
            raise UsageError(
                f"--square {self.square_m:g}: the side of a square in m, 0.0001 to 100, is expected"
            )

    @property
    def board(self) -> Board:
        """The board."""
        return Board(columns=self.columns, rows=self.rows, square_m=self.square_m)


def iter_calibrate(
    frames: Path | str, output: Path | str, settings: CalibrateSettings, *, overwrite: bool = False
) -> Iterator[Event]:
    """Calibrates the camera that took the frames and yields its progress; the last event is the
    `Result`.

    Raises:
        RefusedError: mixed cameras, too few boards, or boards that do not determine the lens.
        SkyquiltError: any other error that the user can correct.
    """
    frames, output, began = as_path("frames", frames), as_path("output", output), Clock.now()
    if frames.is_dir() and same_folder(frames, output):
        raise UsageError(
            f"{output} contains the frames; choose another folder, such as {output / 'calibration'}"
        )
    survey = read_survey(frames)
    one_camera(survey.photos)
    with claimed(output, calibrate_files.CONTRACT, overwrite=overwrite):
        clock = Clock(
            store=Store(folder=output, registry={}),
            began=began,
            workers=Threads(settings.jobs or os.cpu_count() or 1),
        )
        board = settings.board
        seen = yield from clock.stage(
            "boards",
            look(
                survey.photos,
                board,
                FindBoard(),
                settings.series,
                clock.workers,
                WEIGHTS[settings.weights](),
            ),
        )
        unread = (RejectedView(name=r.name, reason=r.reason) for r in survey.rejected)
        seen = replace(seen, rejected=(*unread, *seen.rejected))
        few = settings.few_views and 1 <= len(seen.views) < FEWEST_VIEWS
        if not few:
            _enough(seen, few_views=settings.few_views)
        if settings.few_views and not few:
            yield Note(
                text=f"{len(seen.views)} views are enough without the priors of --few-views, which"
                " has no effect" + (", nor has --focal" if settings.focal_px else ""),
                warning=True,
            )
        yield Note(
            text=f"the board was found in {len(seen.views)} of"
            f" {len(seen.views) + len(seen.rejected)} views"
        )
        key = survey.photos[0].camera_key
        if few:
            focal = survey.photos[0].focal
            prior = FewViews(
                focal_px=settings.focal_px or focal.px,
                sigma_px=STATED * settings.focal_px if settings.focal_px else focal.sigma_px,
            )
            both = yield from clock.stage("calibrate", _with_priors(seen, board, prior))
            open_ = cannot_know(both[0], prior)
            work = calibrate_files.finish(
                output, seen, board, key, *both, None, clock, frames, open_
            )
            figures = yield from clock.stage("report", work)
            yield from (Note(text=sentence) for sentence in open_)
        else:
            centres, corners = Calibrate(), Calibrate(marks="corners")
            seen, by_centres, by_corners = yield from clock.stage(
                "calibrate", _calibrated(seen, board, centres, corners)
            )
            yield from (Note(text=f"{r.name} was left out: {r.reason}") for r in seen.rejected)
            _determined(by_centres)
            judged = yield from clock.stage(
                "judge",
                calibrate_judging.judge(
                    seen.views, board, (centres, corners), (by_centres, by_corners)
                ),
            )
            work = calibrate_files.finish(
                output, seen, board, key, by_centres, by_corners, judged, clock, frames
            )
            figures = yield from clock.stage("report", work)
    yield Result(output=output, metrics=figures)


def calibrate(
    frames: Path | str, output: Path | str, settings: CalibrateSettings, *, overwrite: bool = False
) -> Result:
    """Calibrates the camera that took the frames and returns when all files are written.

    Raises:
        SkyquiltError: any error that the user can correct.
    """
    for happened in iter_calibrate(frames, output, settings, overwrite=overwrite):
        if isinstance(happened, Result):
            return happened
    raise RuntimeError("the workflow ended without a result")


def _calibrated(
    seen: Seen, board: Board, centres: Calibrate, corners: Calibrate
) -> Steps[tuple[Seen, Calibration, Calibration]]:
    """Calibrations from centres and, on the same views, from corners; outlying views are left out
    first.
    """
    yield 0, 2
    by_centres = centres(seen.views, board)
    odd = strangers(by_centres)
    if odd:
        reasons = [
            RejectedView(
                name=n,
                reason=f"the error of its squares is {e:.1f} px (RMS), far more than in the other"
                " views",
            )
            for n, e in odd.items()
        ]
        seen = replace(
            seen,
            views=tuple(v for v in seen.views if v.name not in odd),
            rejected=(*seen.rejected, *reasons),
        )
        _enough(seen)
        by_centres = centres(seen.views, board)
    yield 1, 2
    by_corners = corners(seen.views, board)
    yield 2, 2
    return seen, widened(by_centres, by_corners), widened(by_corners, by_centres)


def _with_priors(
    seen: Seen, board: Board, prior: FewViews
) -> Steps[tuple[Calibration, Calibration]]:
    """Calibrations from centres and from corners of one or two views."""
    yield 0, 2
    by_centres = prior(seen.views, board)
    yield 1, 2
    by_corners = replace(prior, marks="corners")(seen.views, board)
    yield 2, 2
    return widened(by_centres, by_corners), widened(by_corners, by_centres)


def _enough(seen: Seen, *, few_views: bool = False) -> None:
    """Refuses too few views for a calibration.

    Raises:
        RefusedError: there are too few.
    """
    if len(seen.views) >= FEWEST_VIEWS:
        return
    needed = "one or more is" if few_views else f"{FEWEST_VIEWS} or more are"
    other = "" if few_views else ", or add --few-views for a lens with assumptions"
    raise RefusedError(
        f"the board was found in {len(seen.views)} of {len(seen.views) + len(seen.rejected)} views,"
        f" and {needed} needed{_reasons(seen.rejected)}; take more, tilted by 20 to 40 degrees in"
        f" different directions, the whole board in the frame{other}"
    )


def _reasons(rejected: Sequence[RejectedView]) -> str:
    return "".join(f"; {r.name}: {r.reason}" for r in rejected[:5]) + (
        "; ..." if len(rejected) > 5 else ""
    )


def _determined(found: Calibration) -> None:
    """Refuses a focal length that the views do not determine.

    Raises:
        RefusedError: all boards were seen at the same tilt.
    """
    focal, sigma = found.camera.focal, found.sigma("focal")
    if not sigma < _UNKNOWN * focal:
        raise RefusedError(
            f"the focal length remains unknown ({focal:.0f} px with a deviation of {sigma:.0f}):"
            " all boards are seen"
            " at much the same angle; tilt the board by 20 to 40 degrees in different directions"
        )
