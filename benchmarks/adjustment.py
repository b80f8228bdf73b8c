"""Cost of a bundle adjustment: Skyquilt's and pycolmap's Ceres on the same synthetic problems.

    python -m benchmarks.adjustment [--runs 5]

Both use the same observations, position priors, Cauchy loss, free focal length and radial
distortion, and one thread, and stop at their default tolerance. The table says how far from the
exact minimum each stopped.
"""

import argparse
import platform
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from benchmarks.cost import measure  # noqa: E402
from tests.alignment import ceres  # noqa: E402
from tests.alignment.blocks import HEIGHT, WIDTH, make_block  # noqa: E402

from skyquilt.alignment.adjust import adjust, robust_cost  # noqa: E402
from skyquilt.alignment.problem import Problem, State  # noqa: E402

SIZES = {
    "18 photos": {"lines": 3, "per_line": 6, "points": 1000},
    "75 photos": {"lines": 5, "per_line": 15, "points": 8200},
}
"""Name -> layout: about 4000 and 46,000 observations."""


def problem_of(layout: dict[str, int]) -> tuple[Problem, State]:
    """A block both can state: no priors but positions, near its minimum as after a similarity
    graph.
    """
    block = make_block(1, lies=0.01, gps=1.5, lens_errs=False, **layout)
    n = len(block.truth.C)
    problem = replace(
        block.problem,
        sigma_px=np.ones(len(block.problem.px)),
        loss_px=2.0,
        loss_C=1e6,
        loss_R=1e6,
        free=np.array([[1, 0, 0, 1, 1, 0, 0, 0, 0, 0]], bool),
        sigma_R=np.full((n, 3), np.inf),
        sigma_K=np.full((1, 11), np.inf),
    )
    start = replace(
        block.start,
        R=block.truth.R,
        X=block.truth.X + np.random.default_rng(0).normal(0, 0.5, block.truth.X.shape),
    )
    return problem, start


def main() -> None:
    """Prints a table of medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    print(
        f"{platform.processor() or platform.machine()}, Python {platform.python_version()}, numpy"
        f" {np.__version__}"
    )
    print(
        f"{'problem':<12}{'observations':>12} "
        f" {'solver':<22}{'CPU s':>8}{'min':>8}{'max':>8}{'above the minimum':>20}"
    )
    for name, layout in SIZES.items():
        problem, start = problem_of(layout)
        best = adjust(problem, start, iterations=200, tolerance=1e-13).cost

        def mine(tolerance: float, problem: Problem = problem, start: State = start) -> State:
            return adjust(problem, start, iterations=60, tolerance=tolerance).state

        def theirs(exact: bool, problem: Problem = problem, start: State = start) -> State:
            return ceres.solve(
                problem,
                start,
                WIDTH,
                HEIGHT,
                focal=True,
                lens=True,
                cauchy=2.0,
                threads=1,
                exact=exact,
            )

        def building(problem: Problem = problem, start: State = start) -> object:
            return ceres.reconstruction(problem, start, WIDTH, HEIGHT)

        solvers = {
            "skyquilt, 1e-5": lambda: mine(1e-5),
            "skyquilt, 1e-9": lambda: mine(1e-9),
            "pycolmap, its default": lambda: theirs(False),
            "(its reconstruction)": building,
        }
        for solver, work in solvers.items():
            cost = measure(work, runs)
            state = work()
            above = (
                f"{robust_cost(problem, state) / best - 1:.1e}" if isinstance(state, State) else ""
            )
            line = f"{name:<12}{len(problem.px):>10}  {solver:<22}"
            print(
                f"{line}{cost.cpu_median:>8.3f}{cost.cpu_min:>8.3f}{cost.cpu_max:>8.3f}{above:>20}"
            )


if __name__ == "__main__":
    main()
