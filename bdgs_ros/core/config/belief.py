"""Parameters of the Bayesian dynamic inference."""

from __future__ import annotations

from dataclasses import dataclass, field

from bdgs_ros.core.config.likelihood_fit import WEIGHTS
from bdgs_ros.core.config.param import param


@dataclass(frozen=True)
class LikelihoodConfig:
    """
    The logistic model w, b of Eq. 3 on the features of `belief.likelihood`.

    The weights are those that `bdgs fit-likelihood --ship` wrote down last.
    """

    w_prior: float = param(WEIGHTS['prior'], 'weight of the detector prior')
    w_object: float = param(WEIGHTS['object'], 'weight of the detector prior over the surface')
    w_edge: float = param(WEIGHTS['edge'], 'weight of the nearness of a mask')
    w_residual: float = param(WEIGHTS['residual'], 'weight of the signed depth residual')
    w_color: float = param(WEIGHTS['color'], 'weight of the colour difference')
    w_warp: float = param(WEIGHTS['warp'], 'weight of free space in remembered keyframes')
    w_departed: float = param(
        WEIGHTS['departed'], 'weight of the share of the surface that is seen through'
    )
    w_free_space: float = param(WEIGHTS['free_space'], 'weight of a free-space violation')
    w_visibility: float = param(WEIGHTS['visibility'], 'weight of the share in the image')
    w_streak: float = param(WEIGHTS['streak'], 'weight of agreement in the keyframes before')
    w_age: float = param(WEIGHTS['age'], 'weight of the age')
    w_observations: float = param(WEIGHTS['observations'], 'weight of the number of observations')
    w_agreement: float = param(WEIGHTS['agreement'], 'weight of a measured depth that agrees')
    w_bias: float = param(WEIGHTS['bias'], 'b')
    depth_noise: float = param(
        0.004, 'sigma_z = depth_floor + depth_noise * z^2', unit='1/m', low=1e-5
    )
    depth_floor: float = param(0.01, 'error of depth and pose at the camera', unit='m', low=0.0)
    gate_sigma: float = param(
        3.0, 'depths within agree; beyond, one hides the other', unit='sigma_z', low=0.5
    )


@dataclass(frozen=True)
class BeliefConfig:
    """The filter of Eq. 1-4, the fusion of Eq. 5-6 and the mask of Eq. 10-11."""

    enabled: bool = param(True, 'without it labels gate the map directly (Table 6)')
    multi_view: bool = param(True, 'fuse the evidence of co-visible keyframes, Eq. 5 (Table 6)')
    decay_rate: float = param(0.7, 'alpha of Eq. 4 and of w_k', unit='1/s', low=0.0, high=100.0)
    initial: float = param(0.3, 'belief of a new Gaussian', low=0.01, high=0.99)
    initial_in_front: float = param(
        0.85, 'belief of a new Gaussian in front of the known map', low=0.01, high=0.99
    )
    margin: float = param(0.1, 'delta of Eq. 6', low=0.0, high=0.49)
    ema: float = param(0.8, 'rho of Eq. 10', low=0.01, high=1.0)
    mask_threshold: float = param(0.7, 'M_g of Eq. 11: rendered below', low=0.5, high=1.0)
    mask_hysteresis: float = param(
        0.1, 'what was hidden is rendered again below the threshold by this', low=0.0, high=0.5
    )
    readmission: int = param(
        2, 'keyframes in a row that must see a hidden newcomer rest', low=1, high=20
    )
    max_log_odds: float = param(
        3.0, 'the most that is known before a keyframe', low=1.0, high=50.0
    )
    max_memory_log_odds: float = param(
        3.0, 'the most that earlier keyframes say of a new Gaussian', low=0.0, high=50.0
    )
    views: int = param(8, 'N of Eq. 5: keyframes whose evidence is kept', low=1, high=64)
    diversity_translation: float = param(0.1, 'tau_t', unit='m', low=0.0, high=10.0)
    diversity_rotation_deg: float = param(5.0, 'tau_r', unit='deg', low=0.0, high=180.0)
    delete_above: float = param(
        0.9, 'a smoothed belief above, seen through, is deleted', low=0.5, high=1.0
    )
    delete_after: int = param(
        2, 'keyframes in a row that must have looked through it', low=1, high=20
    )
    likelihood: LikelihoodConfig = field(default_factory=LikelihoodConfig)
