"""The same problem in pycolmap's words: positions as priors, observations of 1 px, no other
prior.
"""

import numpy as np
import pycolmap

from skyquilt.alignment.problem import Problem, State

CORNER = 0.5
"""COLMAP counts pixels from the corner of the image: centres lie at 0.5."""


def reconstruction(
    problem: Problem, state: State, width: int, height: int
) -> pycolmap.Reconstruction:
    """Cameras (RADIAL: focal, cx, cy, k1, k2), images, and tracks."""
    made = pycolmap.Reconstruction()
    for j, K in enumerate(state.K):
        f, cx, cy, k1, k2 = K[:5]
        made.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="RADIAL",
                width=width,
                height=height,
                params=[f, cx + CORNER, cy + CORNER, k1, k2],
                camera_id=j + 1,
            )
        )
    number = np.zeros(len(problem.px), int)
    for i in range(len(state.C)):
        mine = np.flatnonzero(problem.photo == i)
        number[mine] = np.arange(len(mine))
        image = pycolmap.Image(
            name=f"{i}",
            keypoints=problem.px[mine] + CORNER,
            camera_id=int(problem.camera[i]) + 1,
            image_id=i + 1,
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(state.R[i]), -state.R[i] @ state.C[i])
        made.add_image_with_trivial_frame(image, pose)
    cuts = np.searchsorted(problem.point, np.arange(len(state.X) + 1))
    for p in range(len(state.X)):
        seen = range(cuts[p], cuts[p + 1])
        track = pycolmap.Track(
            [pycolmap.TrackElement(int(problem.photo[k]) + 1, int(number[k])) for k in seen]
        )
        made.add_point3D(state.X[p], track)
    return made


def solve(
    problem: Problem,
    state: State,
    width: int,
    height: int,
    *,
    focal: bool,
    lens: bool = False,
    centre: bool = False,
    cauchy: float | None = None,
    threads: int = 1,
    exact: bool = True,
) -> State:
    """pycolmap's minimum with the positions as priors."""
    made = reconstruction(problem, state, width, height)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length, options.refine_extra_params, options.refine_principal_point = (
        focal,
        lens,
        centre,
    )
    options.ceres.solver_options.num_threads = threads
    if exact:
        options.ceres.solver_options.gradient_tolerance = 1e-10
        options.ceres.solver_options.function_tolerance = 1e-14
        options.ceres.solver_options.max_num_iterations = 300
    if cauchy is not None:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = cauchy
    config, priors = pycolmap.BundleAdjustmentConfig(), []
    for i in range(len(state.C)):
        config.add_image(i + 1)
        prior = pycolmap.PosePrior()
        prior.pose_prior_id = i + 1
        prior.corr_data_id = made.images[i + 1].data_id
        prior.position, prior.position_covariance = problem.C0[i], np.diag(problem.sigma_C[i] ** 2)
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    pycolmap.create_pose_prior_bundle_adjuster(
        options, pycolmap.PosePriorBundleAdjustmentOptions(), config, priors, made
    ).solve()
    poses = [made.images[i + 1].cam_from_world() for i in range(len(state.C))]
    R = np.array([p.rotation.matrix() for p in poses])
    K = np.zeros_like(state.K)
    for j in range(len(K)):
        f, cx, cy, k1, k2 = made.cameras[j + 1].params
        K[j, :5] = f, cx - CORNER, cy - CORNER, k1, k2
        K[j, 8] = 1.0
    C = np.array([-p.rotation.matrix().T @ p.translation for p in poses])
    X = np.array([made.points3D[p + 1].xyz for p in range(len(state.X))])
    return State(R=R, C=C, K=K, X=X, turn=np.zeros_like(C))
