"""Lens calibration: simulated heated sweeps with known truth, weights of the assembly, real thermal
boards.

python benchmarks/calibration.py sweeps [SEEDS]   # five poses of 92 frames each per seed
python benchmarks/calibration.py weights          # powers of 1 / phi in assembled images
python benchmarks/calibration.py boards FOLDER COLUMNSxROWS SQUARE   # real frames
"""

import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from skyquilt.calibration.assemble import Assemble
from skyquilt.calibration.calibrate import Calibrate
from skyquilt.calibration.deviations import widened
from skyquilt.calibration.find_board import FindBoard
from skyquilt.calibration.workflow import CalibrateSettings, calibrate
from skyquilt.cli.calibrate import parse_board
from skyquilt.model.board import Board
from skyquilt.simulate.board import Chessboard, Lamp, Sensor, five_poses, sweep
from skyquilt.simulate.camera import Lens

BOARD, CHESS = Board(columns=7, rows=6, square_m=0.10), Chessboard()


def lens_of(rng):
    """A thermal lens, another one for each seed."""
    return Lens(
        width=640,
        height=480,
        focal=float(rng.uniform(600, 800)),
        offset_x=float(rng.normal(0, 6)),
        offset_y=float(rng.normal(0, 6)),
        k1=float(rng.uniform(-0.35, -0.2)),
        k2=float(rng.uniform(0, 0.15)),
        p1=0.0,
        p2=0.0,
    )


def lamp_of(rng):
    """A lamp's way over the board, another one for each seed."""
    return Lamp(
        lines=int(rng.integers(3, 6)),
        radius=float(rng.uniform(1.4, 2.0)),
        rise=float(rng.uniform(4, 8)),
    )


def sweeps(seeds):
    """Assembled, found, calibrated, and compared with the truth."""
    inside = narrow = found = 0
    print(
        "seed  views  truth     from centres            z     dev %  RMS    from corners          "
        " z     CPU s"
    )
    for seed in range(seeds):
        began, rng = time.process_time(), np.random.default_rng([seed, 77])
        lens, lamp = lens_of(rng), lamp_of(rng)
        views = []
        for k, pose in enumerate(five_poses(lens, CHESS, rng)):
            picture = Assemble()(sweep(lens, CHESS, pose, lamp, Sensor(), rng), BOARD)
            view = FindBoard()(f"pose {k}", picture, BOARD, frames=lamp.frames)
            if view:
                views.append(view)
            else:
                print(f"      {view.name}: {view.reason}")
        found += len(views)
        line = f"{seed:4d}  {len(views)}/5    {lens.focal:6.1f}"
        both = [Calibrate(marks=marks)(views, BOARD) for marks in ("centres", "corners")]
        for marks, got in zip(
            ("centres", "corners"), (widened(*both), widened(*both[::-1])), strict=True
        ):
            sigma = got.sigma("focal")
            z = (got.camera.focal - lens.focal) / sigma
            line += f"   {got.camera.focal:7.2f} ± {sigma:5.2f}   {z:6.2f}"
            if marks == "centres":
                inside += abs(z) <= 2
                narrow += sigma <= 0.02 * got.camera.focal
                line += f"   {100 * sigma / got.camera.focal:5.2f}  {got.rms_px:.3f}"
        print(f"{line}   {time.process_time() - began:5.1f}", flush=True)
    print(
        f"grids found {found} of {5 * seeds}; deviation <= 2 % in {narrow}, truth within two in"
        f" {inside} of {seeds}"
    )


def weights():
    """Contrast and error of the assembled picture by the power of 1 / phi; -1 is (5.3) as
    printed.
    """
    rng = np.random.default_rng(3)
    lens = lens_of(rng)
    pose = five_poses(lens, CHESS, rng)[4]
    frames = list(sweep(lens, CHESS, pose, Lamp(), Sensor(), rng))
    true = (BOARD.corners.reshape(-1, 3) - [0.35, 0.30, 0.0]) @ pose.rotation.T + pose.shift
    true = lens.project(true, np.eye(3), np.zeros(3))
    print("power  found  contrast / texture  corners off, px (RMS)")
    for power in (-1.0, 0.0, 0.25, 0.5, 1.0, 2.0, 3.0):
        view = FindBoard()("", Assemble(power=power)(frames, BOARD), BOARD)
        if not view:
            print(f"{power:5.2f}  no     ({view.reason})")
            continue
        off = np.linalg.norm(view.corners.reshape(-1, 1, 2) - true[None], axis=2).min(1)
        print(
            f"{power:5.2f}  yes    {view.contrast:8.1f}            {np.sqrt((off**2).mean()):.3f}"
        )


def boards(folder, size, square):
    """The whole command on real frames."""
    columns, rows = parse_board(size)
    with tempfile.TemporaryDirectory() as out:
        began = time.process_time()
        m = calibrate(
            folder,
            Path(out) / "out",
            CalibrateSettings(columns=columns, rows=rows, square_m=float(square)),
        )
        m = m.metrics
    print(f"boards {m['views_used']} of {m['views_used'] + len(m['views_rejected'])} views")
    for marks in ("centres", "corners"):
        c = m[marks]
        f = c["parameters"]["focal"]
        print(
            f"{marks}: f {f['value']:.2f} ± {f['sigma']:.2f} px, RMS {c['rms_px']} px, kept out"
            f" {c['held_out_px']},"
            f" dropped {list(c['dropped'])}"
        )
    print(f"registration {m['registration']}")
    print(f"{time.process_time() - began:.1f} s of CPU")


if __name__ == "__main__":
    cv2.setNumThreads(1)
    what, *rest = sys.argv[1:] or ["sweeps"]
    if what == "sweeps":
        sweeps(int(rest[0]) if rest else 20)
    elif what == "weights":
        weights()
    else:
        boards(*rest)
