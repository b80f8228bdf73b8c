"""Registration methods of the thesis for two spectral bands, with its parameters [Y 5.2,
Fig. 5.8].
"""

from skyquilt.coregistration.methods import INLIERS, SAMPLES
from skyquilt.matching.matchers import OneWay
from skyquilt.matching.ransac import Ransac
from skyquilt.matching.sift import Sift
from skyquilt.papers.lmeds import Lmeds
from skyquilt.papers.rfae import BetterByQ, ByFeatures, Outliers, Rfae
from skyquilt.papers.surf import Surf
from skyquilt.quality.registration_quality import spread_quality


def sift() -> ByFeatures:
    """SIFT with 43 levels."""
    return ByFeatures(detect=_sift(), relate=_outliers())


def surf() -> ByFeatures:
    """SURF with an initial lobe and a sampling step of 1."""
    return ByFeatures(detect=_surf(), relate=_outliers())


def usurf() -> ByFeatures:
    """The same without orientation."""
    return ByFeatures(detect=_surf(upright=True), relate=_outliers())


def rfae() -> Rfae:
    """SURF along edges."""
    return Rfae(detect=_surf(), relate=_outliers())


def rfae_sift() -> Rfae:
    """SIFT along edges."""
    return Rfae(detect=_sift(), relate=_outliers())


def surf_and_rfae() -> BetterByQ:
    """The better of SURF and RFAE by Q [Y 6.4.1]."""
    return BetterByQ(methods=(surf(), rfae()))


def _sift() -> Sift:
    return Sift(levels=43, root=False, longest=1000, count=3000)


def _surf(*, upright: bool = False) -> Surf:
    return Surf(lobe=1, step=1, upright=upright)


def _outliers() -> Outliers:
    return Outliers(
        match=OneWay(),
        quality=spread_quality,
        estimators=(
            Ransac(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
            Lmeds(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
        ),
    )
