"""Records of photos, priors and alignments to judge or to spoil."""

from datetime import datetime
from pathlib import Path

import numpy as np

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Attitude, Focal, GeoPosition, Photo
from skyquilt.model.poses import Alignment, MapFrame, Pose, Prior, TiePoints

WIDTH, HEIGHT, FOCAL = 800, 600, 700.0
_DEFAULT = object()


def photo(
    name="a.jpg",
    *,
    position=_DEFAULT,
    attitude=None,
    focal=FOCAL,
    sigma_focal=20.0,
    key="cam",
    **more,
):
    if position is _DEFAULT:
        position = GeoPosition(
            latitude_deg=50.8, longitude_deg=-0.14, altitude_m=60.0, datum="takeoff"
        )
    return Photo(
        name=name,
        path=Path(name),
        digest=name,
        width=WIDTH,
        height=HEIGHT,
        channels=3,
        dtype="uint8",
        band="visible",
        camera_key=key,
        focal=Focal(px=focal, sigma_px=sigma_focal, source="sensor"),
        position=position,
        attitude=attitude,
        time=datetime(2024, 5, 1),
        **more,
    )


def prior(C, *, yaw=0.0, pitch=0.0, roll=0.0, sigma=1.5, sigma_z=3.0, sigma_yaw=5.0):
    return Prior(
        map_C=np.array(C, float),
        sigma_C=np.array([sigma, sigma, sigma_z]),
        yaw_deg=yaw,
        pitch_deg=pitch,
        roll_deg=roll,
        sigma_yaw_deg=sigma_yaw,
        sigma_tilt_deg=1.0,
        yaw_source="xmp-gimbal",
    )


def alignment(count=8, *, focal=FOCAL, convergence=0.0, crs="EPSG:32630", block=None):
    """Photos 15 m apart at 60 m, yaw 10 degrees, over ground at zero."""
    poses = {
        i: Pose(cam_R_map=cam_R_map_from_angles(10.0), map_C=np.array([0.0, 15.0 * i, 60.0]))
        for i in range(count)
    }
    ties = TiePoints(
        xyz=np.zeros((5, 3)),
        point=np.zeros(0, np.int64),
        photo=np.zeros(0, np.int64),
        px=np.zeros((0, 2)),
        residual_px=np.zeros((0, 2)),
    )
    frame = MapFrame(
        crs=crs, origin=(500000.0, 5600000.0), vertical_datum="takeoff", convergence_deg=convergence
    )
    return Alignment(
        method="bundle",
        why="",
        frame=frame,
        poses=poses,
        cameras={"cam": Camera.ideal(width=WIDTH, height=HEIGHT, focal=focal)},
        camera_of=dict.fromkeys(range(count), "cam"),
        blocks=(tuple(range(count)),) if block is None else block,
        ties=ties,
    )


__all__ = ["FOCAL", "HEIGHT", "WIDTH", "Attitude", "alignment", "photo", "prior"]
